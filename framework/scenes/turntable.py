"""Cameras that look at a subject, described by angles or by a file, and cameras on a circle around the subject."""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from framework.errors import DataError, did_you_mean, quote
from framework.geometry.camera import Camera, focal_length
from framework.geometry.rotation import about_z, viewpoint_rotation
from framework.renderer import Scene
from framework.scenes.parts import Axis
from framework.storage.plain_values import LARGEST_YAML, plain_numbers, read_yaml
from framework.storage.reading import read_bytes, translate_errors
from framework.storage.text import decode

MARGIN = 1.03
"""Factor on the smallest distance from which the whole sphere around the subject is visible."""
NEAR = 1e-3
"""Distance of the near plane from the camera, metres.

If a subject is nearer than 1 m, the near plane is at NEAR times the subject's distance.
"""
LONGEST_SIDE = 2**14
ROTATION_ERROR = 1e-4
"""Largest allowed difference between R Rᵀ and the identity; files hold rounded numbers."""
UPRIGHT = {
    "y": torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=torch.float64),
    "z": torch.eye(3, dtype=torch.float64),
}
"""Rotations that make z the upward axis of a scene, by the axis that points upwards before the rotation.

The front of a scene looks towards z if y points upwards, and towards -y if z points upwards. After the rotation it
always looks towards -y.
"""
IMAGE = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64).diag()
"""Rotation from a viewer's axes (x right, y up, z backwards) to a camera's axes."""
KEYS = ("K", "R", "t", "size")


@dataclass(frozen=True)
class BoundingSphere:
    """A sphere around a subject.

    Attributes:
        centre: centre of the subject's bounding box.
        radius: distance from the centre to the farthest corner of a face.
    """

    centre: Float[Tensor, "3"]
    radius: float


def bounding_sphere(scene: Scene) -> BoundingSphere:
    """Return the sphere around a scene's faces."""
    corners = scene.vertices[scene.faces.flatten().unique()].double()
    centre = corners.amin(0) / 2 + corners.amax(0) / 2
    radius = float((corners - centre).norm(dim=1).max())
    if not math.isfinite(radius):
        raise DataError(
            "the scene is too large for its radius to be computed. Scale the scene so that all coordinates are below "
            "1e150."
        )
    return BoundingSphere(centre, radius or 1.0)


def look_at(
    sphere: BoundingSphere,
    up: Axis,
    angles: tuple[float, float, float],
    distance: float | None,
    field_of_view: float,
    size: tuple[int, int],
) -> Camera:
    """Return a camera that sees the subject's centre in the middle of the image.

    Args:
        sphere: sphere around the subject.
        up: the scene's vertical axis.
        angles: azimuth, elevation, tilt in radians, as in `framework.geometry.camera.look_from`.
        distance: distance from the subject's centre, metres; None for the smallest distance from which the whole sphere
            is visible.
        field_of_view: angle from top to bottom, radians.
        size: (height, width), pixels.
    """
    height, width = size
    focal = focal_length(height, field_of_view)
    if distance is None:
        distance = MARGIN * sphere.radius / math.sin(math.atan(0.5 * min(size) / focal))
    rotation = IMAGE @ viewpoint_rotation(torch.tensor(angles, dtype=torch.float64)) @ UPRIGHT[up]
    forward = torch.tensor([0.0, 0.0, distance], dtype=torch.float64)
    return Camera(
        rotation,
        forward - rotation @ sphere.centre,
        (focal, focal),
        ((width - 1) / 2, (height - 1) / 2),
        height,
        width,
        min(NEAR, NEAR * distance),
    )


def rotate_camera(camera: Camera, centre: Float[Tensor, "3"], up: Axis, angle: float) -> Camera:
    """Return the camera moved by `angle` radians around the axis `up` through `centre`, towards larger azimuth."""
    vertical = UPRIGHT[up]
    rotation_about_vertical = vertical.T @ about_z(torch.tensor(-angle, dtype=torch.float64)) @ vertical
    rotation = camera.rotation.double()
    translation = camera.translation.double() + rotation @ (centre - rotation_about_vertical @ centre)
    return replace(camera, rotation=rotation @ rotation_about_vertical, translation=translation)


def circle_cameras(camera: Camera, centre: Float[Tensor, "3"], up: Axis, count: int) -> Iterator[Camera]:
    """Yield `count` cameras at equal steps on a full circle; the first is `camera` itself.

    The axis of the circle has the direction `up` and passes through `centre`.
    """
    for number in range(count):
        yield rotate_camera(camera, centre, up, 2 * math.pi * number / count) if number else camera


def read_camera(file: Path) -> Camera:
    """Read a camera from the entries `K`, `R`, `t` and `size` of a file.

    A point X of the scene is seen at the pixel K (R X + t), divided by its third number (`framework.geometry.camera`).
    `size` is [width, height], pixels.

    Raises:
        DataError: the file is missing or damaged, or one of the four entries is missing or is not valid for a camera.
    """
    camera_values = _read_values(file)
    unknown = [key for key in camera_values if key not in KEYS]
    if unknown or len(camera_values) < len(KEYS):
        wrong = f"the entry {quote(unknown[0])} is unknown" if unknown else "an entry is missing"
        near = did_you_mean(str(unknown[0]), KEYS) if unknown else ""
        raise DataError(f"{file}: {wrong}. The entries of a camera are {', '.join(KEYS)}.{near}")
    matrix, rotation = (
        _parse_numbers(file, camera_values, "K", (3, 3)),
        _parse_numbers(file, camera_values, "R", (3, 3)),
    )
    translation = _parse_numbers(file, camera_values, "t", (3,))
    size = camera_values["size"]
    sides = isinstance(size, list) and len(size) == 2 and all(type(side) is int for side in size)
    if not sides or not all(1 <= side <= LONGEST_SIDE for side in size):
        raise DataError(
            f"{file}: the camera's size is {quote(size)}, expected [width, height] in whole pixels from 1 to "
            f"{LONGEST_SIDE}."
        )
    pinhole = torch.zeros(3, 3, dtype=torch.float64)
    pinhole[0, 0], pinhole[1, 1], pinhole[:2, 2], pinhole[2, 2] = (
        matrix[0, 0],
        matrix[1, 1],
        matrix[:2, 2],
        1.0,
    )
    if not torch.equal(matrix, pinhole) or matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise DataError(
            f"{file}: the camera matrix K is {matrix.tolist()}, expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in "
            "pixels with fx and fy above 0. Skew and distortion are not supported: undistort the image first."
        )
    error = float((rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max())
    determinant = float(torch.linalg.det(rotation))
    if error > ROTATION_ERROR or determinant < 0:
        raise DataError(
            f"{file}: the matrix R is not a rotation (R times its transpose differs from the identity by {error:.2g}, "
            f"the determinant of R is {determinant:.4g}). R must rotate from world to camera axes (x right, y down, z "
            "forward). Check that R is not transposed or scaled."
        )
    focal, principal = (float(matrix[0, 0]), float(matrix[1, 1])), (float(matrix[0, 2]), float(matrix[1, 2]))
    return Camera(rotation, translation, focal, principal, size[1], size[0])


def _read_values(file: Path) -> dict[str, Any]:
    description = "a camera"
    if file.suffix.lower() == ".json":
        with translate_errors(file, description):
            content = read_bytes(file)
            if len(content) > LARGEST_YAML:
                raise ValueError(
                    f"the file has {len(content)} bytes, but at most {LARGEST_YAML} bytes are read"
                )
            camera_values = json.loads(decode(content))
    elif file.suffix.lower() in (".yaml", ".yml"):
        camera_values = read_yaml(file, description)
    else:
        raise DataError(f"{file}: cannot be read as a camera. Give a file whose name ends in .json or .yaml.")
    if not isinstance(camera_values, dict):
        raise DataError(
            f"{file}: the file holds a {type(camera_values).__name__}, expected a mapping with a camera's "
            f"{', '.join(KEYS)}."
        )
    return camera_values


def _parse_numbers(
    file: Path, camera_values: dict[str, Any], key: str, shape: tuple[int, ...]
) -> Float[Tensor, "*shape"]:
    try:
        numbers = torch.tensor(plain_numbers(camera_values[key]), dtype=torch.float64)
        numbers = numbers.flatten() if numbers.shape == (3, 1) else numbers
    except (TypeError, ValueError, RuntimeError, OverflowError):
        numbers = torch.empty(0)
    if numbers.shape != shape or not bool(numbers.isfinite().all()):
        raise DataError(
            f"{file}: the camera's {key} is {quote(camera_values[key])}, expected {' x '.join(map(str, shape))} "
            "finite numbers."
        )
    return numbers
