"""A check that refuses NaN among numbers before they are averaged."""

from jaxtyping import Float
from torch import Tensor

from framework.errors import UserError


def refuse_nan(values: Float[Tensor, "batch"], quantity: str) -> Float[Tensor, "batch"]:
    """Return `values` unchanged after checking that none of them is NaN.

    Args:
        values: the numbers that are checked, one for each sample.
        quantity: name of the numbers in the plural, for the message, such as "entropies of the test split".

    Raises:
        UserError: some values are NaN; the message says how many, and which is the first.
    """
    is_nan = values.isnan()
    if is_nan.any():
        raise UserError(
            f"{int(is_nan.sum())} of {len(values)} {quantity} in this batch are NaN, the first in row "
            f"{int(is_nan.nonzero()[0])}. A mean over the other rows would hide this fault. Check the density head or "
            "the uncertainty wrapper that predicts them (`mode=check`), or leave this metric out."
        )
    return values
