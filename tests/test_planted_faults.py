"""Planted faults in density heads, which `mode=check` finds; the heads without a fault pass."""

import math
from collections.abc import Callable

import pytest
import torch
from torch.distributions import Distribution, Independent, MultivariateNormal, Uniform

from framework.configuration.schema import build, resolve
from framework.distributions.density import Mixture
from framework.target import Target
from framework.testing.adaptive import boxes
from framework.testing.densities import integral_by_draws, periodic
from framework.testing.finding import Worst, require
from framework.testing.head_subject import HeadSubject
from framework.testing.heads import examine_head
from framework.testing.precision import reference
from framework.testing.protocol_checks import check_quadratic_bound
from framework.testing.rows import HeadRow
from plugins.density_head.latent.decoder import LatentDecoder
from plugins.density_head.latent.rows import ROWS
from plugins.density_head.von_mises.density import VonMises
from tests.conftest import first_of_each
from tests.planted_faults import ALL_FAULTS
from tests.planted_heads import CLASSES, HEIGHT, IMAGE, ONE, PLACE, THREE, TWO, Fault
from tests.planted_questions import FURTHER_FAULTS
from tests.right_heads import HEADS, LogNormalHead, right_findings

ALONE = {fault.only.rpartition(": ")[2] for fault in (*ALL_FAULTS, *FURTHER_FAULTS)}
"""Names of the properties that the planted faults break, without the structure (mixture, power) of the density."""


@pytest.mark.parametrize(
    "fault", first_of_each(ALL_FAULTS, lambda fault: fault.only or fault.name, lambda fault: fault.name)
)
def test_the_fault_is_found(fault: Fault) -> None:
    failed = (finding.name for finding in fault.findings() if not finding.holds)
    first = next(failed, None)
    assert first is not None, "missed"
    # benchmarks/framework/check.py asks further: that no other property finds it
    assert first == fault.only or not fault.only


@pytest.mark.parametrize(
    "target", [ONE, TWO, THREE, HEIGHT, PLACE, CLASSES, IMAGE], ids=lambda target: str(target.names)
)
def test_the_sound_head_passes_and_every_property_has_a_fault_of_its_own(target: Target) -> None:
    findings = list(Fault("none", target, {}).findings())
    require(*findings)
    assert {finding.name.rpartition(": ")[2] for finding in findings} <= ALONE


@pytest.mark.parametrize("fault", FURTHER_FAULTS, ids=lambda fault: fault.name)
def test_the_fault_is_found_by_the_property_that_is_for_it(fault: Fault) -> None:
    found = list(fault.findings(fault.only))
    assert found and not all(finding.holds for finding in found)


@pytest.mark.parametrize(
    "name, target",
    [(name, target) for name, (_, targets) in HEADS.items() for target in targets],
    ids=lambda part: part if isinstance(part, str) else str(len(part.names)),
)
def test_a_right_head_of_somebody_else_is_not_refused(name: str, target: Target) -> None:
    """Check with one seed of the random draws; benchmarks/framework/check.py tries more seeds."""
    require(*right_findings(name, target))


def test_the_finding_of_a_density_that_is_0_for_some_targets_says_what_to_do() -> None:
    target = Target("real", ("height",))
    subject = HeadSubject(HeadRow("positive", target), lambda: LogNormalHead(target), only="number types")
    (finding,) = examine_head(subject)
    assert not finding.holds
    assert "list targets for which it is not in HeadRow.values" in str(finding)


class _UniformAngle(Independent):
    """The uniform density of an angle."""

    mode = torch.zeros(2, 1, dtype=torch.float64)

    def log_prob(self, value: torch.Tensor) -> torch.Tensor:
        return value.new_full(value.shape[:-1], -math.log(2 * math.pi))


@pytest.mark.parametrize("check", [periodic, check_quadratic_bound])
def test_a_density_whose_logarithm_has_no_gradient_passes(
    check: Callable[[Distribution, Worst], None],
) -> None:
    edges = torch.full((2, 1), math.pi, dtype=torch.float64)
    worst = Worst()
    check(_UniformAngle(Uniform(-edges, edges), 1), worst)
    assert worst.error <= 0


@pytest.mark.parametrize("size", [3, 15])
def test_a_normal_of_many_numbers_integrates_to_one(size: int) -> None:
    """A normal density integrates to one, and a density that is wrong by a fiftieth does not pass."""
    torch.manual_seed(0)
    root = torch.randn(6, size, size, dtype=torch.float64).tril(-1) + torch.eye(size)

    def error(factor: float) -> float:
        class Off(MultivariateNormal):
            def log_prob(self, value: torch.Tensor) -> torch.Tensor:
                return super().log_prob(value) + math.log(factor)

        worst = Worst()
        integral_by_draws(Off(torch.zeros(6, size).double(), scale_tril=root), worst)
        return worst.error

    assert error(1.0) < 5
    assert error(1.02) > 6


@pytest.mark.parametrize("name", ["scvae", "cvae"])
def test_the_rounding_of_a_network_is_no_error_and_a_coarser_one_is(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    row, forward = ROWS[name][0], LatentDecoder.forward
    config = resolve("density_head", {"name": name, **row.config})
    subject = HeadSubject(row, lambda: build("density_head", config, target=row.target))

    def error() -> float:
        worst = Worst()
        reference(subject, worst, torch.float32)
        return worst.error

    assert error() < 2e-6

    def coarse(decoder: LatentDecoder, raw: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
        found = forward(decoder, raw, z)
        return found * (1 + 3e-5) if found.dtype == torch.float32 else found

    monkeypatch.setattr(LatentDecoder, "forward", coarse)
    assert error() > 2e-6


def test_ridges_that_no_peak_lies_on_are_integrated() -> None:
    """Narrow in one number and broad in the other, of little weight, far from the main one; across it and along."""
    location = torch.tensor([[[2.93, 0.47], [1.69, 1.83]], [[0.6, 0.3], [-2.5, -0.8]]], dtype=torch.float64)
    concentration = torch.tensor(
        [[[1.5e4, 1.0], [3.3e4, 1.0]], [[1.0, 1e8], [1e5, 1.0]]], dtype=torch.float64
    )
    weights = torch.tensor([[2e-3, 1.0], [1.0, 5e-4]], dtype=torch.float64).log()
    density = Mixture(weights, VonMises(location, concentration))
    found = boxes(density)
    torch.testing.assert_close(
        found.mean(torch.ones_like(found.log_prob)), torch.ones(2, dtype=torch.float64), atol=1e-6, rtol=0
    )
