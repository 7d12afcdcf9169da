"""Density of the parameters of a body in an image, with the steps of the fit by which they were estimated."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Independent, Normal

from framework.bodies.parametric import ParametricBody
from framework.distributions.protocol import images, median
from framework.geometry.camera import Camera
from framework.renderer import Renderer, Scene


@dataclass(frozen=True)
class BodyFit:
    """Result of the fit of a parametric body to an image.

    Attributes:
        parameters: parameters of the body at the end of the fit.
        difference: root mean square difference of colours between the given image and the rendered one at the end of
            the fit.
        path: one row for each accepted step. Its columns are the loss, the processor time since the start (seconds) and
            the parameters.
    """

    parameters: Float[Tensor, "parameter"]
    difference: float
    path: Float[Tensor, "step columns"]


class PosedBodyDensity(Independent):
    """Independent normal densities of the parameters of a parametric body, which were fitted to images.

    Args:
        mean, scale: parameters at the end of each fit, and their standard deviations, (*batch, parameter).
        fits: fit of each image, in the order of the flattened batch; None for an input that was no image of a body.
        body_model, renderer, camera: body that the parameters describe, and how it is rendered.
    """

    def __init__(
        self,
        mean: Tensor,
        scale: Tensor,
        fits: Sequence[BodyFit | None],
        body_model: ParametricBody,
        renderer: Renderer,
        camera: Camera,
    ) -> None:
        super().__init__(Normal(mean, scale, validate_args=False), 1, validate_args=False)
        self.fits, self.body_model, self.renderer, self.camera = list(fits), body_model, renderer, camera

    def log_prob(self, value: Tensor) -> Tensor:
        return self.base_dist.log_prob(value).sum(-1)

    def entropy(self) -> Tensor:
        return self.base_dist.entropy().sum(-1)


def scene_of(body_model: ParametricBody, parameters: Float[Tensor, "parameter"], camera: Camera) -> Scene:
    """Return the scene of a body with the given parameters, seen by a camera.

    The colours of the vertices have four channels: red, green, blue, and a constant 1 that gives the silhouette.
    """
    return Scene(body_model(parameters), body_model.faces, body_model.colors, camera)


@images.register
@torch.no_grad()
def _(density: PosedBodyDensity, channels: Collection[str]) -> dict[str, Tensor]:
    """Return rendered images of the bodies at the mode."""
    batch_shape = density.batch_shape
    scenes = [
        scene_of(density.body_model, parameters, density.camera)
        for parameters in density.mode.reshape(-1, *density.event_shape)
    ]
    scenes = [
        replace(scene, colors=None if scene.colors is None else scene.colors[:, :3]) for scene in scenes
    ]
    rendered = density.renderer.batch(scenes, channels)
    stacked = {name: torch.stack([image[name] for image in rendered]) for name in channels}
    return {name: values.reshape(*batch_shape, *values.shape[1:]) for name, values in stacked.items()}


@median.register
def _(density: PosedBodyDensity, samples: int) -> Tensor:
    # each normal density is symmetric about its mean
    return density.mean
