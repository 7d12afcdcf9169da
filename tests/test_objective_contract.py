"""Contract tests of objectives, each with the faulty objectives that it finds."""

import pytest
import torch
from torch import nn

from framework.calibration.module_flags import BATCH_NORM, set_flag
from framework.errors import ConfigError
from framework.model import independent_penalty
from framework.objective import Objective
from framework.target import Target
from framework.testing.finding import failures, require
from framework.testing.objectives import examine_objective
from framework.testing.rows import ANGLE, CLASSES, REALS, ObjectiveRow

ROW = ObjectiveRow("reals", Target("real", ("x", "y")))


class Spread(Objective):
    """Correct objective: a penalty of the means of each member."""

    def __init__(self, weight):
        super().__init__()
        if weight <= 0:
            raise ConfigError("weight: wanted more than 0.")
        self.weight = weight

    def places(self, predictor, batch):
        numbers = batch["input"].to(next(predictor.parameters()).dtype)
        norms = [layer for layer in predictor.modules() if isinstance(layer, nn.BatchNorm1d)]
        modes = [layer.training for layer in norms]
        for layer in norms:
            layer.training = False
        found = predictor.training_densities(numbers)
        for layer, mode in zip(norms, modes, strict=True):
            layer.training = mode
        members = getattr(found, "densities", [found])
        return torch.stack([one.loc.square().mean(-1) for one in members], 1)

    def penalty(self, predictor, batch):
        each = self.places(predictor, batch)
        return each.sum() + (each.mean(1).sum() - each.sum()).detach()

    def forward(self, predictor, batch):
        return self.weight * self.penalty(predictor, batch) / max(1, len(batch["input"]))


class Broad(Objective):
    """Correct objective: minus the mean entropy, which depends on the breadth of a density alone."""

    def __init__(self, weight):
        super().__init__()
        self.weight = weight

    def forward(self, predictor, batch):
        inputs = batch["input"].to(next(predictor.parameters()).dtype)
        with set_flag(predictor, BATCH_NORM, "track_running_stats", False):
            entropy = independent_penalty(predictor.training_densities(inputs).entropy())
        return -self.weight * entropy.sum() / max(1, len(entropy))


class Averaging(Spread):
    """Objective that divides the gradient of each member by the number of members."""

    def penalty(self, predictor, batch):
        return self.places(predictor, batch).mean(1).sum()


class Learning(Spread):
    """Objective that changes the running moments of batch norm."""

    def penalty(self, predictor, batch):
        predictor.training_densities(batch["input"].to(next(predictor.parameters()).dtype))
        return super().penalty(predictor, batch)


class Switching(Spread):
    """Objective that leaves the predictor in evaluation mode."""

    def penalty(self, predictor, batch):
        predictor.eval()
        return super().penalty(predictor, batch)


class Backward(Spread):
    """Objective that leaves gradients in the parameters."""

    def penalty(self, predictor, batch):
        found = super().penalty(predictor, batch)
        found.backward(retain_graph=True)
        return found


class Squared(Spread):
    """Objective that is not linear in its weight."""

    def forward(self, predictor, batch):
        return self.weight * super().forward(predictor, batch)


class Detached(Spread):
    """Objective without a gradient."""

    def forward(self, predictor, batch):
        return super().forward(predictor, batch).detach()


class Halved(Spread):
    """Objective with half the gradient of its value."""

    def penalty(self, predictor, batch):
        found = super().penalty(predictor, batch)
        return found / 2 + found.detach() / 2


class Empty(Spread):
    """Objective that computes a mean, which is NaN for an empty batch."""

    def forward(self, predictor, batch):
        return self.weight * self.places(predictor, batch).sum(1).mean()


class Unseeded(Spread):
    """Objective with noise that does not depend on the seed."""

    generator = torch.Generator().manual_seed(0)

    def penalty(self, predictor, batch):
        return super().penalty(predictor, batch) * torch.rand((), generator=self.generator)


class Ordered(Spread):
    """Objective that reads only the first half of the batch."""

    def penalty(self, predictor, batch):
        return super().penalty(predictor, {**batch, "input": batch["input"][: len(batch["input"]) // 2]})


class Narrow(Spread):
    """Objective that always computes in float32."""

    def forward(self, predictor, batch):
        return super().forward(predictor, batch).float()


class Overflowing(Spread):
    """Objective that returns the exponential of its penalty."""

    def penalty(self, predictor, batch):
        return super().penalty(predictor, batch).exp()


class Marking(Spread):
    """Objective that leaves the inputs with requires_grad."""

    def penalty(self, predictor, batch):
        batch["input"].requires_grad_()
        return super().penalty(predictor, batch)


def test_a_sound_objective_passes():
    require(*examine_objective(ROW, Spread))


@pytest.mark.parametrize("target", [CLASSES, ANGLE, REALS], ids=lambda target: target.kind)
def test_a_sound_objective_of_the_breadth_alone_passes(target):
    require(*examine_objective(ObjectiveRow("entropy", target), Broad))


@pytest.mark.parametrize(
    "kind, caught",
    [
        (Averaging, "equal members train like one model"),
        (Learning, "no side effects"),
        (Switching, "no side effects"),
        (Backward, "no side effects"),
        (Marking, "no side effects"),
        (Squared, "weight is a factor"),
        (Detached, "a finite scalar"),
        (Halved, "gradient"),
        (Empty, "empty and single batches"),
        (Unseeded, "same seed, same bits"),
        (Ordered, "order does not matter"),
        (Narrow, "number types"),
        (Overflowing, "extreme raw parameters"),
    ],
)
def test_an_unsound_objective_is_caught(kind, caught):
    assert caught in failures(examine_objective(ROW, kind))


def test_what_a_row_leaves_out_is_not_examined():
    row = ObjectiveRow("reals", ROW.target, leave_out={"gradient": "it has none"})
    names = [finding.name for finding in examine_objective(row, Spread)]
    assert "gradient" not in names and "no side effects" in names
