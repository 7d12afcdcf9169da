"""Metric `pose_error`: errors of predicted bodies' rotation and translation, and figures of the descents."""

from typing import TYPE_CHECKING, ClassVar, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics.utilities import dim_zero_cat

from framework.errors import ConfigError
from framework.geometry.rotation import geodesic_distance
from framework.metric import HasFigure, Metric
from framework.prediction import Prediction
from framework.target import Target
from plugins.data.bodies.body import turns_less_identity
from plugins.data.bodies.figure import PLACE
from plugins.data.bodies.fit_pose import PoseDensity

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NEAR = (2.0, 1.0)
"""Errors in degrees and centimetres up to which a body counts as found."""


class Shown(NamedTuple):
    """Content of the figure for one sample.

    Attributes:
        start, target, end: images, (height, width, 3), linear RGB.
        degrees, centimetres: error of rotation and translation at the end.
        path: one row for each accepted step: loss, processor time (seconds), degrees, centimetres.
    """

    start: Tensor
    target: Tensor
    end: Tensor
    degrees: float
    centimetres: float
    path: Tensor


class PoseError(Metric, HasFigure):
    """Errors of a body's rotation (geodesic, degrees) and translation (cm), and the share within 2° and 1 cm.

    Medians, 95th percentiles and worst cases are reported, because a descent either succeeds or ends in another
    minimum. If the density holds its descent (`fit_pose`), the figure shows start, target and end of the best, the
    middle and the worst sample, and the errors against steps and time.

    Raises:
        ConfigError: the target does not begin with a rotation and a translation.
    """

    bibtex = """@article{huynh2009metrics,
  author = {Huynh, Du Q.},
  title = {Metrics for {3D} rotations: comparison and analysis},
  journal = {Journal of Mathematical Imaging and Vision},
  volume = {35},
  pages = {155--164},
  year = {2009}
}"""
    columns: ClassVar[dict[str, str]] = {
        "rotation_median_deg": "rotation °",
        "translation_median_cm": "translation cm",
        "found": "within 2°, 1 cm",
    }
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = {
        "rotation_median_deg": "lower",
        "translation_median_cm": "lower",
        "found": "higher",
    }
    figure_name: ClassVar[str] = "pose"
    errors: list[Tensor] | Tensor

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("real", by="metric pose_error")
        if target.names[:6] != PLACE:
            raise ConfigError(
                f"metric pose_error reads {', '.join(PLACE)}, but the target is {target.listed_names}. Choose "
                "data=pose_from_image, or leave this metric out."
            )
        self.add_state("errors", [], dist_reduce_fx="cat")
        self.shown: list[Shown] = []

    def update(self, prediction: Prediction) -> None:
        if len(prediction.target) == 0:
            return
        assert isinstance(self.errors, list)
        found = torch.stack(place_errors(prediction.point, prediction.target), -1)
        self.errors.append(found)
        density = prediction.density
        if isinstance(density, PoseDensity) and "color" in prediction.batch:
            self.shown += [
                _shown(density, prediction, row, errors) for row, errors in enumerate(found.tolist())
            ]

    def compute(self) -> dict[str, Tensor]:
        degrees, centimetres = self._seen().T
        if not len(degrees):
            return {name: torch.tensor(torch.nan, dtype=torch.float64) for name in _KEYS}
        near = (degrees <= NEAR[0]) & (centimetres <= NEAR[1])
        values = [quantile(part) for part in (degrees, centimetres)]
        return dict(zip(_KEYS, (*values[0], *values[1], near.double().mean()), strict=True))

    def reset(self) -> None:
        Metric.reset(self)
        self.shown = []

    def figure(self, title: str, *, synthetic: bool) -> "Figure":
        from plugins.data.bodies.pose_picture import descents, errors

        if not self.shown:
            return errors(self._seen(), title, synthetic=synthetic)
        order = sorted(self.shown, key=lambda one: max(one.degrees / NEAR[0], one.centimetres / NEAR[1]))
        names = {"best": order[0], "middle": order[len(order) // 2], "worst": order[-1]}
        return descents(names, title, synthetic=synthetic)

    def _seen(self) -> Float[Tensor, "sample 2"]:
        return dim_zero_cat(self.errors) if len(self.errors) else torch.empty(0, 2, dtype=torch.float64)


_KEYS = (
    *(f"rotation_{what}_deg" for what in ("median", "95", "worst")),
    *(f"translation_{what}_cm" for what in ("median", "95", "worst")),
    "found",
)


def place_errors(
    found: Float[Tensor, "*batch number"], wanted: Float[Tensor, "*#batch number"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Return the degrees between two rotations and the centimetres between two translations, float64."""
    found, wanted = found.double(), wanted.double().expand_as(found)
    one, other = (
        turns_less_identity(numbers[..., :3]) + torch.eye(3, dtype=torch.float64, device=numbers.device)
        for numbers in (found, wanted)
    )
    apart = torch.linalg.vector_norm(found[..., 3:6] - wanted[..., 3:6], dim=-1)
    return torch.rad2deg(geodesic_distance(one, other)), 100 * apart


def quantile(values: Float[Tensor, "sample"]) -> Float[Tensor, "3"]:
    """Return median, 95th percentile and maximum."""
    return torch.quantile(values, values.new_tensor([0.5, 0.95, 1.0]))


def _shown(density: PoseDensity, prediction: Prediction, row: int, errors: list[float]) -> Shown:
    fit = density.fits[row]
    nominal = density.figure.scene(torch.zeros(density.event_shape), density.camera)
    end = density.figure.scene(density.mean[row], density.camera)
    start, found = (image["color"][..., :3] for image in density.renderer.batch([nominal, end]))
    path = torch.zeros(0, 4, dtype=torch.float64)
    if fit is not None and len(fit.path):
        path = torch.stack(
            [*fit.path[:, :2].T, *place_errors(fit.path[:, 2:], prediction.target[row].cpu())], -1
        )
    return Shown(start, prediction.batch["color"][row].cpu(), found, errors[0], errors[1], path)
