import math

import pytest
import torch
from scipy.integrate import quad

from framework.configuration.registry import installed
from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from framework.metric import Metric
from framework.target import Target
from framework.testing.finding import failures
from framework.testing.metrics import Cardioid, examine_metric, simplest_density
from framework.testing.rows import MetricRow

CLASSES = Target("class", ("a", "b", "c"))
ANGLE = Target("angle", ("azimuth",))
REALS = Target("real", ("x", "y"))
IMAGES = Target("image", ("red", "green", "blue"), size=(8, 8))


class Contrast(Metric):
    """Metric of the mean entropy on outliers minus that on the test split, correct or with one fault."""

    splits = ("test", "outliers")
    columns = {"contrast": "contrast"}  # noqa: RUF012 - a metric as people write it
    better = {"contrast": "higher"}  # noqa: RUF012
    bibtex = ""

    def __init__(self, fault=""):
        super().__init__()
        self.fault = fault
        for name in ("test", "outliers"):
            self.add_state(name, torch.zeros(2, dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, prediction):
        entropy = prediction.entropy.double()
        seen = torch.stack([entropy.new_tensor(float(len(entropy))), entropy.sum()])
        split = prediction.split
        if self.fault == "split ignored":
            split = "test"
        if split == "outliers":
            self.outliers = seen if self.fault == "last batch" else self.outliers + seen
        else:
            self.test = self.test + seen

    def compute(self):
        if self.fault == "split ignored":
            return {"contrast": self.test[1] / self.test[0]}
        ways = -1 if self.fault == "wrong way" else 1
        return {"contrast": ways * (self.outliers[1] / self.outliers[0] - self.test[1] / self.test[0])}


def failed(fault, target):
    row = MetricRow("", target)
    return set(failures(examine_metric(row, lambda: Contrast(fault))))


@pytest.mark.parametrize("target", [CLASSES, ANGLE, REALS], ids=lambda target: target.kind)
def test_a_metric_of_outliers_is_given_them(target):
    assert failed("", target) == set()
    assert failed("wrong way", target) == {"perfect beats random"}
    assert "batches do not matter" in failed("last batch", target)


def test_outliers_taken_for_test_samples_are_found():
    # what it then calls better is the entropy of everything, which one split alone cannot tell from the contrast
    class Swapped(Contrast):
        def update(self, prediction):
            prediction.split = "test" if prediction.split == "outliers" else "outliers"
            super().update(prediction)

    found = set(failures(examine_metric(MetricRow("", ANGLE), Swapped)))
    assert found == {"perfect beats random"}


@pytest.mark.parametrize("strength", [1.0, 0.7, 0.01])
def test_a_cardioid_of_any_strength_is_a_density(strength):
    density = Cardioid(torch.tensor([[0.4]], dtype=torch.float64), torch.tensor([strength]))

    def log_prob(angle):
        return density.log_prob(torch.tensor([[angle]], dtype=torch.float64)).item()

    def integral(function):
        return quad(function, 0.4 - math.pi, 0.4 + math.pi, limit=200)[0]

    assert integral(lambda angle: math.exp(log_prob(angle))) == pytest.approx(1, abs=1e-9)
    entropy = integral(lambda angle: -math.exp(log_prob(angle)) * log_prob(angle))
    assert density.entropy().item() == pytest.approx(entropy, abs=1e-8)
    torch.manual_seed(0)
    along = torch.cos(density.sample((100_000,)) - 0.4).mean().item()
    assert along == pytest.approx(strength / 2, abs=4 * 0.71 / 100_000**0.5)  # E cos d = ρ


@pytest.mark.parametrize("target", [CLASSES, ANGLE, REALS], ids=lambda target: target.kind)
def test_broader_densities_have_more_entropy_about_the_same_place(target):
    place = torch.randn(5, len(target.names), generator=torch.Generator().manual_seed(0))
    narrow, same, broad = (
        simplest_density(target, place, None if breadth is None else torch.full((5,), breadth))
        for breadth in (None, 1.0, 2.0)
    )
    torch.testing.assert_close(narrow.entropy(), same.entropy(), rtol=0, atol=0)
    assert (broad.entropy() > narrow.entropy()).all()
    torch.testing.assert_close(broad.mode, narrow.mode)


@pytest.mark.parametrize("target", [CLASSES, ANGLE, REALS, IMAGES], ids=lambda target: target.kind)
@pytest.mark.parametrize("name", installed("metric"))
def test_a_metric_takes_a_kind_of_target_or_says_why_not(name, target):
    try:
        parts = resolve("metric", name)
    except ConfigError as error:  # what has no default must be given
        assert "is missing" in str(error)
        return
    try:
        built = build("metric", parts, target=target)
    except ConfigError as error:
        assert len(str(error).split()) > 8  # a sentence
    else:
        assert built.columns
