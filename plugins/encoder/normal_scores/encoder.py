"""Normal scores of numbers: the normal quantiles of their ranks among the training samples."""

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from framework.encoder import Encoder, FitsInputs, require_numbers
from framework.storage.weights import require_state

KNOTS = 128
"""Largest number of stored values of an input number; between these values the scores are interpolated."""
WIDEST = 8.0
"""Bound of the scores, which no rank of float64 exceeds."""


class NormalScores(Encoder, FitsInputs):
    """All numbers of the flattened input, followed by their normal scores.

    The score of a value is Φ⁻¹((r - ½)/n) for its rank r among n training values (Blom 1958, ch. 6; equal values share
    their mean rank), scaled to mean 0 and standard deviation 1 over the training samples. Between training values the
    score is interpolated linearly, and beyond them it is constant. So skewed numbers become normal, and no extreme
    value leaves the range that the model was trained on, while the unchanged number preserves distances. Before
    `fit_inputs`, the score of a number is the number itself, clamped to ±3.

    Args:
        input_shape: any; a sample is flattened.
    """

    bibtex = "blom1958statistical"
    fixed = True

    values: Tensor
    scores: Tensor

    def __init__(self, input_shape: tuple[int, ...]) -> None:
        super().__init__()
        length = require_numbers(input_shape, by="normal_scores")
        line = torch.linspace(-3, 3, KNOTS, dtype=torch.float64).expand(length, KNOTS)
        self.register_buffer("values", line.clone())
        self.register_buffer("scores", line.clone())
        limit = torch.finfo(torch.float32).max
        require_state(self, values=(-limit, limit), scores=(-WIDEST, WIDEST))
        self.output_shape = (2 * length,)

    def forward(self, inputs: Tensor) -> Float[Tensor, "batch length"]:
        """Return the numbers, then their scores."""
        numbers = inputs.flatten(1)
        dtype = self.values.dtype if not inputs.is_floating_point() else inputs.dtype
        numbers = numbers.to(dtype)
        values, scores = self.values.to(numbers), self.scores.to(numbers)
        slopes = scores.diff() / torch.where(values.diff() > 0, values.diff(), 1.0)
        if torch.compiler.is_exporting():  # a search in a sorted list is not an operation of ONNX
            inside = torch.minimum((numbers.unsqueeze(-1) - values[:, :-1]).clamp(min=0), values.diff())
            return torch.cat([numbers, scores[:, 0] + (inside * slopes).sum(-1)], 1)
        inside = numbers.T.clamp(values[:, :1], values[:, -1:]).contiguous()
        piece = (torch.searchsorted(values, inside, right=True) - 1).clamp(0, KNOTS - 2)
        start = inside - values.gather(1, piece)
        return torch.cat([numbers, (scores.gather(1, piece) + start * slopes.gather(1, piece)).T], 1)

    @torch.no_grad()
    def fit_inputs(self, batches: Iterable[Float[Tensor, "batch *input"]]) -> None:
        """Compute the stored values of each number, and their scores, from the training samples."""
        inputs = torch.cat(list(batches))
        for number, column in enumerate(inputs.flatten(1).double().T):
            values, scores = fit_scores(column)
            # a shorter list is filled with its last value, so that the pieces behind it have the length 0
            filling = KNOTS - len(values)
            self.values[number] = torch.cat([values, values[-1:].expand(filling)])
            self.scores[number] = torch.cat([scores, scores[-1:].expand(filling)])


def fit_scores(column: Float[Tensor, "sample"]) -> tuple[Float[Tensor, "knot"], Float[Tensor, "knot"]]:
    """Return the knots between which the scores of one input number are interpolated.

    Args:
        column: values of the number in the training samples.

    Returns:
        Up to KNOTS ascending values, and their standardised scores; the score is 0 if all values are equal.
    """
    values, where, counts = torch.unique(column, return_inverse=True, return_counts=True)
    if len(values) == 1:
        return values, torch.zeros_like(values)
    scores = torch.special.ndtri((counts.cumsum(0) - counts / 2).double() / len(column))
    training = scores[where]
    scores = ((scores - training.mean()) / training.std(correction=0)).clamp(-WIDEST, WIDEST)
    if len(values) > KNOTS:
        # equally far apart in their scores, so that the tails are resolved too
        wanted = torch.linspace(float(scores[0]), float(scores[-1]), KNOTS, dtype=scores.dtype)
        after = torch.searchsorted(scores, wanted).clamp(1, len(scores) - 1)
        nearer = after - (wanted - scores[after - 1] < scores[after] - wanted).long()
        chosen = nearer.unique()
        values, scores = values[chosen], scores[chosen]
    return values, scores
