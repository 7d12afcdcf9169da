"""Predicted and true images of a batch during training."""

from jaxtyping import Float
from torch import Tensor

from framework.calibration.module_flags import BATCH_NORM, set_flag
from framework.data import Batch
from framework.errors import ConfigError
from framework.model import Predictor


def predicted_images(
    predictor: Predictor, batch: Batch
) -> tuple[
    Float[Tensor, "batch *member height width number"], Float[Tensor, "batch *_member height width number"]
]:
    """Return the means of the densities of the batch's inputs, in numbers as files hold them, and the true images.

    The true images have one member if all members read the same rows, and as many as there are if each has its own
    rows.

    Raises:
        ConfigError: the target is no image of red, green and blue.
    """
    with set_flag(
        predictor, BATCH_NORM, "track_running_stats", False
    ):  # the loss has already updated the moments with these inputs
        densities = predictor.training_densities(batch["input"])
    if len(densities.event_shape) != 3 or densities.event_shape[-1] != 3:
        raise ConfigError(
            f"Targets are of shape {tuple(densities.event_shape)}; wanted images of three colours, (height, width, 3), "
            "which this objective compares. Leave it out, or choose other data."
        )
    images = densities.mean
    count, *members = images.shape[:-3]
    true = batch["target"].to(images.dtype)
    if len(true) > count:  # the rows of the members, concatenated
        return images, true.unflatten(0, (*members, count)).movedim(len(members), 0)
    return images, true.reshape(count, *[1] * len(members), *true.shape[1:])
