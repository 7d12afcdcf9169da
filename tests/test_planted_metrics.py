"""Planted faults in metrics, each found by its own contract test of `mode=check`; correct metrics pass."""

import pytest

from framework.metric import Metric
from framework.target import Target
from framework.testing.finding import require
from framework.testing.metrics import examine_metric
from framework.testing.rows import MetricRow
from tests.conftest import first_of_each
from tests.planted_metrics import ALL_FAULTS, RIGHT, Fault


@pytest.mark.parametrize("fault", first_of_each(ALL_FAULTS, lambda fault: fault.by, lambda fault: fault.name))
def test_the_fault_is_found(fault: Fault) -> None:
    failed = {
        finding.name
        for finding in examine_metric(MetricRow("", fault.target), fault.build)
        if not finding.holds
    }
    assert fault.by in failed


@pytest.mark.parametrize("name", RIGHT)
def test_a_right_metric_passes(name: str) -> None:
    kind: type[Metric]
    target: Target
    kind, target = RIGHT[name]
    require(*examine_metric(MetricRow("", target), kind))
