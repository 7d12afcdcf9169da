"""Density heads that are wrong on purpose, each in one thing: what `mode=check` is worth is how many of them it finds.

Every head is a shipped one whose density or loss is changed by one function; nothing else of it is.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints

from framework.density_head import DensityHead
from framework.distributions.circular import circular, wrap
from framework.distributions.protocol import arc, cdf, estimate, exactly, marginal, median
from framework.target import Target
from framework.testing.densities import CHECKS, examine_densities
from framework.testing.finding import Finding
from framework.testing.heads import HeadSubject, examine_head
from framework.testing.rows import HeadRow
from plugins.density_head.categorical.head import CategoricalHead
from plugins.density_head.gaussian.density import Gaussian
from plugins.density_head.gaussian.head import GaussianHead
from plugins.density_head.von_mises.density import VonMises
from plugins.density_head.von_mises.head import VonMisesHead
from plugins.density_head.von_mises.rows import predicted

OF_DENSITIES = {check.name for check in CHECKS}
Parts = Mapping[str, Callable[..., Any]]
ONE, TWO, THREE = (Target("angle", ("azimuth", "elevation", "tilt")[:count]) for count in (1, 2, 3))
HEIGHT, PLACE = Target("real", ("height",)), Target("real", ("x", "y"))
CLASSES = Target("class", ("a", "b", "c"))
NO_CASES = {"floor": 1e-9}
"""Parameters for which no reference is given."""


class Changed(Distribution):
    """A density of which some answers are replaced: name → function of the sound density and the arguments."""

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}

    def __init__(self, density: Distribution, parts: Parts) -> None:
        self.density = density
        self.parts = parts
        self.has_enumerate_support = density.has_enumerate_support
        super().__init__(density.batch_shape, density.event_shape, validate_args=False)

    def ask(self, name: str, *arguments: Any) -> Any:
        """The replaced answer, or the sound one."""
        if name in self.parts:
            return self.parts[name](self.density, *arguments)
        found = getattr(self.density, name)
        return found(*arguments) if callable(found) else found

    def log_prob(self, value: Tensor) -> Tensor:
        return self.ask("log_prob", value)

    def sample(self, sample_shape: Any = ()) -> Tensor:
        return self.ask("sample", torch.Size(sample_shape))

    def entropy(self) -> Tensor:
        return self.ask("entropy")

    def enumerate_support(self, expand: bool = True) -> Tensor:
        return self.ask("enumerate_support", expand)

    @property
    def mode(self) -> Tensor:
        return self.ask("mode")

    @property
    def mean(self) -> Tensor:
        return self.ask("mean")

    @property
    def variance(self) -> Tensor:
        return self.ask("variance")

    @property
    def support(self) -> Any:
        return self.ask("support")


estimate.register(Changed, exactly)


@marginal.register
def _(density: Changed, index: int) -> Distribution:
    if "marginal" in density.parts:
        return density.parts["marginal"](density.density, index)
    return density if density.event_shape == (1,) else marginal(density.density, index)


@median.register
def _(density: Changed, samples: int) -> Tensor:
    return density.parts.get("median", median)(density.density, samples)


@cdf.register
def _(density: Changed, value: Tensor) -> Tensor | None:
    return density.parts.get("cdf", cdf)(density.density, value)


@arc.register
def _(density: Changed, start: Tensor, end: Tensor) -> Tensor | None:
    return density.parts.get("arc", arc)(density.density, start, end)


class Faulty(DensityHead):
    """A sound head with changed answers; `forward`, `loss` and `calibrate` may be replaced too, given this head."""

    bibtex = ""
    knobs: ClassVar[Mapping[str, tuple[int, ...]]] = {}

    def __init__(self, sound: DensityHead, parts: Parts) -> None:
        super().__init__()
        self.sound = sound
        self.parts = parts
        self.size = sound.size
        self.calls = 0
        self.offset = float(torch.rand(()))
        self.weight = torch.nn.Parameter(torch.ones(())) if "calibrate" in parts else None
        self.samples = 1
        if "knobs" in parts:
            self.knobs = parts["knobs"]()  # pyright: ignore[reportAttributeAccessIssue]

    def forward(self, raw: Tensor) -> Distribution:
        found = self.parts["forward"](self, raw) if "forward" in self.parts else self.sound(raw)
        return Changed(found, self.parts)

    def loss(self, raw: Tensor, target: Tensor) -> Tensor:
        if "loss" in self.parts:
            return self.parts["loss"](self.sound, raw, target)
        return -self(raw).log_prob(target)

    def calibrate(self, raw: Tensor, target: Tensor) -> None:
        self.parts["calibrate"](self, raw) if "calibrate" in self.parts else self.sound.calibrate(raw, target)


@dataclass(frozen=True)
class Fault:
    """One wrong head.

    Attributes:
        name: what is wrong.
        target: what it predicts.
        parts: the answers that are replaced.
        only: the one property that is to find it; "" where several may.
        config: of the sound head.
    """

    name: str
    target: Target
    parts: Parts
    only: str = ""
    config: Mapping[str, Any] = field(default_factory=dict)

    def findings(self) -> Iterator[Finding]:
        """Every finding; those of densities first where they are to find it, since nobody need ask further."""
        kinds = {"angle": VonMisesHead, "real": GaussianHead, "class": CategoricalHead}

        def build() -> DensityHead:
            return Faulty(kinds[self.target.kind](self.target, **self.config), self.parts)

        cases = predicted if self.target.kind == "angle" and not self.config else None
        subject = HeadSubject(HeadRow(self.name, self.target, cases=cases), build)
        groups = [examine_head(subject), examine_densities(subject)]
        for group in groups[::-1] if self.only in OF_DENSITIES else groups:
            yield from group


def off(by: float, where: Callable[[Tensor], Tensor]) -> Callable[..., Tensor]:
    """A log-density that is off where the parameter (κ or σ of the first number) fulfils a condition."""
    return lambda density, value: density.log_prob(value) + by * where(spread_of(density)[..., 0])


def spread_of(density: Distribution) -> Tensor:
    return density.concentration if isinstance(density, VonMises) else density.scale  # pyright: ignore


def width(density: Distribution) -> Tensor:
    """About a standard deviation."""
    if isinstance(density, VonMises):
        return (1 / (1 + density.concentration)).sqrt()
    return density.scale  # pyright: ignore[reportAttributeAccessIssue]


def everywhere(parameter: Tensor) -> Tensor:
    return torch.ones_like(parameter)


def with_slope(factor: float, where: Callable[[Tensor], Tensor]) -> Callable[..., Tensor]:
    """A loss of the right value whose gradient in κ is multiplied by `factor` in a region."""

    def loss(head: DensityHead, raw: Tensor, target: Tensor) -> Tensor:
        density = head(raw)
        kappa = density.concentration
        bent = factor * kappa + (1 - factor) * kappa.detach()
        return -VonMises(density.location, torch.where(where(kappa), bent, kappa)).log_prob(target)

    return loss


def capped(density: Any, shape: torch.Size) -> Tensor:
    return VonMises(density.location, density.concentration.clamp(max=1e3)).sample(shape)


def remembering(head: Faulty, raw: Tensor) -> Distribution:
    head.calls += 1
    return head.sound(raw * (1 + 1e-3 * head.calls))


def batch_wide(head: Faulty, raw: Tensor) -> Distribution:
    mean = raw.detach().mean(0, keepdim=True) if raw.dim() > 1 and raw.numel() else 0.0
    return head.sound(raw - 0.1 * mean)


def unseeded(density: Any, shape: torch.Size) -> Tensor:
    with torch.random.fork_rng():
        torch.seed()
        return density.sample(shape)


def in_half(density: Any, value: Tensor) -> Tensor:
    return density.log_prob(value.half().float() if value.dtype == torch.float32 else value)


def nan_far(density: Any, value: Tensor) -> Tensor:
    found = density.log_prob(value)
    return torch.where(density.concentration[..., 0] > 1e8, math.nan, found)


def refusing(what: Callable[[Tensor], bool], error: str) -> Callable[..., Distribution]:
    def forward(head: Faulty, raw: Tensor) -> Distribution:
        if what(raw):
            raise RuntimeError(error)
        return head.sound(raw)

    return forward


def accepting(head: Faulty, raw: Tensor) -> Distribution:
    return head.sound(raw.nan_to_num(0.0, 0.0, 0.0))


def nameless(head: Faulty, raw: Tensor) -> Distribution:
    if not raw.isfinite().all():
        raise ValueError("bad numbers")
    return head.sound(raw)


def shared_noise(density: Any, shape: torch.Size) -> Tensor:
    """The same draws for every row of the batch."""
    whole = (*shape, *density.location.shape)
    noise = torch.randn(*shape, *([1] * len(density.batch_shape)), 1, dtype=density.scale.dtype)
    return density.location + density.scale * noise.expand(whole)


def worse(head: Faulty, raw: Tensor) -> None:
    head.sound.concentration.fill_(1e6)  # pyright: ignore


def changes_parameter(head: Faulty, raw: Tensor) -> None:
    assert head.weight is not None
    head.weight.data.add_(1.0)


def smoothed(density: Any, value: Tensor) -> Tensor:
    return density.log_prob(value).clamp(min=math.log(1e-3))


def below_labels(density: Any, shape: torch.Size) -> Tensor:
    return density.sample(shape).clamp(max=1)


def second_as_first(density: Any, shape: torch.Size) -> Tensor:
    """Both numbers from one noise: each marginal is right."""
    noise = torch.randn(*shape, *density.batch_shape, 1, dtype=density.scale.dtype)
    return density.location + density.scale * noise


def no_second(density: Any, shape: torch.Size) -> Tensor:
    drawn = density.sample(shape)
    return torch.stack([drawn[..., 0], density.location[..., 1].expand_as(drawn[..., 1])], -1)


def first_only(density: Any) -> Tensor:
    return marginal(density, 0).entropy()


def laplace(density: Any, shape: torch.Size) -> Tensor:
    drawn = torch.rand((*shape, *density.location.shape), dtype=density.scale.dtype)
    return density.location + density.scale * math.sqrt(12) * (drawn - 0.5)


def fitting_entropy(density: Any) -> Tensor:
    """Of p exp(c), c = 3e-6."""
    return math.exp(3e-6) * (density.entropy() - 3e-6)


def lower_for_narrow(density: Any) -> Tensor:
    return density.entropy() - 0.1 * (density.concentration[..., 0] > 1e3)


def four_know_each_other(head: Faulty, raw: Tensor) -> Distribution:
    return head.sound(raw + 0.01 * raw.detach().tanh().mean(0) if raw.dim() > 1 and len(raw) == 4 else raw)


def counting(head: Faulty, raw: Tensor) -> Distribution:
    if not head.training:
        head.sound.calls = getattr(head.sound, "calls", 0) + 1  # pyright: ignore
    return head.sound(raw)


def counted_loss(sound: DensityHead, raw: Tensor, target: Tensor) -> Tensor:
    return getattr(sound, "calls", 0) - sound(raw).log_prob(target)


def doubled_when_stacked(head: Faulty, raw: Tensor) -> Distribution:
    return head.sound(raw * 1.5 if raw.dim() == 3 and raw.shape[-2] == 1 else raw)


ALL_FAULTS = (
    # one angle
    Fault("normaliser 1e-3 off for κ > 1e4", ONE, {"log_prob": off(1e-3, lambda k: k > 1e4)}),
    Fault("normaliser 0.1 nat off for κ < 0.01", ONE, {"log_prob": off(0.1, lambda k: k < 0.01)}),
    Fault("log_prob in bits", ONE, {"log_prob": lambda d, v: d.log_prob(v) / math.log(2)}),
    Fault(
        "κ's gradient flips sign for κ > 1e4",
        ONE,
        {"loss": with_slope(-1, lambda k: k > 1e4)},
        "loss gradient",
    ),
    Fault(
        "κ's gradient is 1 % small for κ < 0.05",
        ONE,
        {"loss": with_slope(0.99, lambda k: k < 0.05)},
        "loss gradient",
    ),
    Fault("κ has no gradient for κ > 1e6", ONE, {"loss": with_slope(0, lambda k: k > 1e6)}, "loss gradient"),
    Fault("sampler caps κ at 1e3", ONE, {"sample": capped}, "samples follow log_prob"),
    Fault("sampler 0.2 deviations off", ONE, {"sample": lambda d, s: d.sample(s) + 0.2 * width(d)}),
    Fault(
        "sampler a tenth too wide for κ > 100",
        ONE,
        {
            "sample": lambda d, s: VonMises(
                d.location, torch.where(d.concentration > 100, d.concentration / 1.21, d.concentration)
            ).sample(s)
        },
        "samples follow log_prob",
    ),
    Fault(
        "sampler leaves out the arc beyond ±3", ONE, {"sample": lambda d, s: wrap(d.sample(s)).clamp(-3, 3)}
    ),
    Fault("entropy 0.1 nat off", ONE, {"entropy": lambda d: d.entropy() + 0.1}, "entropy"),
    Fault(
        "entropy 1e-3 off for κ > 1e4",
        ONE,
        {"entropy": lambda d: d.entropy() + 1e-3 * (d.concentration[..., 0] > 1e4)},
        "entropy",
    ),
    Fault(
        "entropy is NaN for κ > 1e6",
        ONE,
        {"entropy": lambda d: torch.where(d.concentration[..., 0] > 1e6, math.nan, d.entropy())},
        "entropy",
    ),
    Fault("mode π off where |μ| > 3", ONE, {"mode": lambda d: d.mode + math.pi * (d.mode.abs() > 3)}, "mode"),
    Fault("mode half a deviation off", ONE, {"mode": lambda d: d.mode + 0.5 * width(d)}, "mode"),
    Fault("median 0.1 deviations off", ONE, {"median": lambda d, n: d.mode + 0.1 * width(d)}, "median"),
    Fault(
        "median is the antipode where |μ| > 2",
        ONE,
        {"median": lambda d, n: d.mode + math.pi * (d.mode.abs() > 2)},
        "median",
    ),
    Fault("log_prob ends at ±π", ONE, {"log_prob": lambda d, v: d.log_prob(v.clamp(-math.pi, math.pi))}),
    Fault(
        "log_prob drifts with the turns",
        ONE,
        {"log_prob": lambda d, v: d.log_prob(v) + 1e-3 * ((v - wrap(v)).abs() > 1).sum(-1)},
    ),
    Fault(
        "log_prob wrong at ±π itself",
        ONE,
        {"log_prob": lambda d, v: d.log_prob(v) + (v.abs() == math.pi).sum(-1)},
        "2π-periodic",
        {"concentration": "fixed"},
    ),
    Fault("half precision inside, of float32 only", ONE, {"log_prob": in_half}),
    Fault(
        "3e-6 off in float32 only",
        ONE,
        {"log_prob": lambda d, v: d.log_prob(v) * (1 + 3e-6 * (d.location.dtype == torch.float32))},
        "log_prob, float32",
    ),
    Fault(
        "2e-5 off in float32 for κ > 1e4 only",
        ONE,
        {
            "log_prob": lambda d, v: (
                d.log_prob(v)
                * (1 + 2e-5 * (d.concentration[..., 0] > 1e4) * (d.location.dtype == torch.float32))
            )
        },
    ),
    Fault(
        "κ a hundredth large, in everything",
        ONE,
        {"forward": lambda h, r: h.sound(torch.where(r.abs() < 1e30, 1.01 * r, r))},
    ),
    Fault(
        "a batch of shape () has one row",
        ONE,
        {"forward": lambda h, r: h.sound(r.reshape(-1, r.shape[-1]) if r.dim() == 1 else r)},
        "batch shapes",
    ),
    Fault(
        "an empty batch raises", ONE, {"forward": refusing(lambda r: r.numel() == 0, "empty")}, "batch shapes"
    ),
    Fault("says that angles are reals", ONE, {"support": lambda d: constraints.real_vector}),
    Fault("NaN for κ > 1e8", ONE, {"log_prob": nan_far}),
    Fault(
        "raises for raw numbers beyond 1e15",
        ONE,
        {
            "forward": refusing(
                lambda r: bool((r.abs() > 1e15).any()) and bool(r.isfinite().all()), "too large"
            )
        },
        "finite for any raw numbers",
    ),
    Fault("depends on its neighbours in the batch", ONE, {"forward": batch_wide}),
    Fault("float64 becomes float32", ONE, {"log_prob": lambda d, v: d.log_prob(v).float()}),
    Fault(
        "half precision is not upcast",
        ONE,
        {"forward": lambda h, r: Halved(h.sound(r)) if r.dtype == torch.float16 else h.sound(r)},
        "number types",
    ),
    Fault("NaN is accepted", ONE, {"forward": accepting}, "NaN and infinity refused"),
    Fault("NaN is refused without naming the row", ONE, {"forward": nameless}, "NaN and infinity refused"),
    Fault("state kept between calls", ONE, {"forward": remembering}),
    Fault("samples heed no seed", ONE, {"sample": unseeded}),
    Fault(
        "a number that is not stored",
        ONE,
        {"forward": lambda h, r: h.sound(r * (1 + 1e-9 * h.offset) + 1e-3 * h.offset)},
    ),
    Fault(
        "loss punishes large κ",
        ONE,
        {"loss": lambda h, r, t: -h(r).log_prob(t) + 0.1 * (1 + h(r).concentration[..., 0]).log()},
        "loss is least for its own density",
    ),
    Fault(
        "loss of the mirrored angle",
        ONE,
        {"loss": lambda h, r, t: -h(r).log_prob(-t)},
        "loss is least for its own density",
    ),
    Fault("loss is constant", ONE, {"loss": lambda h, r, t: 0 * r.sum(-1) + 0 * t.sum(-1) + 1}),
    Fault(
        "calibrate makes it worse",
        ONE,
        {"calibrate": worse},
        "calibrate does not harm",
        {"concentration": "fixed"},
    ),
    Fault(
        "calibrate changes a parameter",
        ONE,
        {"calibrate": changes_parameter},
        "state-dict round trip",
        {"concentration": "fixed"},
    ),
    Fault(
        "another density as a component",
        ONE,
        {"forward": doubled_when_stacked},
        "mixture of one is the component",
    ),
    Fault("knobs descend", ONE, {"knobs": lambda: {"samples": (3, 1)}}, "knobs turn"),
    Fault(
        "arc of the density at half κ",
        ONE,
        {"arc": lambda d, a, b: arc(VonMises(d.location, d.concentration / 2), a, b)},
        "cdf",
    ),
    Fault(
        "1e-9 off, in everything",
        ONE,
        {"log_prob": lambda d, v: d.log_prob(v) * (1 + 1e-9)},
        "log_prob, float64",
    ),
    Fault(
        "half precision inside, without a reference",
        ONE,
        {"log_prob": in_half},
        "float32 against float64",
        NO_CASES,
    ),
    Fault("four rows know each other", ONE, {"forward": four_know_each_other}, "rows of a batch apart"),
    Fault(
        "loss counts predictions", ONE, {"forward": counting, "loss": counted_loss}, "same seed, same bits"
    ),
    # two and three angles
    Fault(
        "joint 0.1 nat off for κ > 1e3, with the entropy that fits",
        THREE,
        {"log_prob": off(0.1, lambda k: k > 1e3), "entropy": lower_for_narrow},
        "integral by draws",
        NO_CASES,
    ),
    Fault("marginals exchanged", TWO, {"marginal": lambda d, i: marginal(d, 1 - i)}),
    Fault(
        "marginal at κ 1 % large",
        TWO,
        {
            "marginal": lambda d, i: VonMises(
                d.location[..., i : i + 1], 1.01 * d.concentration[..., i : i + 1]
            )
        },
        "marginals",
    ),
    Fault(
        "marginal wrong for κ > 1e3",
        TWO,
        {
            "marginal": lambda d, i: VonMises(
                d.location[..., i : i + 1], d.concentration[..., i : i + 1].clamp(max=1e3)
            )
        },
        "samples follow marginals",
    ),
    Fault("joint 0.1 nat off for κ > 1e3", THREE, {"log_prob": off(0.1, lambda k: k > 1e3)}),
    # one and two reals
    Fault("log-density 0.1 nat off for σ > 20", HEIGHT, {"log_prob": off(0.1, lambda s: s > 20)}),
    Fault("log-density 0.1 nat off for σ < 0.01", HEIGHT, {"log_prob": off(0.1, lambda s: s < 0.01)}),
    Fault(
        "log-density NaN beyond 9 σ",
        HEIGHT,
        {
            "log_prob": lambda d, v: torch.where(
                ((v - d.mean) / d.scale).abs()[..., 0] > 9, math.nan, d.log_prob(v)
            )
        },
    ),
    Fault(
        "tails cut off at 3 σ",
        HEIGHT,
        {
            "log_prob": lambda d, v: Gaussian(d.location, d.scale).log_prob(
                d.mean + (v - d.mean).clamp(-3 * d.scale, 3 * d.scale)
            )
        },
    ),
    Fault("every row draws the same noise", HEIGHT, {"sample": shared_noise}, "draws are independent"),
    Fault("sampler uniform, of the right variance", HEIGHT, {"sample": laplace}),
    Fault("variance is the deviation", HEIGHT, {"variance": lambda d: d.scale}, "mean and variance"),
    Fault(
        "mean 0.01 deviations off",
        HEIGHT,
        {"mean": lambda d: d.location + 0.01 * d.scale},
        "mean and variance",
    ),
    Fault(
        "cdf falls beyond 2 σ",
        HEIGHT,
        {"cdf": lambda d, v: cdf(d, d.location + 2 * d.scale - (v - d.location - 2 * d.scale).abs())},
        "cdf",
    ),
    Fault(
        "entropy without the scale",
        HEIGHT,
        {"entropy": lambda d: d.entropy() - d.scale.log().sum(-1)},
        "entropy",
    ),
    Fault(
        "median 0.1 deviations off, of a real",
        HEIGHT,
        {"median": lambda d, n: d.location + 0.1 * d.scale},
        "median",
    ),
    Fault(
        "mode a deviation off for σ > 20",
        HEIGHT,
        {"mode": lambda d: d.mode + d.scale * (d.scale > 20)},
        "mode",
    ),
    Fault("says that reals are angles", HEIGHT, {"support": lambda d: circular}),
    Fault("sampler draws both numbers alike", PLACE, {"sample": second_as_first}, "samples follow log_prob"),
    Fault("sampler leaves out the second number", PLACE, {"sample": no_second}),
    Fault(
        "log-density without the second scale",
        PLACE,
        {"log_prob": lambda d, v: d.log_prob(v) + d.scale[..., 1].log()},
    ),
    Fault("mode with the numbers exchanged", PLACE, {"mode": lambda d: d.mode.flip(-1)}, "mode"),
    Fault("entropy of the first number", PLACE, {"entropy": first_only}, "entropy"),
    Fault(
        "normaliser 3e-6 off, with the entropy that fits",
        PLACE,
        {"log_prob": off(3e-6, everywhere), "entropy": fitting_entropy},
        "integral",
    ),
    # classes
    Fault("probabilities that do not add up", CLASSES, {"log_prob": smoothed}),
    Fault("never draws the last class", CLASSES, {"sample": below_labels}),
    Fault(
        "draws every class alike",
        CLASSES,
        {"sample": lambda d, s: torch.randint(3, (*s, *d.batch_shape))},
        "samples follow log_prob",
    ),
    Fault("entropy in bits", CLASSES, {"entropy": lambda d: d.entropy() / math.log(2)}, "entropy"),
    Fault("mode is the least likely class", CLASSES, {"mode": lambda d: d.logits.argmin(-1)}, "mode"),
    Fault("labels from 1", CLASSES, {"enumerate_support": lambda d, e: d.enumerate_support(e) + 1}),
    Fault(
        "loss of the next class",
        CLASSES,
        {"loss": lambda h, r, t: -h(r).log_prob((t + 1) % 3)},
        "loss is least for its own density",
    ),
)


class Halved(Changed):
    """log_prob in half precision."""

    def __init__(self, density: Distribution) -> None:
        Changed.__init__(self, density, {"log_prob": lambda d, v: d.log_prob(v).half()})
