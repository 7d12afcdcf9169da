"""The validation split, from which wrappers are calibrated after training: its batches and their predicted densities.

The batches can be read repeatedly. The densities have no gradient.
"""

from collections.abc import Iterable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution

from framework.calibration.module_flags import evaluation_mode
from framework.data import Batch
from framework.errors import UserError
from framework.model import Predictor
from framework.uncertainty import held_out


def nonempty_batches(batches: Iterable[Batch], by: str) -> list[Batch]:
    """Return the batches that have samples as a list, which the wrapped predictor and the wrapper can both read.

    Args:
        batches: batches that may be iterated only once.
        by: name of the wrapper, for the error message.

    Raises:
        UserError: there is no sample in any batch.
    """
    nonempty = [batch for batch in batches if len(batch["target"])]
    if not nonempty:
        raise UserError(
            f"{by} is calibrated on the validation split, but this split is empty. Give the data set a validation "
            f"split (the README of the data set says how), or leave {by} out."
        )
    return nonempty


@torch.no_grad()
def predict_densities(model: Predictor, batches: Sequence[Batch]) -> list[Distribution]:
    """Return the density of each batch, computed in evaluation mode and without gradient.

    Samples on which a wrapper has trained its models itself (`SelfTraining`) are predicted by models that did not see
    them.
    """
    densities = []
    with evaluation_mode(model):
        for batch in batches:
            with held_out(model, batch):
                densities.append(model(batch["input"]))
    return densities


def require_numbers(values: Float[Tensor, "sample"], batches: Sequence[Batch], quantity: str) -> None:
    """Raise an error if one of `values` is NaN, because the mean of the values would then be NaN.

    Args:
        values: one number per sample of all batches, in order.
        batches: the batches.
        quantity: name of the numbers, for the message.

    Raises:
        UserError: a number is NaN; the message names the samples.
    """
    bad = values.isnan().nonzero().flatten().tolist()
    if bad:
        # "index" is the number of a sample in its split, if batches have it
        numbered = all("index" in batch for batch in batches)
        names = torch.cat([batch["index"] for batch in batches])[bad].tolist() if numbered else bad
        more = f" and {len(names) - 10} more" if len(names) > 10 else ""
        raise UserError(
            f"The {quantity} of validation samples {names[:10]}{more} is NaN; expected numbers, which may be infinite. "
            "Nothing is fitted to the other samples. Check these samples and the training, which may have diverged."
        )
