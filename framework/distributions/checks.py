"""A check that refuses NaN among numbers before they are averaged."""

from jaxtyping import Float
from torch import Tensor

from framework.errors import UserError


def refuse_nan(values: Float[Tensor, "batch"], what: str) -> Float[Tensor, "batch"]:
    """Return `values`, one per sample, unchanged if none is NaN.

    Args:
        values: the numbers that are checked.
        what: name of the numbers in the plural, for the message: "entropies of the test split".

    Raises:
        UserError: some values are NaN; the message says how many, and which is the first.
    """
    wrong = values.isnan()
    if wrong.any():
        raise UserError(
            f"{int(wrong.sum())} of {len(values)} {what} in this batch are NaN, the first in row "
            f"{int(wrong.nonzero()[0])}; wanted numbers. A mean over the others would hide it: check the density "
            "head or wrapper that predicts them (`mode=check`), or leave this metric out."
        )
    return values
