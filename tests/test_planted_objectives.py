"""Planted faults in objectives, each found by its own contract test of `mode=check`; a correct objective passes."""

import pytest

from framework.target import Target
from framework.testing.finding import require
from framework.testing.objectives import examine_objective
from framework.testing.rows import ObjectiveRow
from tests.conftest import first_of_each
from tests.planted_heads import CLASSES, ONE, PLACE
from tests.planted_objectives import ALL_FAULTS, RIGHT, Fault


@pytest.mark.parametrize("fault", first_of_each(ALL_FAULTS, lambda fault: fault.by, lambda fault: fault.name))
def test_the_fault_is_found(fault: Fault) -> None:
    findings = examine_objective(ObjectiveRow("", fault.target), lambda factor: fault.kind(weight=factor))
    assert fault.by in {finding.name for finding in findings if not finding.holds}


@pytest.mark.parametrize("name", RIGHT)
@pytest.mark.parametrize("target", [CLASSES, ONE, PLACE], ids=lambda target: str(target.names))
def test_a_right_objective_passes(name: str, target: Target) -> None:
    require(*examine_objective(ObjectiveRow("", target), lambda factor: RIGHT[name](weight=factor)))
