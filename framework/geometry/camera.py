"""Pinhole cameras; pixel centres lie at integer coordinates, x right, y down, z forward."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Real
from torch import Tensor

from framework.geometry.rotation import viewpoint_rotation

SHAPES = {"rotation": (3, 3), "translation": (3,), "focal": (2,), "principal": (2,)}
"""Shapes of the tensors of a `Camera`, by the name of its attribute."""
MEANINGS = {"focal": ", (fx, fy), pixels", "principal": ", (cx, cy), pixels"}
"""Meaning and unit of the two numbers of `focal` and of `principal`, for error messages."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion, as in OpenCV: its matrix K is ((fx, 0, cx), (0, fy, cy), (0, 0, 1)).

    A world point X is seen at pixel (fx x/z + cx, fy y/z + cy), where (x, y, z) = rotation @ X + translation.

    Attributes:
        rotation: rotation from world to camera coordinates, determinant +1.
        translation: translation from world to camera coordinates, metres.
        focal: (fx, fy), pixels, > 0; a tensor if its gradient is wanted.
        principal: (cx, cy), pixels; the centre of an image is ((width - 1) / 2, (height - 1) / 2). A tensor if its
            gradient is wanted.
        height: height of the image, pixels.
        width: width of the image, pixels.
        near: smallest depth that is seen, metres, > 0.
    """

    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]
    focal: tuple[float, float] | Float[Tensor, "2"]
    principal: tuple[float, float] | Float[Tensor, "2"]
    height: int
    width: int
    near: float = 1e-3

    def check_shapes(self) -> None:
        """Check the shapes of `rotation`, `translation`, `focal` and `principal`.

        Without this check, a wrong shape would not be noticed: a single focal length would be used for both axes, and
        kernels would read beyond an array.

        Raises:
            ValueError: one of the four has another shape; the message names both shapes.
        """
        for name, expected_shape in SHAPES.items():
            shape = _shape(getattr(self, name))
            if shape != expected_shape:
                got = "a single number" if shape == () else f"the shape {shape}"
                raise ValueError(
                    f"camera.{name} has {got}; expected the shape {expected_shape}{MEANINGS.get(name, '')}."
                )

    def project(
        self, points: Real[Tensor, "*points 3"]
    ) -> tuple[Float[Tensor, "*points 2"], Float[Tensor, "*points"]]:
        """Return pixels (column, row) at which world points are seen, and their depths along the optical axis, metres.

        The pixel has no meaning for a depth that is not above 0. Integers are converted to torch's default float type.

        Raises:
            ValueError: `rotation`, `translation`, `focal` or `principal` has a wrong shape.
        """
        camera_points, focal, principal = self._in_camera_frame(points)
        return focal * camera_points[..., :2] / camera_points[..., 2:] + principal, camera_points[..., 2]

    def to_canonical(self, points: Real[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        """Return world points in coordinates of the `canonical_camera` of the same image size, metres.

        The canonical camera sees them at the same pixels and depths. So the new coordinates alone determine the view,
        and the camera is not needed any more.

        With (x, y, z) = rotation @ X + translation, and with the focal length f and the principal point (c, d) of the
        canonical camera, the new coordinates are ((fx x + (cx - c) z) / f, (fy y + (cy - d) z) / f, z). Let x' be the
        first of them. The canonical camera sees the point at the pixel column f x'/z + c, which equals fx x/z + cx. The
        same holds for the row. The coordinates are differentiable in `points`, `focal` and `principal`. Integers are
        converted to torch's default float type.

        Raises:
            ValueError: `rotation`, `translation`, `focal` or `principal` has a wrong shape.
        """
        camera_points, focal, principal = self._in_camera_frame(points)
        plain = canonical_camera(self.height, self.width)
        depth, middle = camera_points[..., 2:], principal.new_tensor(plain.principal)
        across = focal * camera_points[..., :2] + (principal - middle) * depth
        return torch.cat([across / focal.new_tensor(plain.focal), depth], -1)

    def _in_camera_frame(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return world points in camera coordinates, and `focal` and `principal` as tensors of the same type."""
        self.check_shapes()
        if not points.is_floating_point():  # as integers a rotation would have only the entries -1, 0 and 1
            points = points.to(torch.get_default_dtype())
        camera_points = points @ self.rotation.to(points).T + self.translation.to(points)
        focal, principal = (
            torch.as_tensor(part, dtype=points.dtype, device=points.device)
            for part in (self.focal, self.principal)
        )
        return camera_points, focal, principal


def _shape(numbers: object) -> tuple[int, ...]:
    """Return the shape of a tensor, an array, or a sequence of numbers."""
    if isinstance(numbers, Tensor | np.ndarray):
        return tuple(numbers.shape)
    if not isinstance(numbers, tuple | list):
        return ()
    return (len(numbers), *_shape(numbers[0])) if numbers else (0,)


def focal_length(height: int, field_of_view: float) -> float:
    """Return the focal length, pixels, of an image with `height` rows that shows `field_of_view`, radians, vertically.

    Raises:
        ValueError: the angle is not between 0 and π; it may be in degrees.
    """
    if not 0 < field_of_view < math.pi:
        raise ValueError(
            f"Got field_of_view = {field_of_view:g}; expected radians, above 0 and below π. Give math.radians(degrees)."
        )
    return 0.5 * height / math.tan(0.5 * field_of_view)


def canonical_camera(height: int, width: int) -> Camera:
    """Return the canonical camera for images of a given size: it is at the origin, with the axes of the world.

    The focal length in pixels is the height of the image. The principal point is the centre of the image.
    """
    return Camera(
        rotation=torch.eye(3),
        translation=torch.zeros(3),
        focal=(float(height), float(height)),
        principal=((width - 1) / 2, (height - 1) / 2),
        height=height,
        width=width,
    )


def look_from(
    azimuth: float,
    elevation: float,
    tilt: float,
    distance: float,
    field_of_view: float,
    size: tuple[int, int],
) -> Camera:
    """Return a camera at `distance` (metres) from the origin that looks at the origin.

    The world's z axis points up. The angles follow the annotations of PASCAL3D+.

    Args:
        azimuth: rotation about the vertical, radians; at 0 the camera looks at the object's front, from -y.
        elevation: angle of the camera above the horizontal, radians.
        tilt: rotation of the camera in the image plane, radians.
        distance: distance of the camera from the origin, metres.
        field_of_view: vertical field of view, radians.
        size: (height, width) of the image, pixels.

    Raises:
        ValueError: `field_of_view` is not between 0 and π; it may be in degrees.
    """
    height, width = size
    rotation = viewpoint_rotation(torch.tensor([azimuth, elevation, tilt], dtype=torch.float64))
    # PASCAL3D+ camera frames have y up and look along -z; images have y down and look along +z.
    flip = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64).diag()
    focal = focal_length(height, field_of_view)
    return Camera(
        rotation=(flip @ rotation).float(),
        translation=torch.tensor([0.0, 0.0, distance]),
        focal=(focal, focal),
        principal=((width - 1) / 2, (height - 1) / 2),
        height=height,
        width=width,
    )
