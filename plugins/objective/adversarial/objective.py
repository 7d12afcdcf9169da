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
    """A penalty on the loss at adversarial inputs, within ±ε of the training inputs (thesis eq. 2.20).

    The penalty is the weight times the mean loss on x' = x + ε sign(∇ₓ loss(x, y)), with the targets of x. The penalty
    does not use the density. It needs only a loss that is differentiable in the inputs, so it works for any density
    head and any uncertainty wrapper.

    Images of type uint8 are converted to 0…1, and x' stays in this range. Floating-point inputs are used unchanged, and
    x' may leave their range by ε (images that the data plugin augments are floating-point). Dropout uses different
    masks for the gradient and for the loss at x'. Batch norm normalises x' by the moments of its own batch, and does
    not update the running moments.

    Args:
        weight: weight of the penalty, relative to the loss on x itself.
        epsilon: ε, in the units of the inputs; for images, 1 is the range from black to white.

    Raises (in training):
        DataError: the inputs are integers of another type than uint8.
        ConfigError: the loss has no gradient in the inputs.
        NonFiniteLoss: the gradient of the loss in an input is NaN.
    """

    bibtex = "goodfellow2015explaining"

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
        # x' is not from the training distribution and must not change the running moments of batch norm
        with set_flag(predictor, BATCH_NORM, "track_running_stats", False):
            moved = inputs + self.epsilon * self._direction(predictor, inputs, batch)
            if batch["input"].dtype == torch.uint8:
                moved = moved.clamp(0, 1)
            losses = predictor.loss(moved, batch["target"])
        return self.weight * losses.sum() / max(1, len(losses))  # without samples the penalty is 0

    def _direction(self, predictor: Predictor, inputs: Tensor, batch: Batch) -> Tensor:
        """Return sign(∇ₓ loss(x, y)) for the inputs x and the targets y of the batch (eq. 2.20).

        It is 0 where the loss does not depend on x. No gradient flows to the predictor's parameters.
        """
        leaf = inputs.detach().requires_grad_()
        with torch.enable_grad():
            # the gradient of the sum in one input is the gradient of this input's own loss
            loss = predictor.loss(leaf, batch["target"]).sum()
        (gradient,) = torch.autograd.grad(loss, leaf, allow_unused=True) if loss.requires_grad else (None,)
        if gradient is None:
            raise ConfigError(
                "objective.adversarial moves inputs along the gradient of the loss, but the loss has no gradient in "
                "the inputs. Choose encoders that are differentiable in their inputs, or leave out this objective."
            )
        if gradient.isnan().any():
            rows = gradient.isnan().flatten(1).any(1).nonzero().flatten()
            names = batch["index"][rows] if "index" in batch else rows
            raise NonFiniteLoss(
                f"The gradient of the loss in the inputs is NaN for samples {names.tolist()[:10]} of the training "
                "split. This step did not change the weights. Check these samples, or lower optimizer.learning_rate."
            )
        return gradient.sign()


def as_floats(inputs: Tensor, predictor: Predictor) -> Tensor:
    """Return floating-point inputs unchanged, and uint8 inputs as 0…1 in the dtype of the predictor's parameters.

    Raises:
        DataError: the inputs are integers of another type.
    """
    if inputs.is_floating_point():
        return inputs
    if inputs.dtype != torch.uint8:
        raise DataError(
            f"objective.adversarial got inputs of type {inputs.dtype}, which cannot be changed by a small amount. "
            "Floating-point inputs or images of type uint8 are required; otherwise leave out this objective."
        )
    dtypes = (parameter.dtype for parameter in predictor.parameters() if parameter.is_floating_point())
    return inputs.to(next(dtypes, torch.get_default_dtype())) / 255
