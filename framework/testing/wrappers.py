"""The contract of an uncertainty wrapper: one function a property, each reporting the worst case it saw."""

from collections.abc import Callable, Iterable, Iterator

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from framework.data import Batch
from framework.distributions.circular import Circular
from framework.model import Predictor
from framework.target import Target
from framework.testing.densities import integral, samples_follow_log_prob
from framework.testing.finding import SEED, Finding, Worst, examined
from framework.testing.heads import values
from framework.testing.metrics import density_about, numbers_about
from framework.testing.rows import WrapperRow
from framework.uncertainty import Uncertainty

Make = Callable[[], Uncertainty]
LENGTH = 6


class Plain(Predictor):
    """What is wrapped: one linear layer to the place of the simplest density of the target's kind."""

    def __init__(self, target: Target) -> None:
        super().__init__()
        self.target = target
        self.dropout = nn.Dropout(0.1)  # for wrappers that need one
        self.layer = nn.Linear(LENGTH, numbers_about(target))

    def forward(self, inputs: Tensor) -> Distribution:
        return density_about(self.target, self.layer(self.dropout(inputs)))

    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        return -self(inputs).log_prob(target)

    def training_densities(self, inputs: Tensor) -> Distribution:
        return self(inputs)

    def calibrate(self, batches: Iterable[Batch]) -> None:
        pass


def examine_wrapper(
    row: WrapperRow, build: Make, build_identity: Callable[[Callable[[], Predictor]], Uncertainty] | None
) -> Iterator[Finding]:
    """Every property of one wrapper around `Plain`, fresh for each.

    Args:
        build_identity: builds it around a given model such that it must be that model; None where it cannot be.
    """

    def make() -> Uncertainty:
        torch.manual_seed(SEED)
        return build().eval()

    checks: dict[str, tuple[float, Callable[[Worst], None]]] = {
        "densities": (0.0, lambda worst: _densities(make, row, worst)),
        "same seed, same bits": (0.0, lambda worst: _repeatable(make, row, worst)),
        "loss and its gradient": (0.0, lambda worst: _loss(make, row, worst)),
        "state-dict round trip": (0.0, lambda worst: _round_trip(make, build, row, worst)),
        "calibration": (0.0, lambda worst: _calibration(make, row, worst)),
        "integral": (1e-5, lambda worst: _of_density(make, row, integral, worst)),
        "samples follow log_prob": (
            5.0,
            lambda worst: _of_density(make, row, samples_follow_log_prob, worst),
        ),
    }
    if build_identity is not None:
        checks["one member is the member"] = (0.0, lambda worst: _identity(build_identity, row, worst))
    for name, (limit, check) in checks.items():
        if name not in row.leave_out:
            yield examined(name, row.limits.get(name, limit), check)


def inputs(count: int) -> Tensor:
    return torch.randn(count, LENGTH, generator=torch.Generator().manual_seed(SEED))


def batches(row: WrapperRow) -> list[Batch]:
    """A small labelled validation set."""
    target = values(row.target, (40,))
    parts = zip(inputs(40).split(16), target.split(16), strict=True)
    return [{"input": some, "target": labels} for some, labels in parts]


def _densities(make: Make, row: WrapperRow, worst: Worst) -> None:
    event = row.target.event_shape
    wrapper = make()
    with torch.no_grad():
        for count in (0, 1, 5):
            density = wrapper(inputs(count))
            target = values(row.target, (count,))
            worst.same(f"batch_shape of {count}", tuple(density.batch_shape), (count,))
            worst.same(f"event_shape of {count}", tuple(density.event_shape), event)
            log_prob = density.log_prob(target)
            worst.same(f"log_prob of {count}", tuple(log_prob.shape), (count,))
            worst.finite(f"log_prob of {count}", log_prob)
            if row.target.kind == "angle":
                worst.count(
                    not isinstance(density.support, Circular), f"support: {density.support}, wanted angles"
                )
            if count:
                worst.same(f"sample of {count}", tuple(density.sample().shape), (count, *event))
                worst.same(f"entropy of {count}", tuple(density.entropy().shape), (count,))


def _repeatable(make: Make, row: WrapperRow, worst: Worst) -> None:
    target = values(row.target, (5,))
    found = []
    with torch.no_grad():
        for _ in range(2):
            wrapper = make()
            torch.manual_seed(SEED)
            found.append(wrapper(inputs(5)).log_prob(target))
    worst.same_bits("log_prob of two wrappers of one seed", *found)


def _loss(make: Make, row: WrapperRow, worst: Worst) -> None:
    wrapper = make().train()
    loss = wrapper.loss(inputs(8), values(row.target, (8,)))
    worst.same("shape of the loss of 8", tuple(loss.shape), (8,))
    worst.finite("loss", loss)
    loss.sum().backward()
    found = [parameter.grad for parameter in wrapper.parameters() if parameter.grad is not None]
    worst.count(not found, "no parameter has a gradient")
    for gradient in found:
        worst.finite("gradient", gradient)


def _round_trip(make: Make, build: Make, row: WrapperRow, worst: Worst) -> None:
    """What calibrate fitted is stored too."""
    wrapper = make()
    wrapper.calibrate(batches(row))
    torch.manual_seed(SEED + 7)  # so that a parameter which is not stored starts elsewhere
    other = build().eval()
    other.load_state_dict(wrapper.state_dict())
    target = values(row.target, (5,))
    with torch.no_grad():
        torch.manual_seed(SEED)
        first = wrapper(inputs(5)).log_prob(target)
        torch.manual_seed(SEED)
        worst.same_bits("log_prob of the stored state", other(inputs(5)).log_prob(target), first)


def _calibration(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Does not train: parameters stay, and the densities after it are finite, on ordinary and on hopeless labels."""
    for what, labelled in {"ordinary": batches(row), "all alike": _alike(row)}.items():
        wrapper = make()
        before = {name: parameter.clone() for name, parameter in wrapper.named_parameters()}
        wrapper.calibrate(labelled)
        for name, parameter in wrapper.named_parameters():
            worst.same_bits(f"parameter {name} after calibrate, labels {what}", parameter, before[name])
        with torch.no_grad():
            found = wrapper(inputs(5)).log_prob(values(row.target, (5,)))
        worst.finite(f"log_prob after calibrate, labels {what}", found)


def _alike(row: WrapperRow) -> list[Batch]:
    return [{**batch, "target": torch.zeros_like(batch["target"])} for batch in batches(row)]


def _of_density(
    make: Make, row: WrapperRow, check: Callable[[Distribution, Worst], None], worst: Worst
) -> None:
    wrapper = make().double()
    with torch.no_grad():
        check(wrapper(inputs(3).double()), worst)


def _identity(
    build_identity: Callable[[Callable[[], Predictor]], Uncertainty], row: WrapperRow, worst: Worst
) -> None:
    """With the row's `identity` config the wrapper's density is the wrapped model's."""
    torch.manual_seed(SEED)
    member = Plain(row.target).eval()
    wrapper = build_identity(lambda: member).eval()
    target, given = values(row.target, (64,)), 4 * inputs(64)  # places several turns apart
    with torch.no_grad():
        whole, alone = wrapper(given), member(given)
        worst.same_bits("log_prob", whole.log_prob(target), alone.log_prob(target))
        worst.same_bits("mode", whole.mode, alone.mode)
