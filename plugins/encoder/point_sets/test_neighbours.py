"""Tests of nearest neighbours against all distances, sorted."""

import numpy as np
import pytest
import torch

from framework.errors import ConfigError
from plugins.encoder.point_sets.neighbours import nearest_rows, smallest


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("length", [1, 3, 40])
@pytest.mark.parametrize("numbers", [(30, 7, 1), (4, 2), ()])
def test_neighbours_are_those_of_all_distances(numbers, length, dtype):
    # far from the origin, where squares lose the digits of differences
    values = torch.randn(sum(numbers), length, dtype=dtype) + 300
    counts = torch.tensor(numbers, dtype=torch.int64)
    index = nearest_rows(values, counts, 5)
    most = min(5, max(numbers, default=1))
    assert index.shape == (sum(numbers), most)
    start = 0
    for number in numbers:
        part = values[start : start + number].double().numpy()
        distance = ((part[:, None] - part) ** 2).sum(-1)
        for row in range(number):
            nearest = (index[start + row] - start).tolist()
            wanted = np.argsort(distance[row], kind="stable")[:most].tolist()
            assert set(nearest) == set(wanted)
            assert sorted(nearest[: len(wanted)]) == sorted(wanted)
            assert nearest[len(wanted) :] == [row] * (most - len(wanted))
        start += number


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("most", [1, 4, 20, 99])
def test_the_smallest_numbers_in_order_and_the_first_of_equal_ones(most, dtype):
    table = torch.randint(6, (50, 20)).to(dtype)
    wanted = table.sort(dim=1, stable=True).indices[:, :most]
    assert torch.equal(smallest(table, most), wanted)


def test_numbers_that_are_not_finite_come_last():
    table = torch.tensor([[torch.nan, torch.inf, 2.0, -torch.inf, torch.nan, 1.0]])
    assert smallest(table, 4).tolist() == [[3, 5, 2, 0]]
    assert sorted(smallest(table, 6)[0].tolist()) == list(range(6))


def test_refuses_to_be_exported(monkeypatch):
    monkeypatch.setattr(torch.compiler, "is_exporting", lambda: True)
    with pytest.raises(ConfigError, match="nearest neighbours"):
        nearest_rows(torch.randn(4, 3), torch.tensor([4]), 2)
