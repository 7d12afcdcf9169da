"""Choice of the images that a figure shows, which does not depend on their order."""

from jaxtyping import Float
from torch import Tensor

KEPT = 8
"""Number of random images that a metric keeps for its figure."""


def choose_images(facts: Float[Tensor, "image 2"]) -> list[int]:
    """Return the rows of the images that the figure may show, in ascending order.

    These are the images with the lowest and the highest score, and KEPT random images. The choice does not depend on
    the order of the images. Images without a score (NaN) are left out.

    Args:
        facts: for each image, its score and its index in the data set.
    """
    rows = facts.tolist()
    known = sorted((row for row, (score, _) in enumerate(rows) if score == score), key=rows.__getitem__)
    # Knuth's multiplicative hash
    random = sorted(known, key=lambda row: int(rows[row][1]) * 2654435761 % 2**32)
    return sorted({*known[:1], *known[-1:], *random[:KEPT]})
