"""Fit of a body to an image by gradient descent through a differentiable renderer, from coarse to fine.

The loss is the squared difference of two images, colours and silhouette, plus a weak prior on the pose. The images are
drawn at a fraction of the size and blurred, so that the loss has a gradient even if the edges of the two images are far
apart. A stage is a descent at one size and one blur (`Stage`); the stages follow each other with growing size and less
blur. The renderer gives the gradient of the rendered image. Steps are quasi-Newton (BFGS with Powell's damping; Nocedal
& Wright 2006, procedure 18.2). The Hessian approximation starts from the optical flow of the rendered image: the change
of a pixel is its gradient along rows and columns times the motion of the surface there (Lucas & Kanade 1981). The body
model gives the derivatives of that motion in closed form.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import avg_pool2d

from framework.bodies.parametric import ParametricBody
from framework.geometry.camera import Camera
from framework.heads.posed_body import BodyFit, scene_of
from framework.renderer import Renderer


class Stage(NamedTuple):
    """Settings of one stage of the fit: a descent on images of reduced size that are blurred.

    Attributes:
        part: the images of the stage have 1/part of the height and the width of the original image.
        blur: standard deviation of the blur, in pixels of the reduced image.
        pull: weight of the prior, which is the sum of the squared parameters in units of their standard deviations. The
            weighted prior is added to the sum of the squared differences of the images, and this sum of differences is
            scaled to the number of pixels of the original image.
    """

    part: int
    blur: float
    pull: float


STAGES = (
    Stage(4, 2.0, 10.0),
    Stage(4, 2.0, 1.0),
    Stage(4, 1.0, 0.3),
    Stage(2, 1.0, 0.03),
    Stage(2, 0.7, 0.003),
    Stage(1, 1.5, 1e-4),
    Stage(1, 0.8, 0.0),
)
AGAIN_FROM = 2
"""Index of the stage at which a restart from another pose begins."""
AFRESH = 6
"""Number of successful steps after which the Hessian approximation is computed anew from the optical flow."""
DAMPING, LEAST = 0.01, 1e-3
"""Damping of the Hessian approximation: DAMPING times its diagonal, plus LEAST, is added to its diagonal."""
LONGEST = (0.2, 0.08)
"""Longest step of a rotation (radians) and of a translation (metres).

For each other parameter, the longest step is its standard deviation among random people.
"""
SHORTER, TRIES = 0.4, 6
"""Factor by which a step is shortened if it does not lower the loss, and largest number of lengths that are tried."""
CONVERGED, IN_A_ROW = 5e-4, 3
"""Relative decrease of the loss below which a step is small, and number of consecutive small steps that end a stage."""


class Descent:
    """Estimator of a body's parameters from images.

    Args:
        body_model: body that the images show.
        renderer: differentiable renderer that draws the body.
        camera: camera of the images.
        steps: largest number of steps of a stage.
        restarts: largest number of restarts from other poses while the rendered and the given image differ by more than
            `enough`.
        enough: root mean square difference of colours up to which no restart is needed.
    """

    def __init__(
        self,
        body_model: ParametricBody,
        renderer: Renderer,
        camera: Camera,
        *,
        steps: int,
        restarts: int,
        enough: float,
    ) -> None:
        self.body_model, self.renderer, self.camera = body_model, renderer, camera
        self.steps, self.restarts, self.enough = steps, restarts, enough
        self.stiffness = torch.cat([body_model.spread.new_zeros(6), body_model.spread[6:] ** -2])
        self.longest = torch.cat(
            [*(body_model.spread.new_full((3,), most) for most in LONGEST), body_model.spread[6:]]
        )

    def __call__(self, picture: Float[Tensor, "height width 4"]) -> BodyFit:
        """Return the fit whose rendered image differs least from `picture`, among the first descent and its restarts.

        The channels of `picture` are linear RGB on black, and the share of each pixel that the body covers. The
        starting poses of the restarts are drawn with a fixed seed, so that the fit depends only on the image.
        """
        began = time.process_time()
        random = torch.Generator().manual_seed(0)
        best = self._once(picture, torch.zeros_like(self.stiffness), STAGES, began)
        path = [best.path]
        for _ in range(self.restarts):
            if best.difference <= self.enough:
                break
            start = best.parameters.clone()
            start[6:] = self.body_model.spread[6:] * torch.randn(
                len(start) - 6, generator=random, dtype=start.dtype
            )
            other = self._once(picture, self._limited(start), STAGES[AGAIN_FROM:], began)
            path.append(other.path)
            best = min(best, other, key=lambda fit: fit.difference)
        return BodyFit(best.parameters, best.difference, torch.cat(path))

    def _once(self, picture: Tensor, start: Tensor, stages: Sequence[Stage], began: float) -> BodyFit:
        numbers, path = start, []
        loss = 0.0
        for stage in stages:
            camera = reduce_camera(self.camera, stage.part)
            aim = blur(reduce_image(picture, stage.part), stage.blur)

            def look(
                at: Tensor, stage: Stage = stage, camera: Camera = camera, aim: Tensor = aim
            ) -> tuple[float, Tensor]:
                return self._loss(at, stage, camera, aim)

            loss, slope = look(numbers)
            curvature, age, small = torch.empty(0), AFRESH, 0
            for _ in range(self.steps):
                if age == AFRESH:
                    curvature, age = self._curvature(numbers, stage), 0
                direction = -torch.linalg.solve(curvature, slope)
                length = min(1.0, 1 / float((direction.abs() / self.longest).max()))
                lower = False
                for _ in range(TRIES):
                    candidate = self._limited(numbers + length * direction)
                    candidate_loss, along = look(candidate)
                    curvature = update_hessian(curvature, candidate - numbers, along - slope)
                    if lower := candidate_loss < loss:
                        break
                    length *= SHORTER
                if not lower and age == 0:
                    break
                age = age + 1 if lower else AFRESH
                if not lower:
                    continue
                small = small + 1 if loss - candidate_loss < CONVERGED * loss else 0
                numbers, loss, slope = candidate, candidate_loss, along
                path.append(torch.cat([numbers.new_tensor([loss, time.process_time() - began]), numbers]))
                if small == IN_A_ROW:
                    break
        unpulled = loss - stages[-1].pull * float((numbers.square() * self.stiffness).sum())
        steps = torch.stack(path) if path else numbers.new_zeros(0, 2 + len(numbers))
        return BodyFit(numbers, (max(unpulled, 0.0) / picture.numel()) ** 0.5, steps)

    def _loss(
        self, numbers: Tensor, stage: Stage, camera: Camera, aim: Tensor
    ) -> tuple[float, Float[Tensor, "number"]]:
        """Return the loss of a stage and its gradient with respect to the parameters `numbers`.

        `camera` and `aim` are the camera of the reduced image, and the given image after it was reduced and blurred.
        """
        with torch.enable_grad():
            variable = numbers.detach().requires_grad_()
            rendered = self.renderer(scene_of(self.body_model, variable, camera))["color"]
            loss = (blur(rendered, stage.blur) - aim).square().sum().double() * stage.part**2
            loss = loss + stage.pull * (variable.square() * self.stiffness).sum()
            (slope,) = torch.autograd.grad(loss, variable)
        return float(loss.detach()), slope

    def _limited(self, numbers: Tensor) -> Tensor:
        least, most = self.body_model.limits.unbind(1)
        return torch.minimum(torch.maximum(numbers, least), most)

    def _curvature(self, numbers: Tensor, stage: Stage) -> Float[Tensor, "number number"]:
        """Return the damped Gauss-Newton approximation of the Hessian of a stage's loss.

        It is twice the sum of outer products of the derivatives of the stage's pixels (`_flow`), plus the Hessian of
        the prior and the damping.
        """
        slopes = self._flow(numbers, stage)
        hessian = 2 * stage.part**2 * (slopes.T @ slopes).double() + (2 * stage.pull * self.stiffness).diag()
        return hessian + (DAMPING * hessian.diag() + LEAST).diag()

    @torch.no_grad()
    def _flow(self, numbers: Tensor, stage: Stage) -> Float[Tensor, "pixel number"]:
        """Return the derivatives of a stage's image with respect to every parameter, from the optical flow.

        The image of a stage is reduced and blurred. The first dimension of the result has one row for each of the four
        channels of each pixel.
        """
        camera, body_model = self.camera, self.body_model
        rendered = self.renderer(scene_of(body_model, numbers, camera), ("color", "face"))
        color, face = rendered["color"], rendered["face"].numpy()
        height, width = camera.height // stage.part, camera.width // stage.part
        if (face < 0).all():
            return color.new_zeros(height * width * 4, len(numbers))
        across, down = torch.zeros_like(color), torch.zeros_like(color)
        across[:, 1:-1] = (color[:, 2:] - color[:, :-2]) / 2
        down[1:-1] = (color[2:] - color[:-2]) / 2
        # a pixel beside the body changes with the nearest part of the body
        nearest = distance_transform_edt(face < 0, return_distances=False, return_indices=True)
        assert isinstance(nearest, np.ndarray)
        shown = torch.from_numpy(face[tuple(nearest)])
        row, column = ((across != 0) | (down != 0)).any(-1).nonzero(as_tuple=True)
        vertex, which = body_model.faces[shown[row, column].long(), 0].long().unique(return_inverse=True)
        motion = self._motion(numbers, vertex)[which]
        flow = torch.stack([across[row, column], down[row, column]], -1) @ motion  # (pixel, 4, number)
        place = (row // stage.part) * width + column // stage.part
        small = color.new_zeros(height * width, flow[0].numel())
        small.index_add_(0, place, flow.flatten(1) / stage.part**2)
        return blur(small.view(height, width, -1), stage.blur).reshape(-1, len(numbers))

    def _motion(self, numbers: Tensor, vertex: Tensor) -> Float[Tensor, "vertex 2 number"]:
        """Return the derivatives of the pixel coordinates of some vertices with respect to every parameter.

        `vertex` holds the indices of the vertices.
        """
        camera = self.camera
        rotation = camera.rotation
        camera_points = self.body_model.vertices(numbers, vertex) @ rotation.T + camera.translation
        along = torch.einsum("ab,vbp->vap", rotation, self.body_model.derivatives(numbers, vertex))
        focal = torch.as_tensor(camera.focal)[:, None]
        part = (camera_points[:, :2] / camera_points[:, 2:])[..., None]
        return focal * (along[:, :2] - part * along[:, 2:]) / camera_points[:, 2:, None]


def update_hessian(
    curvature: Float[Tensor, "number number"], step: Float[Tensor, "number"], change: Float[Tensor, "number"]
) -> Float[Tensor, "number number"]:
    """Return the Hessian approximation after a step, which stays positive definite.

    Args:
        curvature: approximation before the step.
        step: change of the parameters.
        change: change of the gradient.
    """
    expected = curvature @ step
    square = float(step @ expected)
    if not square > 0:
        return curvature
    measured = float(step @ change)
    if measured < 0.2 * square:
        share = 0.8 * square / (square - measured)
        change = share * change + (1 - share) * expected
    return (
        curvature - torch.outer(expected, expected) / square + torch.outer(change, change) / (step @ change)
    )


def reduce_camera(camera: Camera, part: int) -> Camera:
    """Return a camera of the same view, each of whose pixels covers part × part pixels of `camera`."""
    (x, y), (column, row) = camera.focal, camera.principal
    return replace(
        camera,
        focal=(float(x) / part, float(y) / part),
        principal=((float(column) + 0.5) / part - 0.5, (float(row) + 0.5) / part - 0.5),
        height=camera.height // part,
        width=camera.width // part,
    )


def reduce_image(
    picture: Float[Tensor, "height width channels"], part: int
) -> Float[Tensor, "_height _width channels"]:
    """Return the image reduced in size: each of its pixels is the mean of part × part pixels of `picture`."""
    return avg_pool2d(picture.movedim(-1, 0), part).movedim(0, -1)


def blur(
    picture: Float[Tensor, "height width channels"], deviation: float
) -> Float[Tensor, "height width channels"]:
    """Return the image convolved with a Gaussian that is cut at three standard deviations; `deviation` is in pixels.

    The image is taken to be black beyond its border.
    """
    height, width, _ = picture.shape
    rows = (gaussian_matrix(height, deviation) @ picture.flatten(1)).view_as(picture)
    return gaussian_matrix(width, deviation) @ rows


@cache
def gaussian_matrix(length: int, deviation: float) -> Float[Tensor, "length length"]:
    """Return the matrix that convolves a row of `length` pixels with a Gaussian.

    `deviation` is the standard deviation in pixels. For few pixels, multiplying by the matrix is faster than a
    convolution.
    """
    distance = torch.arange(length)[:, None] - torch.arange(length)
    weights = (
        (-0.5 * (distance / deviation).square()).exp().where(distance.abs() <= round(3 * deviation), 0.0)
    )
    reach = torch.arange(-round(3 * deviation), round(3 * deviation) + 1)
    return weights / (-0.5 * (reach / deviation).square()).exp().sum()
