"""Tests of the divergence against quadrature and SciPy, of the optimum, and of teachers that are refused."""

import math

import numpy as np
import pytest
import torch
from scipy import integrate, special, stats
from torch import nn

from framework.configuration.schema import build, resolve
from framework.errors import CheckpointError, ConfigError
from framework.target import Target
from framework.testing.constant import ConstantPredictor
from framework.uncertainty import own_batches
from plugins.objective.distillation.divergence import from_teacher
from plugins.objective.distillation.objective import Distillation, _equal
from plugins.objective.distillation.rows import ANGLE_TEACHER, CLASS_TEACHER, write_teacher

REAL, CLASSES, ANGLE = Target("real", ("x",)), Target("class", ("a", "b", "c")), Target("angle", ("pan",))


def head(name, target, **config):
    return build("density_head", resolve("density_head", {"name": name, **config}), target=target)


def objective(**config):
    return build("objective", resolve("objective", {"name": "distillation", **config}))


def mixture_of_members(name, target, raw):
    """Return the mixture of the densities of three members, (batch, 3, raw) → batch_shape (batch,)."""
    from framework.distributions.density import Mixture

    return Mixture(torch.zeros(raw.shape[:-1], dtype=raw.dtype), head(name, target)(raw))


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize("size", [1.0, 30.0, 1e4])
def test_the_divergence_of_classes_equals_scipys(dtype, tolerance, size):
    torch.manual_seed(0)
    raw = size * torch.randn(2, 5, 3, dtype=dtype)
    teacher, student = (head("categorical", CLASSES)(part) for part in raw)
    divergence = from_teacher(teacher, student, 1)
    log_p, log_q = (special.log_softmax(part.double().numpy(), axis=-1) for part in raw)
    p = np.exp(log_p)
    expected = np.where(p > 0, p * (log_p - log_q), 0).sum(-1)
    np.testing.assert_allclose(divergence.numpy(), expected, rtol=tolerance, atol=tolerance * size)
    torch.testing.assert_close(from_teacher(teacher, teacher, 1), torch.zeros(5, dtype=dtype), atol=0, rtol=0)


@pytest.mark.parametrize("name, target", [("gaussian", REAL), ("student_t", REAL), ("von_mises", ANGLE)])
def test_the_estimate_agrees_with_quadrature_and_is_0_for_equal_densities(name, target):
    torch.manual_seed(1)
    size = head(name, target).size
    teacher_raw, student_raw = (
        torch.randn(1, 3, size, dtype=torch.float64),
        torch.randn(1, size, dtype=torch.float64),
    )
    teacher, student = mixture_of_members(name, target, teacher_raw), head(name, target)(student_raw)

    def integrand(value):
        point = torch.tensor([[value]], dtype=torch.float64)
        log_p, log_q = teacher.log_prob(point).item(), student.log_prob(point).item()
        return math.exp(log_p) * (log_p - log_q) if log_p > -600 else 0.0

    bound = math.pi if target is ANGLE else 200.0
    expected = integrate.quad(integrand, -bound, bound, points=[0.0], limit=500)[0]
    torch.manual_seed(2)
    rows = 1000
    teachers, students = (
        mixture_of_members(name, target, teacher_raw.expand(rows, -1, -1)),
        head(name, target)(student_raw.expand(rows, -1)),
    )
    estimates = from_teacher(teachers, students, 16)
    error = (estimates.std() / math.sqrt(rows)).item()
    assert abs(estimates.mean().item() - expected) < 5 * error
    assert error < 0.05 * max(expected, 0.2)
    assert from_teacher(teacher, teacher, 16).item() == 0.0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_best_student_of_one_gaussian_is_the_teacher(dtype):
    """Minimise the penalty: the student's mean and standard deviation become those of the teacher."""
    torch.manual_seed(0)
    raw = torch.tensor([[0.7, -0.4]], dtype=dtype)
    gaussian = head("gaussian", REAL)
    teacher, student = gaussian(raw), nn.Parameter(torch.tensor([[-1.0, 1.0]], dtype=dtype))
    optimizer = torch.optim.LBFGS([student], max_iter=50, line_search_fn="strong_wolfe")

    def closure():
        torch.manual_seed(3)
        optimizer.zero_grad()
        value = from_teacher(teacher, gaussian(student), 40_000).sum()
        value.backward()
        return value

    optimizer.step(closure)
    own, wanted = gaussian(student), teacher
    # the best fit to n targets is their mean and standard deviation, which have an error of σ/√n and σ/√(2n)
    scale = wanted.stddev.item()
    assert abs(own.mean.item() - wanted.mean.item()) < 5 * scale / math.sqrt(40_000)
    assert abs(own.stddev.item() - wanted.stddev.item()) < 5 * scale / math.sqrt(80_000)


def test_the_best_student_of_an_ensemble_of_classes_is_the_mean_of_its_probabilities():
    torch.manual_seed(0)
    distillation = objective(teacher=CLASS_TEACHER)
    inputs = torch.randn(1, 6).expand(4, 6)
    student = ConstantPredictor(head("categorical", CLASSES), torch.zeros(3))
    optimizer = torch.optim.LBFGS(student.parameters(), lr=1.0, max_iter=100, tolerance_grad=1e-9)

    def closure():
        optimizer.zero_grad()
        value = distillation(student, {"input": inputs})
        value.backward()
        return value

    optimizer.step(closure)
    members = distillation.teacher.training_densities(inputs)
    mean = members.log_prob(members.enumerate_support()).exp().mean(-1)[:, 0]
    torch.testing.assert_close(student.raw.softmax(0), mean, rtol=1e-4, atol=1e-5)
    assert distillation.logged_terms["distillation"] < 1e-6


def test_members_learn_from_the_inputs_of_one_batch():
    torch.manual_seed(0)

    student = ConstantPredictor(head("von_mises", ANGLE), torch.randn(2, 3), members=True)
    distillation = objective(teacher=ANGLE_TEACHER)
    distillation(student, {"input": torch.randn(8, 6)})
    assert student.recorded[-1].shape == (8, 6)
    ensemble = build(
        "uncertainty",
        resolve("uncertainty", {"name": "ensemble", "members": 2}),
        model=lambda: ConstantPredictor(head("von_mises", ANGLE), torch.randn(3)),
        target=ANGLE,
    )
    with own_batches(ensemble):
        distillation(ensemble, {"input": torch.randn(8, 6)}).backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in ensemble.parameters())


def test_noise_moves_the_inputs_of_teacher_and_student_alike():
    student = ConstantPredictor(head("categorical", CLASSES), torch.zeros(3))
    distillation = objective(teacher=CLASS_TEACHER, noise=0.5)
    seen = []
    distillation.teacher.register_forward_pre_hook(lambda module, arguments: seen.append(arguments[0]))
    inputs = torch.zeros(2000, 6)
    torch.manual_seed(0)
    distillation(student, {"input": inputs})
    assert torch.equal(seen[0], student.recorded[0])
    assert stats.kstest(student.recorded[0].flatten().numpy() / 0.5, "norm").pvalue > 1e-4
    with pytest.raises(ConfigError, match=r"inputs are of type torch\.uint8\. Set noise to 0"):
        distillation(student, {"input": inputs.to(torch.uint8)})


def test_the_teacher_is_neither_trained_nor_stored():
    distillation = objective(teacher=CLASS_TEACHER)
    assert not distillation.state_dict() and not list(distillation.parameters())
    distillation.train()
    assert not distillation.teacher.training
    student = ConstantPredictor(head("categorical", CLASSES), torch.zeros(3))
    distillation(student, {"input": torch.randn(4, 6)}).backward()
    assert all(parameter.grad is None for parameter in distillation.teacher.parameters())


# teachers that are refused


class Sample:
    """Attributes of a data set that `check_data` reads."""

    def __init__(self, **changed):
        self.target, self.input_shape, self.columns = CLASSES, (6,), ()
        self.state = {}
        for name, value in changed.items():
            setattr(self, name, value)

    def state_dict(self):
        return self.state


CONFIG = {"name": "moons", "data_seed": 0}


@pytest.mark.parametrize(
    "changed, config, message",
    [
        ({"target": Target("class", ("a", "b"))}, CONFIG, "another target than this run"),
        (
            {"input_shape": (5,)},
            CONFIG,
            r"another shape of inputs than this run: '?\(6,\)'?, but here '?\(5,\)",
        ),
        ({"columns": ("u",)}, CONFIG, "other input columns"),
        ({"state": {"mean": [0.0]}}, CONFIG, "another state of the data, such as the scaling than"),
        ({}, {**CONFIG, "data_seed": 1}, "trained with data.data_seed = 0, but this run has 1"),
        ({}, {**CONFIG, "more": 1}, "trained with data.more = None"),
    ],
)
def test_a_teacher_of_other_data_is_refused(changed, config, message):
    objective(teacher=CLASS_TEACHER).check_data(Sample(), CONFIG)
    with pytest.raises(ConfigError, match=message):
        objective(teacher=CLASS_TEACHER).check_data(Sample(**changed), config)


def test_other_settings_of_the_data_are_accepted_on_request_only():
    distillation = objective(teacher=CLASS_TEACHER, other_data=True)
    distillation.check_data(Sample(), {**CONFIG, "data_seed": 1})
    with pytest.raises(ConfigError, match="another shape of inputs"):
        distillation.check_data(Sample(input_shape=(5,)), CONFIG)


def test_the_scaling_of_the_inputs_is_compared_number_by_number():
    state = {"mean": torch.tensor([1.0, math.nan]), "names": ("u", "v")}
    teacher = write_teacher("scaled", CLASSES, "categorical", members=None, data_state=state)
    distillation = objective(teacher=teacher)
    distillation.check_data(Sample(state={"mean": np.array([1.0, math.nan]), "names": ["u", "v"]}), CONFIG)
    with pytest.raises(ConfigError, match="another state of the data"):
        distillation.check_data(Sample(state={"mean": [1.0, 2.0], "names": ["u", "v"]}), CONFIG)
    assert not _equal([1.0], [1.0, 2.0]) and not _equal({"a": 1}, {"b": 1}) and not _equal([1], 1)


def test_without_a_teacher_there_is_nothing_to_learn(tmp_path):
    with pytest.raises(ConfigError, match="teacher is null, but distillation learns from a trained model"):
        Distillation()
    with pytest.raises(CheckpointError, match="contains no checkpoint"):
        objective(teacher=str(tmp_path))


@pytest.mark.parametrize(
    "config", [{"weight": 0.0}, {"draws": 0}, {"noise": -1.0}, {"noise": float("nan")}, {"teacher": 3}]
)
def test_refuses_a_config_out_of_range(config):
    with pytest.raises(ConfigError, match=r"objective\."):
        resolve("objective", {"name": "distillation", **config})
