"""The contract of a metric: it turns predictions into named numbers."""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from framework.prediction import Prediction, Split
from framework.storage.light_torchmetrics import torchmetrics
from framework.target import Target

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Directions = dict[str, Literal["higher", "lower"]]
"""Directions in which numbers are better, by the names of the numbers."""

SINGLE = 6
"""Largest number of target numbers for which `columns_by_number` has a column for each."""


class Metric(torchmetrics.Metric, ABC):
    """A torchmetrics.Metric that reads predictions.

    `full_state_update` is False. States are float64 sums and counts (`dist_reduce_fx="sum"`). They may be lists of
    numbers per sample ("cat") where a sum does not suffice, as for a median, or have their own merging function (a
    stable variance). They are never sums of angles, because angles do not add.

    A constructor's keyword-only parameters are the config; it may take `target: Target` before `*`. A metric that is
    not requested costs nothing: what several metrics share (the log-likelihood, the point prediction) lives in
    `Prediction` and is computed at first use.
    """

    group: ClassVar[str] = "metric"
    bibtex: ClassVar[str]
    """Citation of the method: BibTeX entries, or their keys in the `references.bib` of the package; "" for none."""
    full_state_update = False
    splits: ClassVar[tuple[Split, ...]] = ("test",)
    """Splits whose predictions `update` receives.

    If "outliers" is among them, `update` also receives the predictions on the test split of the config's `outliers`;
    `prediction.split` is then "outliers". No predictions are made on outliers if no metric reads them.
    """
    reads: ClassVar[frozenset[str]] = frozenset()
    """Channels of `Prediction.image` that `update` requests; the true images are `Prediction.true_image`.

    The channels that the chosen metrics read are drawn together, and no others.
    """
    columns: ClassVar[dict[str, str]]
    """Keys of `compute` that belong in the result table, with their headings, in order: {"maad_deg": "MAAD °"}.

    A key `<name>_sem` is printed behind `<name>` as ± and has no heading of its own.
    """

    better: ClassVar[Directions] = {}
    """Better direction, "higher" or "lower", of those columns that have one, by their keys in `columns`."""

    @abstractmethod
    def update(self, prediction: Prediction) -> None:
        """Add the predictions of one batch to the states."""

    @abstractmethod
    def compute(self) -> dict[str, Tensor]:
        """Return scalars by name, with the unit in the name if it is not 1 (`maad_deg`; `log_likelihood` is in nats).

        All scalars are NaN if no batch was seen.
        """

    def remarks(self) -> tuple[str, ...]:
        """Return sentences without which the results would mislead; logged once after all samples of a test."""
        return ()


class Mean(Metric):
    """Base class of metrics that compute one or more numbers for each sample, and return their mean over all samples.

    A subclass calls `start` in its constructor, `add_samples` in `update`, and `mean_and_error` in `compute`, which
    also returns the standard error of the mean. The states are the sums of the numbers and of their squares. The
    standard deviation is computed from the difference of these sums, and loses digits if it is far smaller than the
    mean. For scores in [0, 2], float64 resolves a standard deviation of 1e-8.
    """

    count: Tensor
    total: Tensor
    squares: Tensor

    def start(self, *shape: int) -> None:
        """Declare the states of the sums; `shape` is the shape of the numbers of one sample, () for a single number."""
        self.add_state("count", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        for name in ("total", "squares"):
            self.add_state(name, torch.zeros(shape, dtype=torch.float64), dist_reduce_fx="sum")

    def add_samples(self, numbers: Float[Tensor, "batch *shape"]) -> None:
        """Add the numbers of a batch of samples, (batch, *shape), to the sums."""
        self.count += len(numbers)
        self.total += numbers.sum(0)
        self.squares += numbers.square().sum(0)

    def mean_and_error(self) -> tuple[Float[Tensor, "*shape"], Float[Tensor, "*shape"]]:
        """Return the mean over samples and its standard error.

        Without samples both are NaN. With one sample only the standard error is NaN.
        """
        mean = self.total / self.count
        spread = (self.squares / self.count - mean.square()).clamp(min=0)  # (n - 1)/n of the sample variance
        return mean, (spread / (self.count - 1).clamp(min=0)).sqrt()


def columns_by_number(key: str, heading: str, target: Target) -> dict[str, str]:
    """Return the columns of a result that has the target's unit: `columns` of a metric.

    A real-valued target of 2 to SINGLE numbers has a column `<key>_<name>` for each number behind the column `key` of
    the mean over all of them, which has no meaning if the numbers have different units.

    Args:
        key: name of the result over all numbers.
        heading: heading of its column.
        target: target of the metric.
    """
    if target.kind != "real" or not 1 < len(target.names) <= SINGLE:
        return {key: heading}
    single = {f"{key}_{name}": f"{heading} of {name}" for name in target.names}
    return {key: f"{heading}, all numbers", **single}


def jackknife_error(values: Float[Tensor, "sample"]) -> Float[Tensor, ""]:
    """Return the standard error of a statistic by the jackknife; NaN for fewer than two samples.

    `values` are the n values θ_j that the statistic has if sample j of n is left out. The standard error is
    √((n - 1)/n Σ_j (θ_j - mean θ)²) (Efron & Tibshirani 1993, eq. 11.5).
    """
    count = len(values)
    if count < 2:
        return values.new_tensor(torch.nan)
    return ((values - values.mean()).square().sum() * ((count - 1) / count)).sqrt()


class HasFigure(ABC):
    """Additional base class of a metric that has a figure."""

    figure_name: ClassVar[str]
    """Name of the figure's file, without a suffix."""

    @abstractmethod
    def figure(self, title: str, *, synthetic: bool) -> "Figure":
        """Return the figure of all batches so far; called after `compute`.

        The method imports the module that draws, so that a metric that is only computed loads no Matplotlib.

        Args:
            title: title of the figure.
            synthetic: whether the data are generated; the title then says so.
        """
