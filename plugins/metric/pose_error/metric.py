"""Metric `pose_error`: errors of predicted bodies' rotation and translation, and figures of the descents."""

from typing import TYPE_CHECKING, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics.utilities import dim_zero_cat

from framework.bodies.parametric import PLACE
from framework.errors import ConfigError
from framework.heads.posed_body import PosedBodyDensity, scene_of
from framework.metric import Directions, HasFigure, Metric
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.pose_error.errors import NEAR, FittedImage, place_errors

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class PoseError(Metric, HasFigure):
    """Errors of a body's rotation (geodesic, degrees) and translation (cm), and the share within 2° and 1 cm.

    Medians, 95th percentiles and worst cases are reported, because the descent of a fit either reaches the true pose or
    ends in another minimum. If the density stores its descent (as `fit_pose` does), the figure shows the images of
    start, target and end for the best, the median and the worst sample, their errors after each step, and the time of
    their fits.

    Raises:
        ConfigError: the target does not begin with a rotation and a translation.
    """

    bibtex = "huynh2009metrics"
    columns: ClassVar[dict[str, str]] = {
        "rotation_median_deg": "rotation °",
        "translation_median_cm": "translation cm",
        "found": "within 2°, 1 cm",
    }
    better: ClassVar[Directions] = {**dict.fromkeys(columns, "lower"), "found": "higher"}
    figure_name: ClassVar[str] = "pose"
    errors: list[Tensor] | Tensor

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("real", by="metric pose_error")
        if target.names[:6] != PLACE:
            raise ConfigError(
                f"metric pose_error requires a target that begins with {', '.join(PLACE)}, but the target is "
                f"{target.listed_names}. Choose data=pose_from_image, or leave this metric out."
            )
        self.add_state("errors", [], dist_reduce_fx="cat")
        self.fitted_images: list[FittedImage] = []

    def update(self, prediction: Prediction) -> None:
        if len(prediction.target) == 0:
            return
        assert isinstance(self.errors, list)
        pairs = torch.stack(place_errors(prediction.point, prediction.target), -1)
        self.errors.append(pairs)
        density = prediction.density
        if isinstance(density, PosedBodyDensity) and "color" in prediction.batch:
            self.fitted_images += [
                _fitted_image(density, prediction, row, errors) for row, errors in enumerate(pairs.tolist())
            ]

    def compute(self) -> dict[str, Tensor]:
        degrees, centimetres = self._all_errors().T
        if not len(degrees):
            return {name: torch.tensor(torch.nan, dtype=torch.float64) for name in _KEYS}
        near = (degrees <= NEAR[0]) & (centimetres <= NEAR[1])
        values = [quantile(part) for part in (degrees, centimetres)]
        return dict(zip(_KEYS, (*values[0], *values[1], near.double().mean()), strict=True))

    def reset(self) -> None:
        Metric.reset(self)
        self.fitted_images = []

    def figure(self, title: str, *, synthetic: bool) -> "Figure":
        from plugins.metric.pose_error.figure import draw_descents, draw_errors

        if not self.fitted_images:
            return draw_errors(self._all_errors(), title, synthetic=synthetic)
        order = sorted(
            self.fitted_images, key=lambda sample: max(sample.degrees / NEAR[0], sample.centimetres / NEAR[1])
        )
        names = {"best": order[0], "middle": order[len(order) // 2], "worst": order[-1]}
        return draw_descents(names, title, synthetic=synthetic)

    def _all_errors(self) -> Float[Tensor, "sample 2"]:
        return dim_zero_cat(self.errors) if len(self.errors) else torch.empty(0, 2, dtype=torch.float64)


_KEYS = (
    *(f"rotation_{statistic}_deg" for statistic in ("median", "95", "worst")),
    *(f"translation_{statistic}_cm" for statistic in ("median", "95", "worst")),
    "found",
)


def quantile(values: Float[Tensor, "sample"]) -> Float[Tensor, "3"]:
    """Return median, 95th percentile and maximum."""
    return torch.quantile(values, values.new_tensor([0.5, 0.95, 1.0]))


def _fitted_image(
    density: PosedBodyDensity, prediction: Prediction, row: int, errors: list[float]
) -> FittedImage:
    fit = density.fits[row]
    nominal = scene_of(density.body_model, torch.zeros(density.event_shape), density.camera)
    end = scene_of(density.body_model, density.mean[row], density.camera)
    start, end_image = (image["color"][..., :3] for image in density.renderer.batch([nominal, end]))
    path = torch.zeros(0, 4, dtype=torch.float64)
    if fit is not None and len(fit.path):
        path = torch.stack(
            [*fit.path[:, :2].T, *place_errors(fit.path[:, 2:], prediction.target[row].cpu())], -1
        )
    return FittedImage(start, prediction.batch["color"][row].cpu(), end_image, errors[0], errors[1], path)
