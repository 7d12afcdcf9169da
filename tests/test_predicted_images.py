"""Images of predictions, of which only the channels that a metric reads are drawn, all of them in one call."""

import pytest
import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.data import Frame
from framework.distributions.affine import AffineDensity
from framework.errors import DataError, UserError
from framework.evaluation.splits import evaluate
from framework.metric import Metric
from framework.prediction import Prediction
from framework.target import Target
from framework.testing.balls import CHANNELS, Ball, ball
from framework.testing.finding import failures
from framework.testing.metrics import examine_metric, simplest_density
from framework.testing.plain import LENGTH, Plain
from framework.testing.rows import MetricRow

PLACE, SIZE = Target("real", ("across", "down")), (6, 8)


class Reads(Metric):
    """Metric of the mean difference between predicted and true images, which reads some channels in each update."""

    bibtex = ""

    def __init__(self, *channels: str, told: frozenset[str] | None = None, splits=("test",)) -> None:
        super().__init__()
        self.channels = channels
        self.reads = frozenset(channels) if told is None else told  # type: ignore[misc]
        self.splits = splits  # type: ignore[misc]
        self.key = f"off_{'_'.join(channels)}"
        self.columns = {self.key: "off"}  # type: ignore[misc]
        self.better = {self.key: "lower"}  # type: ignore[misc]
        for name in ("total", "count"):
            self.add_state(name, torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, prediction: Prediction) -> None:
        for _ in range(2):
            for channel in self.channels:
                gap = prediction.image(channel).double() - prediction.true_image(channel).double()
        self.total += gap.nan_to_num(0, 0, 0).abs().flatten(1).mean(1).sum()
        self.count += len(gap)

    def compute(self) -> dict[str, Tensor]:
        return {self.key: self.total / self.count}


def batches(count: int) -> list[dict[str, Tensor]]:
    inputs = torch.randn(count, 3, LENGTH, generator=torch.Generator().manual_seed(0))
    index = torch.arange(3)
    return [
        {"input": one, "target": one[:, :2], "index": index, **ball(one[:, :2] + 0.5, SIZE)} for one in inputs
    ]


def asked(*metrics: Metric) -> list[list[frozenset[str]]]:
    """Return the channels of each drawing, for two test batches and then one batch of outliers."""
    predictor, (first, second, other) = Plain(PLACE), batches(3)
    predicted: list[Ball] = []

    def draws(_: Plain, inputs: tuple[Tensor], density: Distribution) -> Ball:
        predicted.append(Ball(density, inputs[0][:, :2], SIZE))
        return predicted[-1]

    predictor.register_forward_hook(draws)
    evaluate(
        predictor,
        [first, second],
        metrics,
        groups=("all",),
        samples=1,
        seed=0,
        device=torch.device("cpu"),
        outliers=[other],
    )
    return [density.requested_channels for density in predicted]


def test_what_metrics_read_is_drawn_at_once_and_nothing_else() -> None:
    assert asked(Reads("mask"), Reads("color", "mask")) == [[{"mask", "color"}], [{"mask", "color"}], []]
    both = ("test", "outliers")
    assert asked(Reads("mask", splits=both), Reads("depth")) == [[{"mask", "depth"}]] * 2 + [[{"mask"}]]
    assert asked() == [[], [], []]
    # one that does not say what it reads gets it all the same, each channel once
    assert asked(Reads("depth", "mask", told=frozenset())) == [[{"depth"}, {"mask"}]] * 2 + [[]]


def test_another_frame_keeps_what_is_read_and_seen() -> None:
    (batch,) = batches(1)
    place = batch["target"]
    density = Ball(simplest_density(PLACE, place), place, SIZE)
    prediction = Prediction(density, batch, reads=("color", "depth"))
    moved = prediction.in_frame(Frame(torch.ones(3, 2), torch.full((3, 2), 2.0)))
    assert isinstance(moved.density, AffineDensity)
    torch.testing.assert_close(moved.image("color"), ball(place, SIZE)["color"], rtol=0, atol=0)
    assert density.requested_channels == [{"color", "depth"}]


def test_a_missing_truth_and_a_density_that_draws_nothing_get_a_sentence() -> None:
    (batch,) = batches(1)
    del batch["mask"]
    prediction = Prediction(simplest_density(PLACE, batch["target"]), batch)
    with pytest.raises(
        DataError, match=r"the true 'mask' .* only input, target, index, color, depth\. Choose data"
    ):
        prediction.true_image("mask")
    with pytest.raises(
        UserError, match=r"MultivariateNormal .* provides no mask.*protocol\.images\.register"
    ):
        prediction.image("mask")


def test_the_contract_finds_metrics_that_name_other_images_than_they_read() -> None:
    row = MetricRow("", PLACE, size=SIZE)
    for told in (CHANNELS, {"color"}, {"depth"}, {"color", "depth"}):
        metric = Reads("color", "mask", told=frozenset(told))
        failed = failures(examine_metric(row, metric.clone))  # type: ignore[arg-type]
        assert failed == ["only the images in reads are drawn"], told
    for metric in (
        Reads("color", "mask"),
        Reads("color", splits=("test", "outliers")),
        Reads("mask", splits=("outliers",)),
    ):
        assert all(finding.holds for finding in examine_metric(row, metric.clone))  # type: ignore[arg-type]
