"""Planted mixtures of devices, which `mode=check` finds without a GPU; tests.planted_questions contains heads with
them."""

from collections.abc import Iterator

import pytest

from framework.testing.encoders import examine_encoder
from framework.testing.finding import Finding
from framework.testing.metrics import examine_metric
from framework.testing.objectives import examine_objective
from framework.testing.plain import Plain
from framework.testing.rows import EncoderRow, MetricRow, ObjectiveRow, WrapperRow
from framework.testing.wrappers import examine_wrapper
from tests import planted_devices as planted
from tests.planted_devices import NAME
from tests.test_planted_wrappers import Only


def _of_encoders() -> Iterator[tuple[str, Iterator[Finding]]]:
    for name, (kind, shape) in planted.ENCODERS.items():
        yield f"encoder: {name}", examine_encoder(EncoderRow("", shape, leave_out=Only(NAME)), kind)


def _of_wrappers() -> Iterator[tuple[str, Iterator[Finding]]]:
    for name, (kind, target) in planted.WRAPPERS.items():
        row = WrapperRow("", target, leave_out=Only(NAME))
        build = lambda target, kind=kind: kind(lambda: Plain(target))  # noqa: E731
        yield f"wrapper: {name}", examine_wrapper(row, build, None)


def _of_objectives() -> Iterator[tuple[str, Iterator[Finding]]]:
    for name, (kind, target) in planted.OBJECTIVES.items():
        row = ObjectiveRow("", target, leave_out=Only(NAME))
        yield f"objective: {name}", examine_objective(row, lambda factor, kind=kind: kind(weight=factor))


def _of_metrics() -> Iterator[tuple[str, Iterator[Finding]]]:
    for name, (kind, target) in planted.METRICS.items():
        yield f"metric: {name}", examine_metric(MetricRow("", target, leave_out=Only(NAME)), kind)


PLANTED = dict(
    pair for group in (_of_encoders, _of_wrappers, _of_objectives, _of_metrics) for pair in group()
)


@pytest.mark.parametrize("name", PLANTED)
def test_the_fault_is_found(name: str) -> None:
    (finding,) = PLANTED[name]
    assert finding.name == NAME
    assert not finding.holds
