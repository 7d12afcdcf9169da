"""Planted faults in data sets, each found by its own contract test of `mode=check`; correct data sets pass."""

import pytest

from framework.testing.data import examine_data
from framework.testing.finding import require
from tests.conftest import first_of_each
from tests.planted_data import ALL_FAULTS, RIGHT, Fault


@pytest.mark.parametrize("fault", first_of_each(ALL_FAULTS, lambda fault: fault.by, lambda fault: fault.name))
def test_the_fault_is_found(fault: Fault) -> None:
    found = next(finding for finding in examine_data(fault.row, fault.build) if finding.name == fault.by)
    assert not found.holds


@pytest.mark.parametrize("name", RIGHT)
def test_a_right_data_set_passes(name: str) -> None:
    kind, row = RIGHT[name]
    require(*examine_data(row, lambda config: kind(**config)))
