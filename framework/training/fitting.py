"""Fitting of density heads that learn from the whole training split at once."""

from collections.abc import Iterable

import torch

from framework.data import Batch
from framework.density_head import Fitted
from framework.errors import DataError
from framework.model import Predictor, fitted_models
from framework.training.batches import Batches


@torch.no_grad()
def fit_at_once(predictor: Predictor, batches: Batches, seed: int) -> None:
    """Fit every density head of class `Fitted`, in one step, to the features of the training split.

    The members of an ensemble use different seeds.

    Args:
        predictor: the predictor that reads the batches' inputs.
        batches: batches without augmentation.
        seed: seed of the first head; each further head gets the next one.

    Raises:
        DataError: a feature is not finite; the message names the sample.
    """
    if not fitted_models(predictor):
        return
    loaded = list(batches.of(batches.data.splits().train))
    target = torch.cat([batch["target"] for batch in loaded])
    for number, model in enumerate(fitted_models(predictor)):
        features = torch.cat([model.raw(batch["input"]) for batch in loaded])
        bad = (~features.isfinite()).any(1).nonzero().flatten()
        if len(bad):
            index = torch.cat([batch["index"] for batch in loaded])[bad[0]]
            raise DataError(
                f"{len(bad)} of {len(features)} training samples have features that are not finite; the first is "
                f"sample {int(index)}. Correct or leave out these samples, or check the encoder."
            )
        assert isinstance(model.head, Fitted)
        model.head.fit(features, target, seed + number)


@torch.no_grad()
def mean_loss(predictor: Predictor, batches: Iterable[Batch]) -> float:
    """Return the mean loss over all samples of the batches, nats."""
    losses = [predictor.loss(batch["input"], batch["target"]) for batch in batches]
    return float(torch.cat(losses).mean())
