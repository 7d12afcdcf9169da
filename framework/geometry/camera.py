"""Pinhole cameras; pixel centres lie at integer coordinates, x right, y down, z forward."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from framework.geometry.rotation import viewpoint_rotation


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion: OpenCV's, whose matrix K is ((fx, 0, cx), (0, fy, cy), (0, 0, 1)).

    A world point X is seen at pixel (fx x/z + cx, fy y/z + cy), where (x, y, z) = rotation @ X + translation.

    Attributes:
        rotation: world to camera, determinant +1.
        translation: metres.
        focal: (fx, fy), pixels, > 0; a tensor where it is to be differentiated in.
        principal: (cx, cy), pixels; the centre of an image is ((width - 1) / 2, (height - 1) / 2). Likewise.
        height, width: image size, pixels.
        near: nothing nearer than this is seen, metres, > 0.
    """

    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]
    focal: tuple[float, float] | Float[Tensor, "2"]
    principal: tuple[float, float] | Float[Tensor, "2"]
    height: int
    width: int
    near: float = 1e-3

    def projected(
        self, points: Float[Tensor, "*points 3"]
    ) -> tuple[Float[Tensor, "*points 2"], Float[Tensor, "*points"]]:
        """Pixels (column, row) at which world points are seen, and their depths along the optical axis, metres. Of a
        depth that is not above 0 the pixel means nothing."""
        seen, focal, principal = self._seen(points)
        return focal * seen[..., :2] / seen[..., 2:] + principal, seen[..., 2]

    def canonical(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        """World points in the axes of `canonical_camera(height, width)`, which sees each at the same pixel and depth.

        x right, y down, z forward, metres: x' = (fx x + (cx - (width - 1) / 2) z) / height, y' likewise, z' = z.
        """
        seen, focal, principal = self._seen(points)
        middle = principal.new_tensor([(self.width - 1) / 2, (self.height - 1) / 2])
        moved = (focal * seen[..., :2] + (principal - middle) * seen[..., 2:]) / self.height
        return torch.cat([moved, seen[..., 2:]], -1)

    def _seen(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Points in the camera's axes, the focal lengths and the principal point, all as the points are."""
        seen = points @ self.rotation.to(points).T + self.translation.to(points)
        focal, principal = (
            torch.as_tensor(part, dtype=points.dtype, device=points.device)
            for part in (self.focal, self.principal)
        )
        return seen, focal, principal


def canonical_camera(height: int, width: int) -> Camera:
    """At the origin, looking along z: focal length = height pixels, principal point in the middle of the image."""
    return Camera(
        torch.eye(3),
        torch.zeros(3),
        (float(height), float(height)),
        ((width - 1) / 2, (height - 1) / 2),
        height,
        width,
    )


def look_from(
    azimuth: float,
    elevation: float,
    tilt: float,
    distance: float,
    field_of_view: float,
    size: tuple[int, int],
) -> Camera:
    """A camera at `distance` (metres) from the origin that looks at it, z up, angles in radians.

    Azimuth turns about the vertical (0 looks at the object's front, from -y), elevation lifts the camera, tilt
    rolls it in the plane: the convention of PASCAL3D+ annotations. `field_of_view` is vertical; `size` is
    (height, width).
    """
    height, width = size
    rotation = viewpoint_rotation(torch.tensor([azimuth, elevation, tilt], dtype=torch.float64))
    # PASCAL3D+ camera frames have y up and look along -z; images have y down and look along +z.
    flip = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64).diag()
    focal = 0.5 * height / math.tan(0.5 * field_of_view)
    return Camera(
        rotation=(flip @ rotation).float(),
        translation=torch.tensor([0.0, 0.0, distance]),
        focal=(focal, focal),
        principal=((width - 1) / 2, (height - 1) / 2),
        height=height,
        width=width,
    )
