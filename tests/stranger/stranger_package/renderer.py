"""A renderer that the framework does not ship: rays through pixel centres against every triangle, float64."""

from collections.abc import Collection
from typing import NamedTuple

import torch
from torch import Tensor

from framework.geometry.camera import Camera
from framework.renderer import Renderer, Scene, Texture

TILE = 8  # pixels
NUMBERS = {"normal": 3, "barycentric": 3, "uv": 2}


class Hits(NamedTuple):
    """First face that each ray hits.

    Attributes:
        face: (rays) int64, -1: nothing.
        depth: (rays) float64, metres; inf: nothing.
        weights: (rays, 3) float64, barycentric, of the corners of `face`.
    """

    face: Tensor
    depth: Tensor
    weights: Tensor


def rays(camera: Camera) -> Tensor:
    """Return the rays through the pixel centres, (rows, columns, 3) float64, with length 1 along the optical axis."""
    focal, principal = (torch.as_tensor(part).double() for part in (camera.focal, camera.principal))
    row, column = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    ahead = (torch.stack([column, row], -1) - principal) / focal
    return torch.cat([ahead, torch.ones_like(ahead[..., :1])], -1)


def cross(one: Tensor, other: Tensor) -> Tensor:
    """Return the cross products of rows; exchanged arguments give exactly the negative result."""
    a, b, c = one.unbind(-1)
    x, y, z = other.unbind(-1)
    return torch.stack([b * z - c * y, c * x - a * z, a * y - b * x], -1)


def sides(corners: Tensor, ray: Tensor) -> list[Tensor]:
    """Three of (faces, rays), each opposite a corner: on which side of the plane through eye and edge a ray runs.

    The sign of r·(B×C) and so on; over their sum these are barycentric weights (Möller & Trumbore 1997, by Cramer's
    rule).
    """
    found = []
    for corner in range(3):
        x, y, z = cross(corners[:, (corner + 1) % 3], corners[:, (corner + 2) % 3])[..., None].unbind(1)
        found.append(x * ray[:, 0] + y * ray[:, 1] + z * ray[:, 2])
    return found


def possible(corners: Tensor, ray: Tensor) -> Tensor:
    """Return which faces the rays within a rectangle may hit, tested with the rays at its four corners.

    Rounded products and sums are monotonic. So a side that has the same sign at all four corners has this sign at every
    ray of the rectangle.
    """
    low, high = ray.amin(0), ray.amax(0)
    ends = torch.stack([low[0], high[0], low[0], high[0]]), torch.stack([low[1], low[1], high[1], high[1]])
    found = sides(corners, torch.stack([*ends, torch.ones(4, dtype=ray.dtype)], -1))
    above = [torch.stack([side[:, end] for end in range(4)]).amax(0) >= 0 for side in found]
    below = [torch.stack([side[:, end] for end in range(4)]).amin(0) <= 0 for side in found]
    return (above[0] & above[1] & above[2]) | (below[0] & below[1] & below[2])


def first(corners: Tensor, ray: Tensor, near: float) -> Tensor:
    """The index of the first face that each of (rays, 3) hits at `near` metres or beyond, -1: none.

    A ray on an edge hits both faces beside it, so that nothing passes between them. Of depths that are the same as
    float32, which a picture has, the lowest index is the first.
    """
    chosen = possible(corners, ray).nonzero()[:, 0]
    one, other, third = sides(corners[chosen], ray)
    least = torch.minimum(torch.minimum(one, other), third)
    most = torch.maximum(torch.maximum(one, other), third)
    where, which = ((least >= 0) | (most <= 0)).nonzero(as_tuple=True)
    total = one[where, which] + other[where, which] + third[where, which]
    a, b, c = corners[chosen[where]].unbind(1)
    depth = (a * cross(b, c)).sum(-1) / total  # NaN or infinite where a face is seen edge-on
    seen = (depth >= near) & (depth < torch.inf)
    where, which, depth = chosen[where[seen]], which[seen], depth[seen].float()
    nearest = torch.full((len(ray),), torch.inf).scatter_reduce(0, which, depth, "amin")
    tied = depth == nearest[which]
    none = len(corners)
    index = torch.full((len(ray),), none).scatter_reduce(0, which[tied], where[tied], "amin")
    return torch.where(index == none, -1, index)


def cast(corners: Tensor, ray: Tensor, near: float) -> Hits:
    """Return the first hits of rays, (rows, columns, 3), on faces, (faces, 3, 3), in camera coordinates.

    The rays are cast tile by tile to save memory.
    """
    face = torch.full(ray.shape[:2], -1)
    good = (corners.isfinite().all(-1).all(-1) & (corners[..., 2] >= near).any(-1)).nonzero()[:, 0]
    for top in range(0, len(face), TILE):
        band = good[possible(corners[good], ray[top : top + TILE].reshape(-1, 3))]
        names = torch.cat([band, band.new_tensor([-1])])
        for left in range(0, face.shape[1], TILE):
            tile = slice(top, top + TILE), slice(left, left + TILE)
            found = first(corners[band], ray[tile].reshape(-1, 3), near)
            face[tile] = names[found].reshape(face[tile].shape)
    face, ray = face.reshape(-1), ray.reshape(-1, 3)
    shown = corners[face.clamp(min=0)] if len(corners) else corners.new_zeros(len(ray), 3, 3)
    a, b, c = shown.unbind(1)
    parts = torch.stack([(ray * cross(*pair)).sum(-1) for pair in ((b, c), (c, a), (a, b))], -1)
    total = parts.sum(-1)
    depth = torch.where(face >= 0, (a * cross(b, c)).sum(-1) / total, torch.inf)
    return Hits(face, depth, torch.where(face[:, None] >= 0, parts / total[:, None], 0))


def normals(corners: Tensor) -> Tensor:
    """Return the unit normals of faces, (rays, 3), from their corners in world coordinates."""
    across = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return across / across.norm(dim=-1, keepdim=True)


def texel(place: Tensor, count: int, wrap: str) -> Tensor:
    """Return the index of the texel at a whole number, in a row of `count` texels."""
    if wrap == "clamp":
        return place.clamp(0, count - 1)
    place = place.remainder(count if wrap == "repeat" else 2 * count)
    return torch.where(place < count, place, 2 * count - 1 - place)


def papered(texture: Texture, image: Tensor, uv: Tensor) -> Tensor:
    """Return the colours of an image at positions (places, 2), as (places, channels)."""
    height, width, _ = image.shape
    column, row = uv[:, 0] * width, (1 - uv[:, 1]) * height
    if not texture.smooth:
        left, top = column.floor().long(), row.floor().long()
        return image[texel(top, height, texture.wrap), texel(left, width, texture.wrap)]
    left, top = (column - 0.5).floor(), (row - 0.5).floor()
    right, down = (column - 0.5 - left)[:, None], (row - 0.5 - top)[:, None]
    shown = torch.zeros(len(uv), image.shape[2], dtype=torch.float64)
    for below, share in ((0, 1 - down), (1, down)):
        for beside, part in ((0, 1 - right), (1, right)):
            at = (
                texel(top.long() + below, height, texture.wrap),
                texel(left.long() + beside, width, texture.wrap),
            )
            shown = shown + share * part * image[at]
    return shown


class RayCaster(Renderer):
    """A ray through every pixel's centre, tried on every triangle: no rounding of corners, no buffer, no gradient.

    A triangle that the near plane cuts shows what of it lies beyond.
    """

    channels = frozenset(("color", "depth", "face", "mask", "normal", "barycentric", "uv"))
    bibtex = """@article{moller1997fast,
  author = {M{\\"o}ller, Tomas and Trumbore, Ben},
  title = {Fast, minimum storage ray-triangle intersection},
  journal = {Journal of Graphics Tools},
  volume = {2},
  number = {1},
  year = {1997}
}"""

    @torch.no_grad()
    def __call__(self, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, Tensor]:
        self._check(scene, channels)
        if not channels:
            return {}
        camera = scene.camera
        vertices = scene.vertices.double()
        seen = vertices @ camera.rotation.double().T + camera.translation.double()
        faces = scene.faces.long()
        hits = cast(seen[faces], rays(camera), camera.near)
        size = (camera.height, camera.width)
        return {
            name: self._channel(name, scene, hits).reshape(*size, *self._numbers(name, scene))
            for name in channels
        }

    def _check(self, scene: Scene, channels: Collection[str]) -> None:
        unknown = sorted(set(channels) - self.channels)
        if unknown:
            raise ValueError(
                f"{unknown[0]!r} is not a channel of ray_caster; it draws {', '.join(sorted(self.channels))}."
            )
        count = len(scene.vertices)
        if scene.faces.numel() and not (scene.faces.min() >= 0 and scene.faces.max() < count):
            raise ValueError(
                f"faces name the vertices {scene.faces.min()} to {scene.faces.max()}; wanted 0 to {count - 1}."
            )
        if "color" in channels and scene.colors is None and scene.texture is None:
            raise ValueError('"color" was asked of a scene without colours; give colors or a texture.')

    @staticmethod
    def _numbers(name: str, scene: Scene) -> tuple[int, ...]:
        if name == "color":
            painted = scene.colors if scene.colors is not None else scene.texture.images[0]  # type: ignore[union-attr]
            return (painted.shape[-1],)
        return (NUMBERS[name],) if name in NUMBERS else ()

    def _channel(self, name: str, scene: Scene, hits: Hits) -> Tensor:
        if name == "face":
            return hits.face.int()
        if name == "mask":
            return hits.face >= 0
        if name == "depth":
            return hits.depth.float()
        shown = hits.face >= 0
        face, weights = hits.face[shown], hits.weights[shown]
        channel = torch.zeros(len(shown), *self._numbers(name, scene), dtype=torch.float64)
        if name == "normal":
            channel[shown] = normals(scene.vertices.double()[scene.faces.long()[face]])
        elif name == "barycentric":
            channel[shown] = weights
        elif name == "uv" and scene.texture is not None:
            channel[shown] = self._uv(scene.texture, face, weights)
        elif name == "color":
            channel[shown] = self._color(scene, face, weights)
        return channel.float()

    @staticmethod
    def _uv(texture: Texture, face: Tensor, weights: Tensor) -> Tensor:
        if not len(face):
            return weights[:, :2]
        uv = (weights[..., None] * texture.uv.double()[texture.faces.long()[face]]).sum(1)
        bare = torch.zeros_like(face) if texture.shown is None else texture.shown[face]
        return torch.where(bare[:, None] < 0, 0, uv)

    def _color(self, scene: Scene, face: Tensor, weights: Tensor) -> Tensor:
        color = torch.ones(len(face), *self._numbers("color", scene), dtype=torch.float64)
        if scene.colors is not None and len(face):
            color = (weights[..., None] * scene.colors.double()[scene.faces.long()[face]]).sum(1)
        texture = scene.texture
        if texture is None or not len(face):
            return color
        uv = self._uv(texture, face, weights)
        images = torch.zeros_like(face) if texture.shown is None else texture.shown[face]
        for number, image in enumerate(texture.images):
            here = images == number
            color[here] = color[here] * papered(texture, image.double(), uv[here])
        return color
