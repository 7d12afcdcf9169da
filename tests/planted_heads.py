"""Planted faults of density heads: a shipped head of which single results are replaced."""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints

from framework.density_head import DensityHead
from framework.distributions.protocol import (
    Estimate,
    Normals,
    QuadraticBound,
    arc_probability,
    cdf,
    estimate,
    exact_estimate,
    images,
    mahalanobis,
    marginal,
    marginal_cdfs,
    median,
    mode_candidates,
    normals,
    peak_widths,
    pick,
    quadratic_bound,
    recentre,
    tempered_density,
)
from framework.target import Target
from framework.testing.densities import CHECKS, examine_densities
from framework.testing.finding import Finding
from framework.testing.head_subject import HeadSubject
from framework.testing.heads import examine_head
from framework.testing.rows import HeadRow
from plugins.density_head.categorical.head import CategoricalHead
from plugins.density_head.gaussian.head import GaussianHead
from plugins.density_head.laplace_image.head import LaplaceImageHead
from plugins.density_head.von_mises.head import VonMisesHead
from plugins.density_head.von_mises.rows import predicted_cases

OF_DENSITIES = {check.name for check in CHECKS}
Parts = Mapping[str, Callable[..., Any]]
ONE, TWO, THREE = (Target("angle", ("azimuth", "elevation", "tilt")[:count]) for count in (1, 2, 3))
HEIGHT, PLACE = Target("real", ("height",)), Target("real", ("x", "y"))
CLASSES = Target("class", ("a", "b", "c"))
IMAGE, GREY = Target("image", ("red", "green", "blue"), size=(2, 3)), Target("image", ("grey",), size=(1, 1))
NO_CASES = {"floor": 1e-9}
"""Configuration of a head for which there are no reference values."""


def _asked(name: str) -> Any:
    """Return a property of `Changed` that asks its density."""
    return property(lambda density: density.ask(name))


class Changed(Distribution):
    """A density of which some results are replaced.

    Args:
        density: correct density.
        parts: functions of the correct density and the arguments, by name of the method, attribute or protocol function
            that they replace.
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}

    def __init__(self, density: Distribution, parts: Parts) -> None:
        self.density = density
        self.parts = parts
        self.has_enumerate_support = density.has_enumerate_support
        super().__init__(density.batch_shape, density.event_shape, validate_args=False)

    def ask(self, name: str, *arguments: Any) -> Any:
        """Return the replaced result, or that of the correct density."""
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

    mode, mean, variance, support = map(_asked, ("mode", "mean", "variance", "support"))


@estimate.register
def _(density: Changed, value: Tensor) -> Estimate:
    if "estimate" in density.parts:
        return density.parts["estimate"](density.density, value)
    return exact_estimate(density, value)


@tempered_density.register
def _(density: Changed, temperature: Tensor) -> Distribution:
    return density.parts.get("tempered_density", tempered_density)(density.density, temperature)


@pick.register
def _(density: Changed, index: Tensor) -> Distribution:
    if "sample" in density.parts:
        return pick.dispatch(Distribution)(density, index)
    return density.parts.get("pick", pick)(density.density, index)


@quadratic_bound.register
def _(density: Changed, value: Tensor) -> QuadraticBound | None:
    return density.parts.get("quadratic_bound", quadratic_bound)(density.density, value)


@recentre.register
def _(density: Changed, index: tuple[Tensor, ...], place: Tensor) -> Distribution:
    if "log_prob" in density.parts:
        return recentre.dispatch(Distribution)(density, index, place)
    return density.parts.get("recentre", recentre)(density.density, index, place)


@normals.register
def _(density: Changed) -> Normals | None:
    return density.parts.get("normals", normals)(density.density)


@mahalanobis.register
def _(density: Changed, value: Tensor) -> Tensor | None:
    return density.parts.get("mahalanobis", mahalanobis)(density.density, value)


@mode_candidates.register
def _(density: Changed) -> Tensor:
    return density.parts.get("mode_candidates", mode_candidates)(density.density)


@peak_widths.register
def _(density: Changed) -> Tensor:
    return density.parts.get("peak_widths", peak_widths)(density.density)


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


@marginal_cdfs.register
def _(density: Changed, value: Tensor) -> Tensor | None:
    return density.parts.get("marginal_cdfs", marginal_cdfs)(density.density, value)


@images.register
def _(density: Changed, channels: Collection[str]) -> dict[str, Tensor]:
    return images(density.density, channels)


@arc_probability.register
def _(density: Changed, start: Tensor, end: Tensor) -> Tensor | None:
    return density.parts.get("arc_probability", arc_probability)(density.density, start, end)


class Faulty(DensityHead):
    """A correct head whose densities are `Changed`.

    `forward`, `loss` and `calibrate` can be replaced too: `forward` and `calibrate` by functions of this head, `loss`
    by a function of the correct head.
    """

    bibtex = ""

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

    @property
    def raw_shape(self) -> tuple[int, ...]:
        """Shape of the raw parameters of the correct head."""
        return self.sound.raw_shape

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
    """A density head with one planted fault.

    Attributes:
        name: description of the fault.
        target: target of the head.
        parts: results that are replaced, as in `Changed` and `Faulty`.
        only: name of the check that must find the fault; "" if several checks can find it.
        config: configuration of the correct head.
        head: function that builds the faulty head for a target, if replacing results of a correct head is not enough.
    """

    name: str
    target: Target
    parts: Parts
    only: str = ""
    config: Mapping[str, Any] = field(default_factory=dict)
    head: Callable[[Target], DensityHead] | None = None

    def findings(self, only: str = "") -> Iterator[Finding]:
        """Yield the findings of all checks, or of the check named `only`.

        The checks of densities come first if one of them must find the fault, so that a caller can stop early.
        """
        kinds = {
            "angle": VonMisesHead,
            "real": GaussianHead,
            "class": CategoricalHead,
            "image": LaplaceImageHead,
        }

        def of(target: Target) -> DensityHead:
            if self.head is not None:
                return self.head(target)
            return Faulty(kinds[target.kind](target, **self.config), self.parts)

        cases = (
            predicted_cases if self.target.kind == "angle" and not self.config and self.head is None else None
        )
        row = HeadRow(self.name, self.target, cases=cases)
        subject = HeadSubject(row, lambda: of(self.target), build_for=of, only=only)
        groups = [examine_head(subject), examine_densities(subject)]
        for group in groups[::-1] if self.only in OF_DENSITIES else groups:
            yield from group


class Halved(Changed):
    """A density whose log_prob is in half precision."""

    def __init__(self, density: Distribution) -> None:
        Changed.__init__(self, density, {"log_prob": lambda d, v: d.log_prob(v).half()})
