"""The contract of a metric: predictions in, named numbers out."""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar, Literal

import torch
import torchmetrics
from jaxtyping import Float
from torch import Tensor

from framework.prediction import Prediction, Split

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Metric(torchmetrics.Metric, ABC):
    """A torchmetrics.Metric that reads predictions.

    `full_state_update` is False. States are sums and counts (`dist_reduce_fx="sum"`), or lists of per-sample numbers
    ("cat") where a sum does not suffice, as for a median, or have a merging function of their own (a stable variance);
    never angles, which do not add. Sums are float64.

    A constructor's keyword-only parameters are the config; it may ask for `target: Target` before `*`. It costs
    nothing when it is not asked for: whatever several metrics share (the log-likelihood, the point prediction) lives
    in `Prediction` and is computed on first use.
    """

    group: ClassVar[str] = "metric"
    bibtex: ClassVar[str]
    """What to cite, as BibTeX."""
    full_state_update = False
    splits: ClassVar[tuple[Split, ...]] = ("test",)
    """Whose predictions `update` is given. With "outliers" it also gets those on the test split of the config's
    `outliers`, told apart by `prediction.split`; nothing is predicted on outliers that no metric reads."""
    reads: ClassVar[frozenset[str]] = frozenset()
    """Channels of `Prediction.image` that `update` asks for: those that some metric reads are drawn together, and no
    others. Their truth is `Prediction.true_image`."""
    columns: ClassVar[dict[str, str]]
    """Keys of `compute` that belong in the result table, with their headings, in order: {"maad_deg": "MAAD °"}.
    A key "<name>_sem" is printed behind "<name>" as ± and has no heading of its own."""

    better: ClassVar[dict[str, Literal["higher", "lower"]]] = {}
    """Which way a column is better, for those of `columns` that have a better way."""

    @abstractmethod
    def update(self, prediction: Prediction) -> None:
        """Take in one batch."""

    @abstractmethod
    def compute(self) -> dict[str, Tensor]:
        """Scalars by name, with the unit in the name where it is not 1 (`maad_deg`, `log_likelihood` is in nats).

        NaN where nothing was seen.
        """


class Mean(Metric):
    """What metrics share that are a mean over samples, of one number or several, with its standard error.

    A metric of the family calls `start` in its constructor, `take_in` in `update` and `mean_and_error` in `compute`.
    The states are sums of the numbers and of their squares: for numbers that are not negative, so that no large mean
    hides a small spread (of scores in [0, 2] float64 resolves a spread of 1e-8).
    """

    count: Tensor
    total: Tensor
    squares: Tensor

    def start(self, *shape: int) -> None:
        """Declare the states for numbers of this shape in each sample."""
        self.add_state("count", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        for name in ("total", "squares"):
            self.add_state(name, torch.zeros(shape, dtype=torch.float64), dist_reduce_fx="sum")

    def take_in(self, numbers: Float[Tensor, "batch *shape"]) -> None:
        self.count += len(numbers)
        self.total += numbers.sum(0)
        self.squares += numbers.square().sum(0)

    def mean_and_error(self) -> tuple[Float[Tensor, "*shape"], Float[Tensor, "*shape"]]:
        """Both are NaN of no sample, and of one the error is."""
        mean = self.total / self.count
        spread = (self.squares / self.count - mean.square()).clamp(min=0)  # (n - 1)/n of the sample variance
        return mean, (spread / (self.count - 1).clamp(min=0)).sqrt()


class Pictured(ABC):
    """What a metric derives from as well when it has a picture to show."""

    picture: ClassVar[str]
    """Name of the picture's file, without a suffix."""

    @abstractmethod
    def figure(self, title: str, *, synthetic: bool) -> "Figure":
        """The picture of what was seen, called after `compute`. The module that draws is imported in here, so that
        a metric that is only computed loads no Matplotlib."""
