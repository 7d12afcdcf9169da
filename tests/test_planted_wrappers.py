"""Planted faults in uncertainty wrappers, each found by its own contract test of `mode=check`; correct wrappers
pass."""

import pytest

from framework.target import Target
from framework.testing.contract import _defaults
from framework.testing.finding import require
from framework.testing.plain import Plain
from framework.testing.rows import WrapperRow
from framework.testing.wrappers import examine_wrapper
from tests.conftest import first_of_each
from tests.planted_heads import CLASSES, HEIGHT
from tests.planted_wrappers import ALL_FAULTS, RIGHT, Fault


class Only(dict[str, str]):
    """Mapping that contains every contract test except one, so that only this test runs."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self.name = name

    def __contains__(self, name: object) -> bool:
        return name != self.name


@pytest.mark.parametrize("fault", first_of_each(ALL_FAULTS, lambda fault: fault.by, lambda fault: fault.name))
def test_the_fault_is_found(fault: Fault) -> None:
    row = WrapperRow("", fault.target, leave_out=Only(fault.by))
    (finding,) = examine_wrapper(row, lambda target: fault.kind(lambda: Plain(target)), None)
    assert finding.name == fault.by
    assert not finding.holds


@pytest.mark.parametrize("name", RIGHT)
@pytest.mark.parametrize("target", [CLASSES, HEIGHT], ids=lambda target: target.kind)
def test_a_right_wrapper_passes(name: str, target: Target) -> None:
    """Check few targets and one seed; benchmarks/framework/check.py checks all kinds of targets with many seeds."""
    build = RIGHT[name]
    require(*examine_wrapper(WrapperRow("", target), lambda target: build(lambda: Plain(target)), None))


@pytest.mark.parametrize("name, wanted", [("temperature", 4), ("platt", 1)])
def test_without_rows_a_wrapper_is_tried_with_the_targets_that_it_can_wrap(name: str, wanted: int) -> None:
    """A power of three angles is known of no density: so says the wrapper when it is calibrated, not before."""
    rows = _defaults("uncertainty", name, {}, "defaults")
    assert len(rows) == wanted
