"""`mode=check` finds every planted fault, and nothing in the sound heads that they are planted in."""

import pytest

from framework.target import Target
from framework.testing.finding import require
from tests.planted_faults import ALL_FAULTS
from tests.planted_heads import CLASSES, HEIGHT, ONE, PLACE, THREE, TWO, Fault

ALONE = {fault.only for fault in ALL_FAULTS}


@pytest.mark.parametrize("fault", ALL_FAULTS, ids=lambda fault: fault.name)
def test_the_fault_is_found(fault: Fault) -> None:
    failed = (finding.name for finding in fault.findings() if not finding.holds)
    first = next(failed, None)
    assert first is not None, "missed"
    # benchmarks/check.py asks further: that no other property finds it
    assert first == fault.only or not fault.only


@pytest.mark.parametrize(
    "target", [ONE, TWO, THREE, HEIGHT, PLACE, CLASSES], ids=lambda target: str(target.names)
)
def test_the_sound_head_passes_and_every_property_has_a_fault_of_its_own(target: Target) -> None:
    findings = list(Fault("none", target, {}).findings())
    require(*findings)
    assert {finding.name for finding in findings} <= ALONE
