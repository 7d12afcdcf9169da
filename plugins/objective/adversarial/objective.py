"""The training loss on adversarial neighbours of the training inputs."""

from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.calibration.module_flags import BATCH_NORM, set_flag
from framework.data import Batch
from framework.errors import ConfigError, DataError, NonFiniteLoss
from framework.model import Predictor
from framework.objective import Objective


class Adversarial(Objective):
    """A penalty for losses that grow within ±ε of a training input, in the steepest direction (thesis eq. 2.20).

    The penalty is the weight times the mean loss on x' = x + ε sign(∇ₓ loss(x, y)), with the labels of x. It needs a
    loss that is differentiable in the inputs and does not use the density, so that it works for any head and any
    wrapper.

    Images of type uint8 are read as 0…1, and x' is kept in that range. Floats are used unchanged, and x' may leave
    their range by ε (images that the data plugin augments are floats). Dropout draws another mask for the gradient than
    for the loss at x'. Batch norm normalises x' by its own batch, and does not update its moments.

    Args:
        weight: weight of the penalty, relative to the loss on x itself.
        epsilon: ε, in the units of the inputs; for images, 1 is the range from black to white.

    Raises (in training):
        DataError: inputs of integers that are not bytes.
        ConfigError: the loss does not depend on the inputs by gradient.
        NonFiniteLoss: the gradient in an input is NaN.
    """

    bibtex = """@inproceedings{goodfellow2015explaining,
  author    = {Goodfellow, Ian J. and Shlens, Jonathon and Szegedy, Christian},
  title     = {Explaining and Harnessing Adversarial Examples},
  booktitle = {International Conference on Learning Representations},
  year      = {2015}
}"""

    def __init__(
        self,
        *,
        weight: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0,
        epsilon: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 0.01,
    ) -> None:
        super().__init__()
        self.weight = weight
        self.epsilon = epsilon

    def forward(self, predictor: Predictor, batch: Batch) -> Float[Tensor, ""]:
        """Return the weighted penalty of a batch."""
        inputs = as_floats(batch["input"], predictor)
        # x' is not part of the training distribution, so that it must not enter the running moments
        with set_flag(predictor, BATCH_NORM, "track_running_stats", False):
            moved = inputs + self.epsilon * self._direction(predictor, inputs, batch)
            if batch["input"].dtype == torch.uint8:
                moved = moved.clamp(0, 1)
            losses = predictor.loss(moved, batch["target"])
        return self.weight * losses.sum() / max(1, len(losses))  # no samples, no penalty

    def _direction(self, predictor: Predictor, inputs: Tensor, batch: Batch) -> Tensor:
        """Return sign(∇ₓ[-log p(y | x)]), 0 where the loss is flat (eq. 2.20); no gradient is stored."""
        given = inputs.detach().requires_grad_()
        with torch.enable_grad():
            # the gradient of the sum in one input is that of its own loss
            loss = predictor.loss(given, batch["target"]).sum()
        (gradient,) = torch.autograd.grad(loss, given, allow_unused=True) if loss.requires_grad else (None,)
        if gradient is None:
            raise ConfigError(
                "objective.adversarial moves inputs along the gradient of the loss, but the loss has no gradient in "
                "them; wanted encoders that are differentiable in their inputs. Leave out this objective, or choose "
                "another encoder."
            )
        if gradient.isnan().any():
            rows = gradient.isnan().flatten(1).any(1).nonzero().flatten()
            names = batch["index"][rows] if "index" in batch else rows
            raise NonFiniteLoss(
                f"The gradient of the loss in the inputs is NaN for samples {names.tolist()[:10]} of the training "
                "split. The weights were not changed by this step. Look at these samples, or lower "
                "optimizer.learning_rate."
            )
        return gradient.sign()


def as_floats(inputs: Tensor, predictor: Predictor) -> Tensor:
    """Return the inputs as floating-point numbers, bytes as 0…1, in the dtype of the predictor's parameters.

    Raises:
        DataError: integers that are not bytes.
    """
    if inputs.is_floating_point():
        return inputs
    if inputs.dtype != torch.uint8:
        raise DataError(
            f"objective.adversarial got inputs of type {inputs.dtype}, which cannot be moved a little; wanted floats, "
            "or images as uint8. Leave out this objective."
        )
    dtypes = (parameter.dtype for parameter in predictor.parameters() if parameter.is_floating_point())
    return inputs.to(next(dtypes, torch.get_default_dtype())) / 255
