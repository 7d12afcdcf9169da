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
    """Return the predicted images, which are the means of the densities, and the true images, both in sRGB.

    For a predictor of several members, both have a second dimension for the member. In the true images its size is 1 if
    all members read the same samples, and the number of members if each member reads its own samples.

    Raises:
        ConfigError: the target is not an image of red, green and blue.
    """
    with set_flag(
        predictor, BATCH_NORM, "track_running_stats", False
    ):  # the loss has already updated the moments with these inputs
        densities = predictor.training_densities(batch["input"])
    if len(densities.event_shape) != 3 or densities.event_shape[-1] != 3:
        raise ConfigError(
            "An objective for images compares images of three colours, (height, width, 3), but the densities have "
            f"the event shape {tuple(densities.event_shape)}. Leave this objective out, or choose data whose target "
            "is an image."
        )
    images = densities.mean
    count, *members = images.shape[:-3]
    true = batch["target"].to(images.dtype)
    if len(true) > count:  # the rows of the members, concatenated
        return images, true.unflatten(0, (*members, count)).movedim(len(members), 0)
    return images, true.reshape(count, *[1] * len(members), *true.shape[1:])
