"""Tests of errors of correspondences, compared with a loop over pairs and points."""

import math

import numpy as np
import pytest
import torch
from torch.distributions import MultivariateNormal

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError, DataError
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.vertices.correspondence import correspondence
from plugins.metric.vertices.metric import CorrespondenceError
from plugins.metric.vertices.rows import FIELDS, mesh


def errors_by_loop(truth, registered, subject):
    """Return the errors, one pair and one point at a time."""
    errors = {True: [], False: []}
    for first in range(len(truth)):
        for second in range(len(truth)):
            if first == second:
                continue
            gaps = []
            for point, true_place in zip(truth[first], truth[second], strict=True):
                vertex = min(
                    range(len(registered[first])), key=lambda v: math.dist(registered[first][v], point)
                )
                gaps.append(100 * math.dist(registered[second][vertex], true_place))
            errors[bool(subject[first] == subject[second])].append(np.mean(gaps))
    return np.mean(errors[True]), np.mean(errors[False])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_errors_equal_a_loop_for_any_template(dtype):
    random = np.random.default_rng(3)
    truth = random.normal(size=(6, 20, 3)).astype(np.float32)
    registered = random.normal(size=(6, 33, 3)).astype(np.float32)  # a mesh of another topology
    subject = np.array([0, 1, 0, 2, 1, 0])
    actual = correspondence(
        torch.tensor(truth, dtype=dtype), torch.tensor(registered, dtype=dtype), torch.tensor(subject)
    )
    wanted = errors_by_loop(truth.tolist(), registered.tolist(), subject)
    assert actual.intra_cm.item() == pytest.approx(wanted[0], rel=1e-6)
    assert actual.inter_cm.item() == pytest.approx(wanted[1], rel=1e-6)


def body(number):
    """Return 40 vertices, metres, of a person's shape in a random pose."""
    shape = np.random.default_rng(0).normal(0, 0.3, (40, 3)) * (1 + number // 10 / 20)
    return torch.from_numpy(shape + 0.1 * np.sin(3 * shape[:, [1, 2, 0]] + number % 10) + [0, 1.0, 0])


def test_perfect_registrations_have_no_error_and_a_shift_of_one_scan_has_its_length():
    meshes = torch.stack([body(number) for number in (0, 1, 10)])
    subject = torch.tensor([0, 0, 1])
    assert correspondence(meshes, meshes, subject) == (0, 0)
    # the third template is 1 mm too high, but its points still have the same nearest vertices
    shifted = meshes.clone()
    shifted[2, :, 1] += 0.001
    actual = correspondence(meshes, shifted, subject)
    assert actual.intra_cm.item() == 0
    # for pairs with the third scan
    assert actual.inter_cm.item() == pytest.approx(0.1 / 2, rel=1e-9)


def test_one_person_alone_has_no_inter_error():
    meshes = torch.randn(3, 8, 3)
    actual = correspondence(meshes, meshes, torch.zeros(3, dtype=torch.int64))
    assert (actual.intra_cm.item(), actual.inter_cm.isnan().item()) == (0, True)


def test_the_metric_reads_metres_from_normalised_meshes():
    metric = build("metric", resolve("metric", "correspondence"), target=mesh(5))
    generator = torch.Generator().manual_seed(0)
    point, truth = (torch.randn(7, 15, generator=generator) for _ in range(2))
    fields = {name: make(7) for name, make in FIELDS.items()}
    for rows in (slice(0, 3), slice(3, 7)):
        density = MultivariateNormal(point[rows], scale_tril=torch.eye(15))
        metric.update(Prediction(density, {"target": truth[rows], **{k: v[rows] for k, v in fields.items()}}))
    back = fields["scale"].double()[:, None, None], fields["centre"].double()[:, None]
    metres = [part.double().reshape(7, 5, 3) * back[0] + back[1] for part in (truth, point)]
    wanted = errors_by_loop(*(part.tolist() for part in metres), fields["subject"])
    actual = metric.compute()
    assert actual["intra_cm"].item() == pytest.approx(wanted[0], rel=1e-5)
    assert actual["inter_cm"].item() == pytest.approx(wanted[1], rel=1e-5)


def test_data_and_targets_without_meshes_raise_an_error():
    with pytest.raises(ConfigError, match="metric correspondence describes targets of kind 'real'"):
        CorrespondenceError(Target("angle", ("azimuth",)))
    with pytest.raises(ConfigError, match="the target has 4 numbers"):
        CorrespondenceError(Target("real", tuple("abcd")))
    density = MultivariateNormal(torch.zeros(2, 15), scale_tril=torch.eye(15))
    with pytest.raises(DataError, match="requires the batch field 'centre'"):
        CorrespondenceError(mesh(5)).update(Prediction(density, {"target": torch.zeros(2, 15)}))
