"""Tests of the concatenated points of clouds, and of maxima over each, against loops over clouds."""

import pytest
import torch

from framework.errors import ConfigError
from framework.geometry.clouds import pad
from plugins.encoder.point_sets.point_sets import (
    all_have,
    concatenate_points,
    count_columns,
    encode_in_parts,
    first_rows,
    largest,
    mean,
    repeat_for_points,
)


@pytest.mark.parametrize("numbers", [(5, 5, 5), (5, 2, 1), (1,)])
@pytest.mark.parametrize("most", [None, 1, 3, 100])
def test_points_are_those_of_each_cloud_in_order(numbers, most):
    clouds = [torch.randn(number, 5) for number in numbers]
    values, counts = concatenate_points(pad(clouds), "none", columns=4, most=most, dtype=torch.float64)
    wanted = [cloud[:most, :4] for cloud in clouds]
    assert counts.tolist() == [len(cloud) for cloud in wanted]
    assert torch.equal(values, torch.cat(wanted).double())


@pytest.mark.parametrize("numbers", [(4, 4, 4), (4, 2, 1), (1,), ()])
def test_the_largest_and_the_mean_of_each_channel(numbers):
    parts = [torch.randn(number, 3) - 5 for number in numbers]
    values = torch.cat([torch.zeros(0, 3), *parts]).requires_grad_()
    counts = torch.tensor(numbers, dtype=torch.int64)
    maxima = largest(values, counts)
    assert maxima.shape == (len(numbers), 3)
    for row, part in zip(maxima, parts, strict=True):
        assert torch.equal(row, part.max(0).values)
    for row, part in zip(mean(values, counts), parts, strict=True):
        torch.testing.assert_close(row, part.mean(0))
    assert mean(values, counts).shape == (len(numbers), 3)
    spread = repeat_for_points(maxima, counts)
    assert spread.shape == values.shape
    assert (spread >= values).all()
    if not numbers:
        return
    maxima.sum().backward()
    assert values.grad.sum() == 3 * len(numbers)


@pytest.mark.parametrize("numbers", [(4, 4, 4), (4, 2, 1), (1,), ()])
@pytest.mark.parametrize("most", [1, 3, 9])
def test_first_rows_are_those_of_each_cloud(numbers, most):
    rows = torch.arange(sum(numbers)).split(list(numbers)) if numbers else []
    first = first_rows(torch.tensor(numbers, dtype=torch.int64), most)
    assert first.tolist() == [row for part in rows for row in part[:most].tolist()]


def test_parts_hold_few_points_and_give_what_the_whole_gives():
    counts = torch.tensor([3000, 2000, 2100, 10, 5000, 1])
    values, counts_of_parts = torch.randn(int(counts.sum()), 2), []

    def network(part, numbers):
        counts_of_parts.append(numbers.tolist())
        return largest(part, numbers)

    assert torch.equal(encode_in_parts(network, values, counts), largest(values, counts))
    assert counts_of_parts == [[3000], [2000], [2100, 10], [5000], [1]]
    counts_of_parts.clear()
    assert torch.equal(encode_in_parts(network, values, counts, rows_per_point=2), largest(values, counts))
    assert counts_of_parts == [[3000], [2000], [2100], [10], [5000], [1]]
    assert encode_in_parts(network, values[:0], counts[:0]).shape == (0, 2)


def test_even_and_what_is_no_cloud():
    assert all_have(torch.tensor([3, 3]), 3) and not all_have(torch.tensor([3, 2]), 3)
    assert count_columns((10, 6), "an encoder", False) == 3
    assert count_columns((10, 6), "an encoder", True) == 6
    with pytest.raises(ConfigError, match=r"an encoder got inputs of shape \(10, 2\)"):
        count_columns((10, 2), "an encoder", False)
