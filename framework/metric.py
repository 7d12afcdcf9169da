"""The contract of a metric: predictions in, named numbers out."""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar, Literal

import torchmetrics
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
    columns: ClassVar[dict[str, str]]
    """Keys of `compute` that belong in the result table, with their headings, in order: {"maad_deg": "MAAD °"}.
    A key "<name>_sem" is printed behind "<name>" as ± and has no heading of its own."""

    better: ClassVar[dict[str, Literal["higher", "lower"]]]
    """Which way a column is better, for those of `columns` that have a better way."""

    @abstractmethod
    def update(self, prediction: Prediction) -> None:
        """Take in one batch."""

    @abstractmethod
    def compute(self) -> dict[str, Tensor]:
        """Scalars by name, with the unit in the name where it is not 1 (`maad_deg`, `log_likelihood` is in nats).

        NaN where nothing was seen.
        """


class Pictured(ABC):
    """What a metric derives from as well when it has a picture to show."""

    picture: ClassVar[str]
    """Name of the picture's file, without a suffix."""

    @abstractmethod
    def figure(self, title: str, *, synthetic: bool) -> "Figure":
        """The picture of what was seen, called after `compute`. The module that draws is imported in here, so that
        a metric that is only computed loads no Matplotlib."""
