"""Training loss at noisy inputs."""

from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.calibration.module_flags import BATCH_NORM, set_flag
from framework.data import Batch
from framework.model import Predictor
from framework.objective import Objective


class Example(Objective):
    """Penalty on the loss at noisy inputs: the weight times the mean loss at x + noise, with the targets of x.

    The noise is normal and independent in every number of an input.

    Args:
        weight: weight of the penalty, relative to the loss at the training inputs themselves.
        deviation: standard deviation of the noise, in the unit of the inputs; for
            images, 1 is the range from black to white.
    """

    bibtex = ""

    def __init__(
        self,
        *,
        weight: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0,
        deviation: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 0.1,
    ) -> None:
        super().__init__()
        self.weight = weight
        self.deviation = deviation

    def forward(self, predictor: Predictor, batch: Batch) -> Float[Tensor, ""]:
        """Return the weighted penalty on a batch; 0 for an empty batch."""
        inputs = batch["input"]
        if not inputs.is_floating_point():  # images
            inputs = inputs / 255
        noisy = inputs + self.deviation * torch.randn_like(inputs)
        # noisy inputs must not change the running moments of batch norm
        with set_flag(predictor, BATCH_NORM, "track_running_stats", False):
            losses = predictor.loss(noisy, batch["target"])
        return self.weight * losses.sum() / max(1, len(losses))
