"""Planted faults in encoders, each found by its own contract test of `mode=check`; correct encoders pass."""

import pytest

from framework.testing.encoders import examine_encoder
from framework.testing.finding import failures, require
from framework.testing.rows import EncoderRow
from tests.conftest import first_of_each
from tests.planted_encoders import ALL_FAULTS, RIGHT, Fault


@pytest.mark.parametrize("fault", first_of_each(ALL_FAULTS, lambda fault: fault.by, lambda fault: fault.name))
def test_the_fault_is_found(fault: Fault) -> None:
    findings = examine_encoder(EncoderRow("", fault.shape), fault.build)
    assert fault.by in failures(findings)


@pytest.mark.parametrize("name", RIGHT)
def test_a_right_encoder_passes(name: str) -> None:
    kind, shape = RIGHT[name]
    require(*examine_encoder(EncoderRow("", shape), kind))
