"""The renderer's images in plain torch: a reference for tests of the compiled kernels, and the renderer on a GPU.

Every pixel in the box around a face is tested (`PAIRS` at a time). The nearest face is kept by one minimum over packed
numbers: depth in the upper half, which sorts as its bits do, and the face's number in the lower half. Colours and
depths are differentiable within faces, by autograd. Faces that the near plane cuts are left out.
"""

from collections.abc import Iterator

import torch
from torch import Tensor

from framework.renderer import Texture
from plugins.renderer.rasterizer.raster import FARTHEST, LARGEST, SUBPIXELS

PAIRS = 2**22
NOTHING = 2**63 - 1


def picture(
    vertices: Tensor,
    faces: Tensor,
    colors: Tensor | None,
    texture: Texture | None,
    pose: tuple[Tensor, Tensor, Tensor],
    near: float,
    size: tuple[int, int],
    channels: tuple[str, ...],
    cull: bool,
) -> dict[str, Tensor]:
    """Return the channels of an image; `pose` is rotation, translation and lens (fx, fy, cx, cy), float64."""
    rotation, translation, lens = pose
    faces = faces.long()
    seen = vertices.double() @ rotation.double().T + translation.double()
    face = visible(seen.detach(), faces, lens.detach(), near, size, cull)
    mask = face >= 0
    corners = faces[face.clamp(min=0)] if len(faces) else face.new_zeros(*size, 3)
    found: dict[str, Tensor] = {"mask": mask, "face": face.int()}
    if {"color", "depth", "barycentric", "uv"} & set(channels):
        shown_weights = barycentric(seen, corners[mask], lens, mask.nonzero().flip(1))
        depth = (shown_weights * seen[:, 2][corners[mask]]).sum(-1).clamp(min=near)
        found["depth"] = seen.new_full(size, torch.inf).index_put((mask,), depth).float()
        weights = seen.new_zeros(*size, 3).index_put((mask,), shown_weights)
        found["barycentric"] = weights.detach().float()
        shown, uv = 1.0, seen.new_zeros(*size, 2)
        if colors is not None and len(faces):
            shown = (weights[..., None] * colors[corners].double()).sum(-2)
        if texture is not None and len(faces):
            tint, uv = textured(texture, face, weights)
            shown = shown * tint
        if "color" in channels:
            count = (
                colors.shape[1]
                if colors is not None
                else texture.images[0].shape[2]
                if texture is not None
                else 0
            )
            found["color"] = (shown * mask[..., None] + seen.new_zeros(*size, count)).float()
        found["uv"] = (uv * mask[..., None]).detach().float()
    if "normal" in channels:
        found["normal"] = torch.zeros(*size, 3, device=seen.device)
        if len(faces):
            a, b, c = vertices.detach().double()[corners].unbind(-2)
            normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1, eps=1e-300)
            found["normal"] = (normal * mask[..., None]).float()
    return {name: found[name] for name in channels}


def visible(
    seen: Tensor, faces: Tensor, lens: Tensor, near: float, size: tuple[int, int], cull: bool
) -> Tensor:
    """Return the face that each pixel shows, or -1: by corners rounded to 1/256 pixel, the nearest in float32."""
    height, width = size
    place = ((lens[:2] * seen[:, :2] / seen[:, 2:] + lens[2:]) * SUBPIXELS).round()
    good = (seen[:, 2] >= near) & (seen[:, 2] <= FARTHEST) & (place.abs() <= LARGEST).all(1)
    numbers = good[faces].all(1).nonzero()[:, 0]
    corner, inverse = place[faces[numbers]], 1 / seen[:, 2][faces[numbers]]
    area = cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    kept = (area < 0) if cull else (area != 0)
    numbers, corner, inverse, area = (part[kept] for part in (numbers, corner, inverse, area))
    turned = area < 0  # counter-clockwise from outside, rows running downwards
    corner = torch.where(turned[:, None, None], corner[:, [0, 2, 1]], corner)
    inverse = torch.where(turned[:, None], inverse[:, [0, 2, 1]], inverse)
    last = torch.tensor([width - 1, height - 1], device=seen.device)
    low = (corner.amin(1) / SUBPIXELS).ceil().clamp(min=0).clamp(max=2.0**31).long()
    high = torch.minimum((corner.amax(1) / SUBPIXELS).floor().clamp(-1, 2.0**31).long(), last)
    sides = (high - low + 1).clamp(min=0)
    best = torch.full((height * width,), NOTHING, dtype=torch.int64, device=seen.device)
    for some in portions(sides.prod(1)):
        part, column, row = pixels(low[some], sides[some])
        ends, near_parts = corner[some][part], inverse[some][part]
        edge = ends - torch.stack([column, row], -1)[:, None] * SUBPIXELS
        parts = torch.stack([cross(edge[:, (i + 1) % 3], edge[:, (i + 2) % 3]) for i in range(3)], -1)
        along = torch.stack([ends[:, (i + 1) % 3] - ends[:, (i + 2) % 3] for i in range(3)], 1)
        owned = (along[..., 1] > 0) | ((along[..., 1] == 0) & (along[..., 0] < 0))
        inside = ((parts > 0) | ((parts == 0) & owned)).all(-1) & (parts.sum(-1) > 0)
        parts, near_parts, part = parts[inside], near_parts[inside], part[inside]
        nearness = (parts * near_parts).sum(-1) / parts.sum(-1)
        nearness = torch.minimum(torch.maximum(nearness, near_parts.amin(-1)), near_parts.amax(-1))
        bits = (1 / nearness).float().view(torch.int32).long()
        pixel = row[inside] * width + column[inside]
        best.scatter_reduce_(0, pixel, bits << 32 | numbers[some][part], "amin")
    return torch.where(best < NOTHING, best & (2**32 - 1), -1).reshape(size)


def portions(counts: Tensor) -> Iterator[Tensor]:
    """Yield the faces in groups of at most `PAIRS` pixels, or of a single face."""
    waiting = counts.nonzero()[:, 0]
    while len(waiting):
        whole = counts[waiting].cumsum(0)
        count = max(int((whole <= PAIRS).sum()), 1)
        yield waiting[:count]
        waiting = waiting[count:]


def pixels(low: Tensor, sides: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the box's number, the column and the row of each pixel of each box."""
    counts = sides.prod(1)
    part = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    offset = torch.arange(len(part), device=counts.device) - (counts.cumsum(0) - counts)[part]
    return part, low[part, 0] + offset % sides[part, 0], low[part, 1] + offset // sides[part, 0]


def cross(one: Tensor, other: Tensor) -> Tensor:
    """Return the cross product of vectors of two numbers."""
    return one[..., 0] * other[..., 1] - other[..., 0] * one[..., 1]


def barycentric(seen: Tensor, corners: Tensor, lens: Tensor, pixels: Tensor) -> Tensor:
    """Return weights (number, 3) of the corners (number, 3) at the pixels (number, 2), column and row, that show them.

    The weights are r·(B×C), r·(C×A), r·(A×B) over their sum (Olano & Greer 1997). r is the ray to the pixel, or for a
    pixel beside the face, the ray to the nearest place of the face.
    """
    a, b, c = seen[corners].unbind(-2)
    normals = torch.stack([torch.linalg.cross(*pair) for pair in ((b, c), (c, a), (a, b))], 1)
    parts = volumes(normals, lens, pixels.to(seen))
    with torch.no_grad():
        place, weights = nearest(seen, corners, lens, pixels.to(seen))
        beside = ((parts <= 0).any(-1) & (parts >= 0).any(-1))[:, None]
        place = torch.where(beside, place, pixels)
    parts = volumes(normals, lens, place)
    total = parts.sum(-1, keepdim=True)
    # A face seen edge-on has no gradient. At a border all parts have the same sign, so their terms are compared.
    terms = torch.where(beside, volumes(normals, lens, place, absolute=True), parts.abs())
    seen_at_all = total.abs() > 1e-12 * terms.sum(-1, keepdim=True)
    found = torch.where(seen_at_all, parts / torch.where(seen_at_all, total, 1), weights).clamp(min=0)
    return found / found.sum(-1, keepdim=True)


def volumes(normals: Tensor, lens: Tensor, places: Tensor, absolute: bool = False) -> Tensor:
    """Return r·n (number, 3) of rays r through places (number, 2), pixels, and normals n (number, 3, 3).

    If `absolute` is true, return the sums of the terms' absolute values.
    """
    ray = (places - lens[2:]) / lens[:2]
    terms = torch.cat([ray, torch.ones_like(ray[:, :1])], -1)[:, None] * normals
    return (terms.abs() if absolute else terms).sum(-1)


def nearest(seen: Tensor, corners: Tensor, lens: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Return where the borders of faces are nearest to pixels (number, 2), and the weights (number, 3) there."""
    corner = seen[corners]
    start = lens[:2] * corner[..., :2] / corner[..., 2:] + lens[2:]
    along = start.roll(-1, 1) - start
    part = ((pixels[:, None] - start) * along).sum(-1) / along.square().sum(-1).clamp(min=1e-300)
    part = part.clamp(0, 1)
    place = start + part[..., None] * along
    edge = (place - pixels[:, None]).square().sum(-1).argmin(-1)[:, None]
    part = part.gather(1, edge)
    weights = torch.zeros_like(corner[..., 0]).scatter(1, edge, 1 - part).scatter(1, (edge + 1) % 3, part)
    weights = weights / corner[..., 2]
    return place.gather(1, edge[..., None].expand(-1, -1, 2))[:, 0], weights / weights.sum(-1, keepdim=True)


def textured(texture: Texture, face: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return the colours of faces from their images, 1 where they have none, and the places in the images."""
    there = face.clamp(min=0)
    uv = (weights[..., None] * texture.uv[texture.faces.long()[there]].double()).sum(-2)
    shown = torch.zeros_like(face) if texture.shown is None else texture.shown.long()[there]
    shown = shown.masked_fill(face < 0, -1)
    tint = uv.new_ones(*face.shape, texture.images[0].shape[2])
    for number, image in enumerate(texture.images):
        tint = torch.where((shown == number)[..., None], sampled(image.double(), uv, texture), tint)
    return tint, uv * (shown >= 0)[..., None]


def sampled(image: Tensor, uv: Tensor, texture: Texture) -> Tensor:
    """Return the colours of an image at places uv, interpolated if the texture is smooth."""
    height, width, _ = image.shape
    x, y = uv[..., 0] * width - 0.5, (1 - uv[..., 1]) * height - 0.5
    if not texture.smooth:
        return image[
            wrapped((y + 0.5).floor(), height, texture.wrap), wrapped((x + 0.5).floor(), width, texture.wrap)
        ]
    left, top = x.detach().floor(), y.detach().floor()
    columns = [wrapped(left + step, width, texture.wrap) for step in (0, 1)]
    rows = [wrapped(top + step, height, texture.wrap) for step in (0, 1)]
    right, down = (x - left)[..., None], (y - top)[..., None]
    above, below = ((1 - right) * image[row, columns[0]] + right * image[row, columns[1]] for row in rows)
    return (1 - down) * above + down * below


def wrapped(place: Tensor, count: int, wrap: str) -> Tensor:
    """Return the row or column of an image of `count` that stands at an integer place, by the wrap rule."""
    place = place.detach().long()
    if wrap == "clamp":
        return place.clamp(0, count - 1)
    if wrap == "repeat":
        return place % count
    place = place % (2 * count)
    return torch.minimum(place, 2 * count - 1 - place)
