"""Cameras that look at a subject, given by angles or by a file, and cameras on a circle around it."""

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
from framework.storage.plain_values import LARGEST_YAML, plain_numbers, read_yaml
from framework.storage.reading import read_bytes, translate_errors
from framework.storage.text import decode
from plugins.renderer.rasterizer.parts import Axis

MARGIN = 1.03
"""Factor on the nearest distance from which the sphere around the subject is seen whole."""
NEAR = 1e-3
"""Distance of the near plane, metres, or as a share of the distance to the subject if that is less."""
LONGEST_SIDE = 2**14
ROTATION_ERROR = 1e-4
"""Largest difference between R Rᵀ and the identity, since files round."""
UPRIGHT = {
    "y": torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=torch.float64),
    "z": torch.eye(3, dtype=torch.float64),
}
"""Rotations that turn a scene's axes so that z points upwards and its front, z or -y, looks towards -y."""
IMAGE = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64).diag()
"""Rotation from a viewer's axes (x right, y up, z backwards) to a camera's axes."""
KEYS = ("K", "R", "t", "size")


@dataclass(frozen=True)
class Ball:
    """A sphere around a subject: the centre of its box, and the distance to the farthest corner of a face."""

    centre: Float[Tensor, "3"]
    radius: float


def ball(scene: Scene) -> Ball:
    """Return the sphere around a scene's faces."""
    corners = scene.vertices[scene.faces.flatten().unique()].double()
    centre = corners.amin(0) / 2 + corners.amax(0) / 2
    radius = float((corners - centre).norm(dim=1).max())
    if not math.isfinite(radius):
        raise DataError(
            "it is larger than any number can say; wanted coordinates below 1e150. Scale it down."
        )
    return Ball(centre, radius or 1.0)


def looking_at(
    around: Ball,
    up: Axis,
    angles: tuple[float, float, float],
    distance: float | None,
    field_of_view: float,
    size: tuple[int, int],
) -> Camera:
    """Return a camera that sees the subject's centre in the middle of the image.

    Args:
        around: sphere around the subject.
        up: the scene's vertical axis.
        angles: azimuth, elevation, tilt in radians, as in `framework.geometry.camera.look_from`.
        distance: distance from the subject's centre; None: the nearest from which a sphere around it is seen whole.
        field_of_view: angle from top to bottom, radians.
        size: (height, width), pixels.
    """
    height, width = size
    focal = focal_length(height, field_of_view)
    if distance is None:
        distance = MARGIN * around.radius / math.sin(math.atan(0.5 * min(size) / focal))
    rotation = IMAGE @ viewpoint_rotation(torch.tensor(angles, dtype=torch.float64)) @ UPRIGHT[up]
    forward = torch.tensor([0.0, 0.0, distance], dtype=torch.float64)
    return Camera(
        rotation,
        forward - rotation @ around.centre,
        (focal, focal),
        ((width - 1) / 2, (height - 1) / 2),
        height,
        width,
        min(NEAR, NEAR * distance),
    )


def turned(camera: Camera, centre: Float[Tensor, "3"], up: Axis, angle: float) -> Camera:
    """Return the camera turned around the vertical axis through `centre` by `angle` radians; its azimuth grows."""
    vertical = UPRIGHT[up]
    turn = vertical.T @ about_z(torch.tensor(-angle, dtype=torch.float64)) @ vertical
    rotation = camera.rotation.double()
    translation = camera.translation.double() + rotation @ (centre - turn @ centre)
    return replace(camera, rotation=rotation @ turn, translation=translation)


def around(camera: Camera, centre: Float[Tensor, "3"], up: Axis, count: int) -> Iterator[Camera]:
    """Yield cameras of a whole turn in `count` equal steps; the first is the camera itself."""
    for number in range(count):
        yield turned(camera, centre, up, 2 * math.pi * number / count) if number else camera


def read_camera(file: Path) -> Camera:
    """Read a camera from `K`, `R`, `t`, `size` ([width, height]), as `framework.geometry.camera` defines them.

    Raises:
        DataError: the file is missing or damaged, or one of the four is missing or describes no camera.
    """
    found = _values(file)
    unknown = [key for key in found if key not in KEYS]
    if unknown or len(found) < len(KEYS):
        wrong = f"{quote(unknown[0])} is no part of it" if unknown else "a part is missing"
        near = did_you_mean(str(unknown[0]), KEYS) if unknown else ""
        raise DataError(f"{file}: {wrong}; wanted a camera's {', '.join(KEYS)}.{near}")
    lens, rotation = _numbers(file, found, "K", (3, 3)), _numbers(file, found, "R", (3, 3))
    translation = _numbers(file, found, "t", (3,))
    size = found["size"]
    sides = isinstance(size, list) and len(size) == 2 and all(type(side) is int for side in size)
    if not sides or not all(1 <= side <= LONGEST_SIDE for side in size):
        raise DataError(
            f"{file}: its size is {quote(size)}; wanted [width, height], whole pixels from 1 to {LONGEST_SIDE}."
        )
    wanted = torch.zeros(3, 3, dtype=torch.float64)
    wanted[0, 0], wanted[1, 1], wanted[:2, 2], wanted[2, 2] = lens[0, 0], lens[1, 1], lens[:2, 2], 1.0
    if not torch.equal(lens, wanted) or lens[0, 0] <= 0 or lens[1, 1] <= 0:
        raise DataError(
            f"{file}: its K is {lens.tolist()}; wanted [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], pixels, fx and fy above "
            "0. Skew and distortion are not drawn: undistort first."
        )
    error = float((rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max())
    determinant = float(torch.linalg.det(rotation))
    if error > ROTATION_ERROR or determinant < 0:
        raise DataError(
            f"{file}: its R is no rotation (R times its transpose is {error:.2g} off the identity, its determinant is "
            f"{determinant:.4g}); wanted world to camera, x right, y down, z forward. Is it transposed, or scaled?"
        )
    focal, principal = (float(lens[0, 0]), float(lens[1, 1])), (float(lens[0, 2]), float(lens[1, 2]))
    return Camera(rotation, translation, focal, principal, size[1], size[0])


def _values(file: Path) -> dict[str, Any]:
    wanted = "a camera"
    if file.suffix.lower() == ".json":
        with translate_errors(file, wanted):
            content = read_bytes(file)
            if len(content) > LARGEST_YAML:
                raise ValueError(f"{len(content)} bytes; at most {LARGEST_YAML}")
            found = json.loads(decode(content))
    elif file.suffix.lower() in (".yaml", ".yml"):
        found = read_yaml(file, wanted)
    else:
        raise DataError(
            f"{file}: cannot be read as a camera; wanted a file whose name ends in .json or .yaml."
        )
    if not isinstance(found, dict):
        raise DataError(f"{file}: it holds {type(found).__name__}; wanted a camera's {', '.join(KEYS)}.")
    return found


def _numbers(file: Path, found: dict[str, Any], key: str, shape: tuple[int, ...]) -> Float[Tensor, "*shape"]:
    try:
        numbers = torch.tensor(plain_numbers(found[key]), dtype=torch.float64)
        numbers = numbers.flatten() if numbers.shape == (3, 1) else numbers
    except (TypeError, ValueError, RuntimeError, OverflowError):
        numbers = torch.empty(0)
    if numbers.shape != shape or not bool(numbers.isfinite().all()):
        raise DataError(
            f"{file}: its {key} is {quote(found[key])}; wanted {' x '.join(map(str, shape))} finite numbers."
        )
    return numbers
