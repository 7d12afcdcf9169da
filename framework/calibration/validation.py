"""The validation set as wrappers see it after training: more than once, and as densities without gradient."""

from collections.abc import Iterable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution

from framework.data import Batch
from framework.errors import UserError
from framework.model import Predictor


def repeatable(batches: Iterable[Batch], by: str) -> list[Batch]:
    """Batches that may come only once, held so that what is wrapped and the wrapper itself can both read them.

    Raises:
        UserError: no sample in any of them.
    """
    held = [batch for batch in batches if len(batch["target"])]
    if not held:
        raise UserError(
            f"{by} is calibrated on the validation split, but got no sample of it. Give the data set one "
            f"(its README says how), or leave {by} out."
        )
    return held


@torch.no_grad()
def densities(model: Predictor, batches: Sequence[Batch]) -> list[Distribution]:
    """Of each batch, in evaluation mode, without a graph to the weights."""
    training = model.training
    try:
        return [model.eval()(batch["input"]) for batch in batches]
    finally:
        model.train(training)


def require_numbers(found: Float[Tensor, "sample"], batches: Sequence[Batch], what: str) -> None:
    """Refuse NaN, whose mean says nothing of anybody.

    Args:
        found: one number a sample of all batches, in order.
        what: they are.

    Raises:
        UserError: names the samples.
    """
    bad = found.isnan().nonzero().flatten().tolist()
    if bad:
        # a batch that numbers its samples says which they are in their split
        numbered = all("index" in batch for batch in batches)
        names = torch.cat([batch["index"] for batch in batches])[bad].tolist() if numbered else bad
        more = f" and {len(names) - 10} more" if len(names) > 10 else ""
        raise UserError(
            f"The {what} of validation samples {names[:10]}{more} is not a number; wanted numbers, or infinities. "
            "Nothing is fitted to the others. Look at these samples and at the training, which may have diverged."
        )
