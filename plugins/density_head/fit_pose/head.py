"""Density head `fit_pose`: fit of a body to the image that the head reads."""

from collections.abc import Mapping
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.distributions import Distribution

from framework.bodies.parametric import ImageSide, parametric_body
from framework.configuration.paths import FilePath
from framework.density_head import DensityHead, Fitted
from framework.errors import ConfigError
from framework.heads.parameters import require_finite
from framework.heads.posed_body import BodyFit, PosedBodyDensity
from framework.renderer import Renderer
from framework.storage.weights import require_state
from framework.target import Target
from plugins.density_head.fit_pose.descent import Descent

FLOOR, WIDEST = 1e-5, 1e9
"""Bounds on the standard deviation of a parameter."""
SLACK = 1e-3
"""Largest distance of an image's values from the range [0, 1] that is accepted as rounding error."""
NEEDED = frozenset(("vertices",))
"""Parts of a scene with respect to which the rendered image must be differentiable (`Renderer.differentiable`)."""


class FitPoseHead(DensityHead, Fitted):
    """Fit of a body's pose to an image by gradient descent through a differentiable renderer.

    The descent (plugins.density_head.fit_pose.descent) starts from the nominal pose. The head reads images of
    `data=pose_from_image` unchanged, without an encoder. The density is normal, with the end of the descent as its
    mean. `calibrate` sets its standard deviations to the root mean square errors on the validation split. Fits whose
    image agrees with the input to within `enough` have other standard deviations than the other fits. Before
    calibration, and for inputs that are not images of a body (numbers outside [0, 1], or no silhouette), the density is
    that of the training split: mean 0, and the standard deviations of the targets. The gradient of the density with
    respect to the image is set to 0.

    Attributes:
        steps: largest number of steps of a stage (a knob).

    Args:
        renderer: differentiable renderer that draws the body for the comparison with the image.
        steps: largest number of steps of a stage; there are seven stages.
        restarts: largest number of restarts from other poses while the rendered and the given image differ by more than
            `enough`.
        enough: root mean square difference of colours below which the rendered and the given image agree.
        height, width, body: the same values as in the config of the data.

    Raises:
        ConfigError: the renderer has no gradient, or the target belongs to another body.
    """

    knobs: ClassVar[Mapping[str, tuple[int, ...]]] = {"steps": (1, 3, 10, 30)}
    bibtex = "lucas1981iterative"

    prior: Tensor
    spread: Tensor

    def __init__(
        self,
        target: Target,
        *,
        renderer: Renderer = "rasterizer",  # pyright: ignore[reportArgumentType]  # built by the framework
        steps: Annotated[int, Field(ge=1, le=1000)] = 30,
        restarts: Annotated[int, Field(ge=0, le=100)] = 1,
        enough: Annotated[float, Field(gt=0, le=1)] = 0.003,
        height: ImageSide = 128,
        width: ImageSide = 96,
        body: FilePath | None = None,
    ) -> None:
        super().__init__()
        target.require("real", by="density_head fit_pose")
        if missing := NEEDED - renderer.differentiable or {"color", "face"} - renderer.channels:
            raise ConfigError(
                "density_head fit_pose needs a renderer that draws color and face, and that is differentiable in the "
                f"vertices, but density_head.renderer={type(renderer).__name__} lacks {' and '.join(sorted(missing))}. "
                "Choose another renderer."
            )
        self.body_model = parametric_body(body)
        if target.names != self.body_model.names:
            raise ConfigError(
                f"density_head fit_pose fits {self.body_model.source}, whose parameters are "
                f"{', '.join(self.body_model.names)}, but the targets of this data set are {target.listed_names}. "
                "Choose data=pose_from_image, with the same body for both."
            )
        self.camera = self.body_model.camera(height, width)
        self.renderer = renderer
        self.steps, self.restarts, self.enough = steps, restarts, enough
        self.size = 4 * height * width
        numbers = len(target.names)
        spread = torch.tensor(target.scale or (1.0,) * numbers, dtype=torch.float64)
        self.register_buffer("prior", spread)
        self.register_buffer("spread", spread.expand(2, -1).clone())
        within = min(FLOOR, float(spread.min())), max(WIDEST, float(spread.max()))
        require_state(self, prior=within, spread=within)

    def fit(self, features: Float[Tensor, "sample size"], target: Tensor, seed: int) -> None:
        self.prior.copy_(target.double().square().mean(0).sqrt().clamp(min=FLOOR))
        self.spread.copy_(self.prior.expand(2, -1))

    def forward(self, raw: Float[Tensor, "*batch size"]) -> Distribution:
        raw = require_finite(raw, self.size)
        fits = self._fits(raw)
        # small changes of an image, below its rounding, do not change the end of a descent; the gradient is set to 0
        zero = (raw * 0).sum(-1, keepdim=True)
        mean = self._rows([self.prior * 0 if fit is None else fit.parameters for fit in fits], raw) + zero
        scale = self._rows([self._width(fit) for fit in fits], raw)
        return PosedBodyDensity(mean, scale, fits, self.body_model, self.renderer, self.camera)

    @torch.no_grad()
    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        fits = self._fits(require_finite(raw, self.size))
        for agrees in (True, False):
            errors = [
                fit.parameters - wanted
                for fit, wanted in zip(fits, target.double().cpu(), strict=True)
                if fit is not None and self._agrees(fit) == agrees
            ]
            if errors:
                square = torch.stack(errors).square().mean(0)
                self.spread[int(agrees)] = square.sqrt().clamp(min=FLOOR).to(self.spread)

    def _fits(self, raw: Tensor) -> list[BodyFit | None]:
        """Return the fit of each image of a flattened batch; None for inputs that are not images of a body."""
        descent = Descent(
            self.body_model,
            self.renderer,
            self.camera,
            steps=self.steps,
            restarts=self.restarts,
            enough=self.enough,
        )
        pictures = raw.detach().reshape(-1, 4, self.camera.height, self.camera.width)
        return [
            descent(picture.clamp(0, 1).to("cpu", torch.float32).movedim(0, -1).contiguous())
            if is_picture(picture)
            else None
            for picture in pictures
        ]

    def _agrees(self, fit: BodyFit) -> bool:
        return fit.difference <= self.enough

    def _width(self, fit: BodyFit | None) -> Float[Tensor, "number"]:
        return self.prior if fit is None else self.spread[int(self._agrees(fit))]

    def _rows(self, rows: list[Tensor], raw: Tensor) -> Float[Tensor, "*batch number"]:
        stacked = torch.stack(rows) if rows else self.prior.new_zeros(0, len(self.prior))
        return stacked.to(raw).reshape(*raw.shape[:-1], len(self.prior))


def is_picture(picture: Float[Tensor, "4 height width"]) -> bool:
    """Return whether an input may be the image of a body: values in [0, 1] up to rounding, and a silhouette."""
    return bool((picture >= -SLACK).all() and (picture <= 1 + SLACK).all() and (picture[3] > 0.5).any())
