"""The images that a predictor gives while it trains."""

from jaxtyping import Float
from torch import Tensor

from framework.calibration.module_flags import BATCH_NORM, flagged
from framework.data import Batch
from framework.errors import ConfigError
from framework.model import Predictor


def predicted_images(
    predictor: Predictor, batch: Batch
) -> Float[Tensor, "batch *member height width number"]:
    """Means of the densities of the batch's inputs, in numbers as files hold them.

    Raises:
        ConfigError: the target is no image of red, green and blue.
    """
    with flagged(
        predictor, BATCH_NORM, "track_running_stats", False
    ):  # the loss has told them of these inputs
        densities = predictor.training_densities(batch["input"])
    if len(densities.event_shape) != 3 or densities.event_shape[-1] != 3:
        raise ConfigError(
            f"Targets are of shape {tuple(densities.event_shape)}; wanted images of three colours, (height, width, 3), "
            "which this objective compares. Leave it out, or choose other data."
        )
    return densities.mean
