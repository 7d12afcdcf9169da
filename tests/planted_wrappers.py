"""Uncertainty wrappers like those of other authors: two correct ones, and ones with a planted fault."""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.distributions import Distribution, MultivariateNormal

from framework.data import Batch
from framework.distributions.batch_shapes import Stacked
from framework.distributions.density import Mixture
from framework.distributions.protocol import cdf, median
from framework.distributions.tempering import temper
from framework.model import Predictor, independent_penalty
from framework.uncertainty import SelfTraining, Uncertainty
from tests.planted_base import PlantedForTarget as Fault
from tests.planted_heads import CLASSES, HEIGHT, ONE, PLACE, Changed

TEMPERATURES = torch.logspace(-1, 1.3, 24, dtype=torch.float64)


class Tempered(Uncertainty):
    """Tempers each density; the temperature on a grid with the highest validation likelihood is used."""

    bibtex = ""
    temperature: Tensor

    def __init__(self, model: Callable[[], Predictor]) -> None:
        super().__init__()
        self.model = model()
        self.register_buffer("temperature", torch.ones((), dtype=torch.float64))

    def forward(self, inputs: Tensor) -> Distribution:
        return temper(self.model(inputs), self.temperature)

    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        return self.model.loss(inputs, target)

    def training_densities(self, inputs: Tensor) -> Distribution:
        return self.model.training_densities(inputs)

    def calibrate(self, batches: Iterable[Batch]) -> None:
        seen = list(batches)
        self.model.calibrate(seen)
        self.fit(seen)

    @torch.no_grad()
    def fit(self, seen: list[Batch]) -> None:
        training = self.model.training
        self.model.eval()
        values = [self.value(seen, one) for one in (torch.ones(()).double(), *TEMPERATURES)]
        self.model.train(training)
        best = int(torch.stack(values).argmax())
        self.temperature.fill_(1.0 if best == 0 else TEMPERATURES[best - 1])

    def value(self, seen: list[Batch], temperature: Tensor) -> Tensor:
        return self.log_probs(seen, temperature).mean()

    def log_probs(self, seen: list[Batch], temperature: Tensor) -> Tensor:
        parts = [temper(self.model(one["input"]), temperature).log_prob(one["target"]) for one in seen]
        return torch.cat(parts).double()


class Weighted(Uncertainty):
    """Mixture of two models; the weights on a grid with the highest validation likelihood are used."""

    bibtex = ""
    share: Tensor

    def __init__(self, model: Callable[[], Predictor]) -> None:
        super().__init__()
        self.models = nn.ModuleList([model(), model()])
        self.register_buffer("share", torch.full((), 0.5, dtype=torch.float64))

    def each(self) -> list[Predictor]:
        return [model for model in self.models if isinstance(model, Predictor)]

    def forward(self, inputs: Tensor) -> Distribution:
        return self.mixed(inputs, self.share)

    def mixed(self, inputs: Tensor, share: Tensor) -> Mixture:
        components = Stacked([model(inputs) for model in self.each()])
        weights = torch.stack([share, 1 - share]).log().to(inputs.dtype)
        return Mixture(weights.expand(components.batch_shape), components)

    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        return independent_penalty(torch.stack([model.loss(inputs, target) for model in self.each()], 1))

    def training_densities(self, inputs: Tensor) -> Distribution:
        return Stacked([model.training_densities(inputs) for model in self.each()])

    @torch.no_grad()
    def calibrate(self, batches: Iterable[Batch]) -> None:
        seen = list(batches)
        for model in self.each():
            model.calibrate(seen)
        shares = torch.linspace(0.02, 0.98, 25, dtype=torch.float64, device=self.share.device)
        values = [
            torch.cat([self.mixed(one["input"], share).log_prob(one["target"]) for one in seen])
            .double()
            .mean()
            for share in shares
        ]
        self.share.fill_(shares[int(torch.stack(values).argmax())])


def answering(kind: type[Uncertainty], **parts: Callable[..., Any]) -> type[Uncertainty]:
    """Return a wrapper class whose densities have replaced results, as in `Changed`."""

    class Answering(kind):  # pyright: ignore[reportGeneralTypeIssues, reportUntypedBaseClass]
        def forward(self, inputs: Tensor) -> Distribution:
            return Changed(super().forward(inputs), parts)

    return Answering


def first(density: Any) -> Distribution:
    """Return the mixture with all weight on the first component."""
    weights = torch.full_like(density.log_weights, -math.inf)
    weights[..., 0] = 0.0
    return Mixture(weights, density.components)


class Averaged(Weighted):
    def forward(self, inputs: Tensor) -> Distribution:
        parts = [model(inputs) for model in self.each()]
        mean = torch.stack([part.mean for part in parts]).mean(0)
        root = torch.stack([part.scale_tril.expand(*mean.shape, -1) for part in parts]).mean(0)  # pyright: ignore
        return MultivariateNormal(mean, scale_tril=root, validate_args=False)


class TrainsTheFirst(Weighted):
    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        return self.each()[0].loss(inputs, target)


class Ascends(Tempered):
    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        return self.model(inputs).log_prob(target)


class WeighsTheBatch(Weighted):
    """Gives more weight to the model with the lower mean entropy over the batch."""

    def forward(self, inputs: Tensor) -> Distribution:
        found = super().forward(inputs)
        assert isinstance(found, Mixture)
        if not inputs.shape[0]:
            return found
        sure = -found.components.entropy().mean(0)
        return Mixture(found.log_weights + 3 * sure, found.components)


class TheWrongWay(Tempered):
    def forward(self, inputs: Tensor) -> Distribution:
        return temper(self.model(inputs), 1 / self.temperature)


class OnTheFirstBatch(Tempered):
    def fit(self, seen: list[Batch]) -> None:
        super().fit(seen[:1])


class OnTheLastBatch(Tempered):
    def calibrate(self, batches: Iterable[Batch]) -> None:
        for batch in batches:
            self.model.calibrate([batch])
            self.fit([batch])


class EveryBatchAlike(Tempered):
    def value(self, seen: list[Batch], temperature: Tensor) -> Tensor:
        return torch.stack([self.log_probs([one], temperature).mean() for one in seen]).mean()


class WholeBatchesOnly(Tempered):
    """Fits only to batches of full size, as a loader with drop_last=True would return them."""

    def fit(self, seen: list[Batch]) -> None:
        size = max(len(one["target"]) for one in seen)
        super().fit([one for one in seen if len(one["target"]) == size])


class NothingIsLeft(Tempered):
    """Calibrates the wrapped model with the iterator of batches, which is then exhausted."""

    def calibrate(self, batches: Iterable[Batch]) -> None:
        self.model.calibrate(batches)
        seen = list(batches)
        if seen:
            self.fit(seen)


class ForgetsTheWrapped(Tempered):
    def calibrate(self, batches: Iterable[Batch]) -> None:
        self.fit(list(batches))


class CalibratesTheWrappedLast(Tempered):
    def calibrate(self, batches: Iterable[Batch]) -> None:
        seen = list(batches)
        self.fit(seen)
        self.model.calibrate(seen)


class OnTheBestHalf(Tempered):
    """Fits to the half of the rows with the highest log-likelihood."""

    def value(self, seen: list[Batch], temperature: Tensor) -> Tensor:
        found = self.log_probs(seen, temperature)
        return found.sort(descending=True).values[: (len(found) + 1) // 2].mean()


class SupposesSizeOne(Tempered):
    """Sets the temperature to the mean squared residual, as if all densities had variance 1."""

    def fit(self, seen: list[Batch]) -> None:
        gap = torch.cat([one["target"] - self.model(one["input"]).mode for one in seen])
        self.temperature.fill_(gap.double().square().mean().item())


class Stays(Tempered):
    """Leaves the model in training mode after `calibrate`."""

    def calibrate(self, batches: Iterable[Batch]) -> None:
        super().calibrate(batches)
        self.train()


class NotStored(Tempered):
    def __init__(self, model: Callable[[], Predictor]) -> None:
        super().__init__(model)
        del self.temperature
        self.temperature = torch.ones((), dtype=torch.float64)


class Detached(Tempered):
    def training_densities(self, inputs: Tensor) -> Distribution:
        with torch.no_grad():
            return self.model.training_densities(inputs)


class Counts(Tempered):
    def __init__(self, model: Callable[[], Predictor]) -> None:
        super().__init__(model)
        self.register_buffer("seen", torch.zeros((), dtype=torch.int64))

    def forward(self, inputs: Tensor) -> Distribution:
        self.seen += 1  # pyright: ignore
        return super().forward(inputs)


class Single(Tempered):
    """Returns float32 densities after calibration."""

    def forward(self, inputs: Tensor) -> Distribution:
        if self.temperature == 1:
            return super().forward(inputs)
        logits = self.model(inputs).logits / self.temperature  # pyright: ignore
        return torch.distributions.Categorical(logits=logits.float(), validate_args=False)


class KnobsDescend(Tempered):
    knobs: ClassVar[Mapping[str, tuple[int, ...]]] = {"passes": (3, 1)}


class TrainsUnseeded(Tempered, SelfTraining):
    """Trains its model itself, with numbers of torch's global generator."""

    def train_models(
        self, inputs: Tensor, target: Tensor, *, seed: int, batch_size: int, most_steps: int | None = None
    ) -> float:
        with torch.no_grad():
            for parameter in self.parameters():
                parameter.add_(0.1 * torch.randn(parameter.shape))
            return self.loss(inputs, target).mean().item()


def unnormalised(density: Any, value: Tensor) -> Tensor:
    return density.log_prob(value) + 0.1


def of_members(density: Any) -> Tensor:
    return (density.log_weights.exp() * density.components.entropy()).sum(-1)


ALL_FAULTS = (
    Fault("entropy is the members' mean, reals", answering(Weighted, entropy=of_members), HEIGHT, "entropy"),
    Fault("entropy is the members' mean, classes", answering(Weighted, entropy=of_members), CLASSES, "entropy"),
    Fault("entropy in bits", answering(Tempered, entropy=lambda d: d.entropy() / math.log(2)), ONE, "entropy"),
    Fault("mode of the first model", answering(Weighted, mode=lambda d: first(d).mode), CLASSES, "mode"),
    Fault("mode is the mean", answering(Weighted, mode=lambda d: d.mean), HEIGHT, "mode"),
    Fault("median of the first model", answering(Weighted, median=lambda d, n: median(first(d), n)), HEIGHT, "median"),
    Fault("cdf of the first model", answering(Weighted, cdf=lambda d, v: cdf(first(d), v)), HEIGHT, "cdf"),
    Fault("variance is the members' mean", answering(Weighted, variance=lambda d: (
        d.log_weights.exp().unsqueeze(-1) * d.components.variance).sum(-2)), PLACE, "mean and variance"),
    Fault("draws of the first model", answering(Weighted, sample=lambda d, s: first(d).sample(s)), ONE,
          "samples follow log_prob"),
    Fault("draws of reals of the first model", answering(Weighted, sample=lambda d, s: first(d).sample(s)), PLACE,
          "samples follow marginals"),
    Fault("power without a normaliser", answering(Tempered, log_prob=unnormalised), HEIGHT, "integral"),
    Fault("parameters are averaged", Averaged, HEIGHT, "training densities"),
    Fault("trains the first model only", TrainsTheFirst, CLASSES, "loss trains all wrapped models"),
    Fault("loss ascends", Ascends, HEIGHT, "loss trains all wrapped models"),
    Fault("no gradient for objectives", Detached, CLASSES, "training densities"),
    Fault("weights by the whole batch", WeighsTheBatch, CLASSES, "batch rows are independent"),
    Fault("temperature the wrong way", TheWrongWay, CLASSES, "calibration does not harm"),
    Fault("temperature the wrong way, of a real", TheWrongWay, HEIGHT, "calibration does not harm"),
    Fault("fitted to the best half", OnTheBestHalf, HEIGHT, "calibration does not harm"),
    Fault("supposes labels of size 1", SupposesSizeOne, HEIGHT, "calibration does not harm"),
    Fault("fitted to the first batch", OnTheFirstBatch, CLASSES, "calibration uses every row"),
    Fault("fitted to the last batch", OnTheLastBatch, HEIGHT, "calibration uses every row"),
    Fault("every batch weighs the same", EveryBatchAlike, HEIGHT, "calibration uses every row"),
    Fault("drops the last batch", WholeBatchesOnly, HEIGHT, "calibration uses every row"),
    Fault("batches that come once are used up", NothingIsLeft, CLASSES, "calibration uses every row"),
    Fault("what is wrapped is not calibrated", ForgetsTheWrapped, CLASSES, "wrapped models are calibrated first"),
    Fault("what is wrapped is calibrated last", CalibratesTheWrappedLast, HEIGHT,
          "wrapped models are calibrated first"),
    Fault("training mode after calibrate", Stays, CLASSES, "no side effects"),
    Fault("counts its answers", Counts, CLASSES, "no side effects"),
    Fault("temperature is not stored", NotStored, CLASSES, "state-dict round trip"),
    Fault("float32 once calibrated", Single, CLASSES, "number types"),
    Fault("knobs descend", KnobsDescend, CLASSES, "knobs can be set"),
    Fault("trains with the global generator", TrainsUnseeded, CLASSES, "trains its models itself"),
)  # fmt: skip

RIGHT: Mapping[str, Callable[[Callable[[], Predictor]], Uncertainty]] = {
    "a power": Tempered,
    "weights of two models": Weighted,
}
TARGETS = (CLASSES, ONE, HEIGHT, PLACE)
