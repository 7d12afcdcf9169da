"""Tests of the sentences that a metric adds to its results, `Metric.remarks`."""

from typing import Any

import pytest
import torch
from torch.distributions import Categorical, Independent, Normal

from framework.configuration.schema import build, resolve
from framework.evaluation.splits import evaluate
from framework.prediction import Prediction
from framework.target import Target
from framework.testing.plain import LENGTH, Plain

CLASSES = Target("class", ("a", "b", "c"))

conformal = build(
    "uncertainty", resolve("uncertainty", "conformal"), model=lambda: Plain(CLASSES), target=CLASSES
)
PredictionSet: Any = type(conformal(torch.zeros(1, LENGTH)))
"""Class of the densities with prediction sets that a conformal wrapper returns, as in a run."""


@pytest.mark.parametrize(
    ("inside", "count", "is_reported"),
    [
        (32, 100, True),
        (900, 1000, False),
        (860, 1000, False),
        (840, 1000, True),
        (8, 10, False),
        (0, 40, True),
    ],
)
@pytest.mark.parametrize("parts", [1, 3])
def test_a_coverage_far_below_the_stated_one_is_reported_once(
    inside: int, count: int, parts: int, caplog: pytest.LogCaptureFixture, *, is_reported: bool
) -> None:
    """Test sets that hold class 0 and are stated to hold 90 % of the targets; the test split has other shares."""
    labels = (torch.arange(count) >= inside).long()
    logits = torch.tensor([4.0, 0.0, 0.0]).double().expand(count, 3)
    batches = [{"input": part, "target": part.long()} for part in labels.tensor_split(parts)]

    metric = build("metric", resolve("metric", "prediction_set"), target=CLASSES)

    class Sets(torch.nn.Module):
        def forward(self, inputs: torch.Tensor) -> torch.distributions.Distribution:
            density = Categorical(logits=logits[: len(inputs)], validate_args=False)
            return PredictionSet(density, torch.tensor(1.0).double(), "density", 0.9)

    device = torch.device("cpu")
    evaluate(Sets(), batches, [metric], groups=("all",), samples=1, seed=0, device=device)
    messages = [record.message for record in caplog.records if "are stated" in record.message]
    assert len(messages) == is_reported
    if is_reported:
        assert f"hold {100 * inside / count:.3g} % of the test targets, but 90 % are stated" in messages[0]


@pytest.mark.parametrize(
    ("rare", "is_reported"), [(0, False), (2, False), (30, True), (99, True)], ids=lambda part: str(part)
)
def test_a_class_that_the_sets_leave_out_is_reported(rare: int, *, is_reported: bool) -> None:
    """Sets that hold class 0 alone cover nine tenths of all targets, but no target of the rare class."""
    metric = build("metric", resolve("metric", "prediction_set"), target=CLASSES)
    labels = torch.cat([torch.zeros(1000), torch.ones(rare)]).long()
    for part in labels.split(64):
        logits = torch.tensor([4.0, 0.0, 0.0]).double().expand(len(part), 3)
        density = Categorical(logits=logits, validate_args=False)
        sets = PredictionSet(density, torch.tensor(1.0).double(), "density", 0.9)
        metric.update(Prediction(sets, {"target": part}))
    assert len(metric.remarks()) == is_reported
    if is_reported:
        assert f"but not of each class: 0% of {rare} 'b'. A set without" in metric.remarks()[0]


@pytest.mark.parametrize("name", ["log_likelihood", "nll"])
@pytest.mark.parametrize("groups", [("all",), ("even", "odd")])
@pytest.mark.parametrize("outliers", [{}, {7: 9.0}, {7: 9.0, 90: -40.0, 130: 8.0}])
def test_nearly_impossible_targets_are_counted_once_over_all_batches_and_groups(
    name: str, groups: tuple[str, ...], outliers: dict[int, float], caplog: pytest.LogCaptureFixture
) -> None:
    target = torch.zeros(150, 1, dtype=torch.float64)
    for index, value in outliers.items():
        target[index] = value
    index = torch.arange(len(target))
    fields = {"input": target, "target": target, "index": index, "group": index % len(groups)}
    batches = [
        dict(zip(fields, parts, strict=True))
        for parts in zip(*(field.split(64) for field in fields.values()), strict=True)
    ]

    class StandardNormal(torch.nn.Module):
        def forward(self, inputs: torch.Tensor) -> torch.distributions.Distribution:
            return Independent(Normal(torch.zeros_like(inputs), 1.0), 1)

    metric = build("metric", resolve("metric", name), target=Target("real", ("y",)))
    for _ in range(2):  # a second test of the same metrics counts anew
        caplog.clear()
        device = torch.device("cpu")
        evaluate(StandardNormal(), batches, [metric], groups=groups, samples=1, seed=0, device=device)
        messages = [record.message for record in caplog.records if "nats less likely" in record.message]
        assert len(messages) == bool(outliers)
        if outliers:
            worst, value = max(outliers.items(), key=lambda item: abs(item[1]))
            assert f"{len(outliers)} of 150 targets" in messages[0]
            assert f"is test sample {worst}, target {value:g}, with" in messages[0]
