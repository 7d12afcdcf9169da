"""Split conformal prediction: sets that hold the target with a stated probability for any model."""

import logging
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.calibration.validation import nonempty_batches, predict_densities, require_numbers
from framework.data import Batch
from framework.errors import UserError
from framework.model import Predictor
from framework.storage.weights import require_state
from framework.uncertainty import Uncertainty
from plugins.uncertainty.conformal.prediction_set import PredictionSet, Score

SEED = 71
"""Seed of the split into halves."""
NEAR = 0.03
"""Largest deviation of a coverage from the stated one without a remark.

The remark names the number of rows that keep it within this deviation in 90 % of cases.
"""
NINETY = 1.645
"""Number of standard deviations to either side that hold the middle 90 % of a normal density."""
_log = logging.getLogger(__name__)


class Conformal(Uncertainty):
    """Unchanged densities, each with a set (`prediction_set.py`) that holds the target with probability 1 - α.

    On data that is exchangeable with the validation set, a new target lies in its set with a probability of at least 1
    - α, and of at most 1 - α + 1/(n + 1) if no two of the n scores are equal. This is an average over targets and
    validation sets, for any model, however wrong (Vovk, Gammerman & Shafer 2005, §4.1). It does not hold for each input
    separately. Use it as the outermost wrapper: a wrapper around it keeps the densities and drops the sets.

    The wrapped model is calibrated on a random half of the validation set, always the same, and the threshold is fitted
    to the rest: scores to which a temperature was fitted have no guarantee. Before `calibrate` the set is everything.

    Args:
        miscoverage: α, the share of targets that may lie outside.
        score: "density": one level of density for all inputs, which gives the smallest sets on average; "mass": one
            probability for all inputs, which gives larger sets where the model is uncertain.

    Attributes:
        threshold: the largest score in a set, nats, a float64 buffer.

    Raises:
        UserError: fewer than 2 validation samples, or a score that is NaN (its samples are named).
    """

    bibtex = """@book{vovk2005algorithmic,
  author    = {Vovk, Vladimir and Gammerman, Alexander and Shafer, Glenn},
  title     = {Algorithmic Learning in a Random World},
  publisher = {Springer},
  year      = {2005}
}

@article{sadinle2019least,
  author  = {Sadinle, Mauricio and Lei, Jing and Wasserman, Larry},
  title   = {Least Ambiguous Set-Valued Classifiers with Bounded Error Levels},
  journal = {Journal of the American Statistical Association},
  volume  = {114},
  number  = {525},
  pages   = {223--234},
  year    = {2019}
}

@inproceedings{romano2020classification,
  author    = {Romano, Yaniv and Sesia, Matteo and Cand{\\`e}s, Emmanuel J.},
  title     = {Classification with Valid and Adaptive Coverage},
  booktitle = {Advances in Neural Information Processing Systems},
  year      = {2020}
}"""
    threshold: Tensor

    def __init__(
        self,
        model: Callable[[], Predictor],
        *,
        miscoverage: Annotated[float, Field(gt=0, lt=1)] = 0.1,
        score: Score = "density",
    ) -> None:
        super().__init__()
        self.knobs = {}
        self.model = model()
        self.miscoverage = miscoverage
        self.score: Score = score
        self.register_buffer("threshold", torch.tensor(math.inf, dtype=torch.float64))
        require_state(self, threshold=(-math.inf, math.inf))

    def forward(self, inputs: Tensor) -> PredictionSet:
        """Return the density for each input with its prediction set."""
        return PredictionSet(self.model(inputs), self.threshold, self.score, 1 - self.miscoverage)

    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Calibrate the wrapped model on one half of the batches, and fit the threshold to the other."""
        theirs, mine = halves(nonempty_batches(batches, by="conformal"))
        if not mine:
            raise UserError(
                "conformal shares the validation split with what it wraps, and got one sample of it; wanted 2 or more. "
                "Give the data set a larger validation split."
            )
        self.model.calibrate(theirs)
        sets = [
            PredictionSet(density, self.threshold, self.score)
            for density in predict_densities(self.model, mine)
        ]
        scores = torch.cat([one.scores(batch["target"]) for one, batch in zip(sets, mine, strict=True)])
        require_numbers(scores, mine, "score")
        self.threshold.fill_(threshold(scores, self.miscoverage))
        self.remark = remark(len(scores), self.miscoverage)
        if self.threshold.isinf():
            _log.warning(
                "conformal: with %d validation samples no set short of everything is certain to miss %g of the targets "
                "or fewer; %d would do, if no density ruled them out. The sets are everything.",
                len(scores),
                self.miscoverage,
                math.ceil(1 / self.miscoverage) - 1,
            )


def halves(batches: Sequence[Batch]) -> tuple[list[Batch], list[Batch]]:
    """Return a random half of the samples, rounded up, and the rest, both in order and without empty batches.

    Alternating samples would not do: in many data sets neighbours alternate, or belong together. The split is the same
    for all sets of one size.
    """
    sizes = [len(batch["target"]) for batch in batches]
    order = torch.randperm(sum(sizes), generator=torch.Generator().manual_seed(SEED))
    chosen = torch.zeros(sum(sizes), dtype=torch.bool)
    chosen[order[: (len(order) + 1) // 2]] = True
    found: tuple[list[Batch], list[Batch]] = ([], [])
    for batch, mask in zip(batches, chosen.split(sizes), strict=True):
        for part, some in zip(found, (mask, ~mask), strict=True):
            rows = some.nonzero().flatten().to(batch["target"].device)
            if len(rows):
                part.append({name: field[rows] for name, field in batch.items()})
    return found


def remark(count: int, miscoverage: float) -> str:
    """Return how far the coverage of sets from `count` scores may deviate, and how many rows would reduce that.

    The share that sets from n distinct scores cover is itself random, Beta(k, n + 1 - k) with k as in `threshold` (Vovk
    2012, prop. 2a): on average over validation sets it is k / (n + 1).
    """
    left_out = _left_out(count, miscoverage)
    if not left_out:
        return f"conformal: the threshold is set by {count} validation rows, too few for any: the sets are everything."
    from scipy.special import betaincinv  # importing SciPy takes longer than most commands need it

    low, high = betaincinv(count + 1 - left_out, left_out, [0.05, 0.95])
    told = (
        f"conformal: the threshold is set by {count} validation rows; of sets that so many make, 90 % hold between "
        f"{100 * low:.3g} and {100 * high:.3g} % of the targets, where {100 * (1 - miscoverage):g} % are promised on "
        "average over validation sets"
    )
    if max(high - (1 - miscoverage), 1 - miscoverage - low) <= NEAR:
        return f"{told}."
    wanted = math.ceil(miscoverage * (1 - miscoverage) * (NINETY / NEAR) ** 2)
    return f"{told}. These are few: about {wanted:,} keep it within {100 * NEAR:g} %."


def _left_out(count: int, miscoverage: float) -> int:
    """Return the number of scores at or above the threshold, ⌊(n + 1) α⌋."""
    # α is rounded, so that (n + 1) α may fall just below an integer; the factor corrects that
    return min(count, math.floor((count + 1) * miscoverage * (1 + 1e-12)))


def threshold(scores: Float[Tensor, "sample"], miscoverage: float) -> float:
    """Return the k-th smallest of n scores, k = ⌈(n + 1)(1 - α)⌉; infinite if k > n.

    Source: Vovk, Gammerman & Shafer 2005, §4.1.
    """
    count = len(scores)
    left_out = _left_out(count, miscoverage)  # k is at least 1
    return scores.sort().values[count - left_out].item() if left_out else math.inf
