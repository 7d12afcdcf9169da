"""Ray casting without shortcuts."""

from collections.abc import Collection
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.geometry.camera import Camera
from framework.renderer import Renderer, Scene

RAYS = 256
"""Number of rays that are tested against all triangles at a time; more would need more memory."""


class Example(Renderer):
    """Renderer that tests a ray through the centre of each pixel against every triangle, in float64.

    It draws the visible face, its distance and the mask, and no colours. It is slow, but simple enough to be a
    reference.
    """

    bibtex = ""
    channels = frozenset(("depth", "face", "mask"))

    @torch.no_grad()
    def __call__(self, scene: Scene, channels: Collection[str] = ("mask",)) -> dict[str, Tensor]:
        """Draw the requested channels.

        Raises:
            ValueError: a channel is unknown, or a face refers to a vertex that does not exist.
        """
        _require(scene, channels, self.channels)
        if not channels:
            return {}
        camera = scene.camera
        vertices = scene.vertices.double() @ camera.rotation.double().T + camera.translation.double()
        corners = vertices[scene.faces.long()]
        rays = pixel_rays(camera)
        parts = [cast(corners, part, camera.near) for part in rays.split(RAYS)]
        face = torch.cat([part.face for part in parts]).reshape(camera.height, camera.width)
        depth = torch.cat([part.depth for part in parts]).reshape(camera.height, camera.width)
        images = {"face": face.int(), "mask": face >= 0, "depth": depth.float()}
        return {name: images[name] for name in channels}


class Hits(NamedTuple):
    """First face that each ray hits.

    Attributes:
        face: index of the face, -1 for none.
        depth: distance along the optical axis, metres; inf for no face.
    """

    face: Int[Tensor, "rays"]
    depth: Float[Tensor, "rays"]


def pixel_rays(camera: Camera) -> Float[Tensor, "rays 3"]:
    """Return rays through the centres of all pixels, row by row, with length 1 along the optical axis."""
    focal, principal = (torch.as_tensor(part).double() for part in (camera.focal, camera.principal))
    row, column = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    across = (torch.stack([column, row], -1) - principal) / focal
    return torch.cat([across, torch.ones_like(across[..., :1])], -1).reshape(-1, 3)


def cast(corners: Float[Tensor, "faces 3 3"], rays: Float[Tensor, "rays 3"], near: float) -> Hits:
    """Return the first hits of rays from the origin on triangles.

    The signs of the triple products r·(B×C), r·(C×A), r·(A×B) say on which side of each edge a ray passes; a ray on an
    edge hits both faces beside it (Möller and Trumbore 1997, by Cramer's rule).

    Args:
        corners: corners of the faces in the coordinates of the camera.
        rays: directions with length 1 along the optical axis.
        near: distance of the near plane, metres.
    """
    a, b, c = corners.unbind(1)
    sides = torch.stack([rays @ cross(*edge).T for edge in ((b, c), (c, a), (a, b))])
    inside = (sides >= 0).all(0) | (sides <= 0).all(0)
    depth = (a * cross(b, c)).sum(-1) / sides.sum(0)
    # a face seen from its edge has a distance that is NaN or infinite
    seen = inside & (depth >= near) & (depth < torch.inf)
    # equal distances in float32, the type of the image, show the face with the lowest index
    depth = torch.where(seen, depth, torch.inf).float().double()
    if not len(corners):
        return Hits(torch.full((len(rays),), -1), torch.full((len(rays),), torch.inf, dtype=torch.float64))
    nearest = depth.amin(1)
    index = torch.arange(len(corners)).expand_as(depth)
    face = torch.where(depth == nearest[:, None], index, len(corners)).amin(1)
    return Hits(torch.where(nearest < torch.inf, face, -1), nearest)


def cross(first: Float[Tensor, "faces 3"], second: Float[Tensor, "faces 3"]) -> Float[Tensor, "faces 3"]:
    """Return cross products of rows; exchanged arguments give exactly the negative result.

    The two faces beside an edge therefore get the same number for this edge, and no ray passes between them.
    """
    a, b, c = first.unbind(-1)
    x, y, z = second.unbind(-1)
    return torch.stack([b * z - c * y, c * x - a * z, a * y - b * x], -1)


def _require(scene: Scene, channels: Collection[str], known: Collection[str]) -> None:
    unknown = sorted(set(channels) - set(known))
    if unknown:
        raise ValueError(
            f"Got the channel {unknown[0]!r}, but the renderer example draws "
            f"{', '.join(sorted(known))}. Request one of these."
        )
    count = len(scene.vertices)
    if scene.faces.numel() and not (scene.faces.min() >= 0 and scene.faces.max() < count):
        raise ValueError(
            f"Faces have the vertices {scene.faces.min()} to {scene.faces.max()}, but vertices 0 to {count - 1} exist. "
            "Give faces of these vertices."
        )
