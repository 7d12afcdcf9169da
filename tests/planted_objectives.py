"""Objectives like those of other authors: a correct one, and ones with a planted fault that `mode=check` must find."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from framework.calibration.module_flags import BATCH_NORM, set_flag
from framework.data import Batch
from framework.model import Predictor, independent_penalty
from framework.objective import Objective
from tests.planted_base import PlantedForTarget as Fault
from tests.planted_heads import CLASSES, PLACE


class Confidence(Objective):
    """Objective that penalises large log-densities at the target, for each sample and member."""

    bibtex = ""

    def __init__(self, *, weight: float = 1.0) -> None:
        super().__init__()
        self.weight = weight

    def each(self, predictor: Predictor, batch: Batch) -> Tensor:
        """Return the penalties, (batch,) or (batch, member)."""
        with set_flag(predictor, BATCH_NORM, "track_running_stats", False):  # the loss has counted this batch
            density = predictor.training_densities(batch["input"])
        target = batch["target"]
        if len(density.batch_shape) == 2:
            target = target.unsqueeze(1).expand(len(target), density.batch_shape[1], *target.shape[1:])
        return density.log_prob(target).square().log1p()

    def forward(self, predictor: Predictor, batch: Batch) -> Tensor:
        found = independent_penalty(self.each(predictor, batch))
        return self.weight * (found.mean() if len(found) else found.sum())


class Summed(Confidence):
    def forward(self, predictor: Predictor, batch: Batch) -> Tensor:
        return self.weight * independent_penalty(self.each(predictor, batch)).sum()


class MeanOfMembers(Confidence):
    def forward(self, predictor: Predictor, batch: Batch) -> Tensor:
        return self.weight * self.each(predictor, batch).sum() / max(1, self.each(predictor, batch).numel())


class OfTheSurest(Confidence):
    """Penalises all members with the largest penalty of any member on each sample."""

    def each(self, predictor: Predictor, batch: Batch) -> Tensor:
        found = super().each(predictor, batch)
        return found if found.dim() == 1 else found.amax(-1, keepdim=True).expand_as(found)


class FirstSixtyFour(Confidence):
    def each(self, predictor: Predictor, batch: Batch) -> Tensor:
        return super().each(predictor, {name: field[:64] for name, field in batch.items()})


class DropsTheLast(Confidence):
    def each(self, predictor: Predictor, batch: Batch) -> Tensor:
        return super().each(predictor, batch)[: max(1, len(batch["target"]) // 8 * 8)]


class TellsTheGraph(Confidence):
    def forward(self, predictor: Predictor, batch: Batch) -> Tensor:
        found = super().forward(predictor, batch)
        self.logged_terms = {"confidence": found}
        return found


class TellsEach(Confidence):
    def forward(self, predictor: Predictor, batch: Batch) -> Tensor:
        self.logged_terms = {"confidence": self.each(predictor, batch).detach()}
        return super().forward(predictor, batch)


class Seeds(Confidence):
    def forward(self, predictor: Predictor, batch: Batch) -> Tensor:
        torch.manual_seed(0)
        return super().forward(predictor, batch)


class HidesNaN(Confidence):
    def forward(self, predictor: Predictor, batch: Batch) -> Tensor:
        return super().forward(predictor, batch).nan_to_num()


class Detached(Confidence):
    def each(self, predictor: Predictor, batch: Batch) -> Tensor:
        found = super().each(predictor, batch)
        return found * found.detach()


class Clamped(Confidence):
    def forward(self, predictor: Predictor, batch: Batch) -> Tensor:
        return super().forward(predictor, batch).clamp(max=10)


class Moving(Confidence):
    """Subtracts a running mean of previous penalties."""

    def forward(self, predictor: Predictor, batch: Batch) -> Tensor:
        found = super().forward(predictor, batch)
        seen = getattr(self, "seen", 0.0)
        self.seen: Any = 0.9 * seen + 0.1 * found.item()
        return found - seen


class Evaluates(Confidence):
    """Sets the predictor to evaluation mode and leaves it so."""

    def forward(self, predictor: Predictor, batch: Batch) -> Tensor:
        return super().forward(predictor.eval(), batch)


class Neighbours(Confidence):
    """Weighs each sample by its position in the batch."""

    def each(self, predictor: Predictor, batch: Batch) -> Tensor:
        found = super().each(predictor, batch)
        weight = torch.linspace(0.5, 1.5, len(found), dtype=found.dtype)
        return found * weight.reshape(-1, *(1,) * (found.dim() - 1))


ALL_FAULTS = (
    Fault("a sum over samples", Summed, CLASSES, "a mean over samples"),
    Fault("a mean over members too", MeanOfMembers, CLASSES, "equal members train like one model"),
    Fault("the worst member stands for all", OfTheSurest, CLASSES, "different members train separately"),
    Fault("the first 64 of a batch", FirstSixtyFour, CLASSES, "every sample counts"),
    Fault("the last ones of a batch are left out", DropsTheLast, PLACE, "every sample counts"),
    Fault("logs with the graph", TellsTheGraph, CLASSES, "terms to be logged"),
    Fault("logs every sample", TellsEach, PLACE, "terms to be logged"),
    Fault("seeds the generator", Seeds, CLASSES, "later random numbers follow the seed"),
    Fault("NaN is 0", HidesNaN, PLACE, "NaN is not hidden"),
    Fault("half of the gradient is detached", Detached, PLACE, "gradient"),
    Fault("never above 10", Clamped, PLACE, "weight is a factor"),
    Fault("less what it has seen", Moving, CLASSES, "same seed, same bits"),
    Fault("leaves the evaluation mode", Evaluates, CLASSES, "no side effects"),
    Fault("weighs by place", Neighbours, CLASSES, "order does not matter"),
)

RIGHT: Mapping[str, Callable[..., Objective]] = {"confidence": Confidence}
