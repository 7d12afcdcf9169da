"""The renderer in plain torch: a reference for tests of the compiled kernels, and the implementation on a GPU.

Every pixel in the bounding box of a face is tested, `PAIRS` pairs of face and pixel at a time. The nearest face at a
pixel is found by a minimum over 64-bit integers. The upper half of such an integer holds the bits of the depth, whose
order is that of the depths; the lower half holds the index of the face. Inside of faces, autograd gives the gradients
of colours and depths. Faces that the near plane cuts are left out.
"""

from collections.abc import Iterator

import torch
from torch import Tensor

from framework.renderer import Texture
from plugins.renderer.rasterizer.raster import FARTHEST, LARGEST, SUBPIXELS

PAIRS = 2**22
NOTHING = 2**63 - 1


def render(
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
    """Draw the channels of an image.

    Args:
        vertices: (vertices, 3), world coordinates, metres.
        faces: (faces, 3), indices of vertices.
        colors: (vertices, channels), linear RGB; None without vertex colours.
        texture: texture of the faces, or None.
        pose: rotation, translation and lens (fx, fy, cx, cy), float64.
        near: distance of the near plane, metres.
        size: height and width of the image, pixels.
        channels: names of the channels.
        cull: whether faces seen from behind are left out.
    """
    rotation, translation, lens = pose
    faces = faces.long()
    camera_points = vertices.double() @ rotation.double().T + translation.double()
    face = find_visible_faces(camera_points.detach(), faces, lens.detach(), near, size, cull)
    mask = face >= 0
    corners = faces[face.clamp(min=0)] if len(faces) else face.new_zeros(*size, 3)
    rendered: dict[str, Tensor] = {"mask": mask, "face": face.int()}
    if {"color", "depth", "barycentric", "uv"} & set(channels):
        shown_weights = compute_weights(camera_points, corners[mask], lens, mask.nonzero().flip(1))
        depth = (shown_weights * camera_points[:, 2][corners[mask]]).sum(-1).clamp(min=near)
        rendered["depth"] = camera_points.new_full(size, torch.inf).index_put((mask,), depth).float()
        weights = camera_points.new_zeros(*size, 3).index_put((mask,), shown_weights)
        rendered["barycentric"] = weights.detach().float()
        shown, uv = 1.0, camera_points.new_zeros(*size, 2)
        if colors is not None and len(faces):
            shown = (weights[..., None] * colors[corners].double()).sum(-2)
        if texture is not None and len(faces):
            tint, uv = sample_textures(texture, face, weights)
            shown = shown * tint
        if "color" in channels:
            count = (
                colors.shape[1]
                if colors is not None
                else texture.images[0].shape[2]
                if texture is not None
                else 0
            )
            rendered["color"] = (shown * mask[..., None] + camera_points.new_zeros(*size, count)).float()
        rendered["uv"] = (uv * mask[..., None]).detach().float()
    if "normal" in channels:
        rendered["normal"] = torch.zeros(*size, 3, device=camera_points.device)
        if len(faces):
            a, b, c = vertices.detach().double()[corners].unbind(-2)
            normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1, eps=1e-300)
            rendered["normal"] = (normal * mask[..., None]).float()
    return {name: rendered[name] for name in channels}


def find_visible_faces(
    camera_points: Tensor, faces: Tensor, lens: Tensor, near: float, size: tuple[int, int], cull: bool
) -> Tensor:
    """Return the index of the visible face at each pixel, (height, width); -1 for background.

    Corners are rounded to 1/256 pixel, and depths are compared in float32, as in the compiled kernels.

    Args:
        camera_points: (vertices, 3), vertices in camera coordinates.
        faces: (faces, 3), indices of vertices.
        lens: fx, fy, cx, cy, pixels.
        near: distance of the near plane, metres.
        size: height and width of the image, pixels.
        cull: whether faces seen from behind are left out.
    """
    height, width = size
    screen = ((lens[:2] * camera_points[:, :2] / camera_points[:, 2:] + lens[2:]) * SUBPIXELS).round()
    good = (
        (camera_points[:, 2] >= near) & (camera_points[:, 2] <= FARTHEST) & (screen.abs() <= LARGEST).all(1)
    )
    numbers = good[faces].all(1).nonzero()[:, 0]
    corner, inverse = screen[faces[numbers]], 1 / camera_points[:, 2][faces[numbers]]
    area = cross_product(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    not_culled = (area < 0) if cull else (area != 0)
    numbers, corner, inverse, area = (part[not_culled] for part in (numbers, corner, inverse, area))
    turned = area < 0  # counter-clockwise when seen from outside, because rows run downwards
    corner = torch.where(turned[:, None, None], corner[:, [0, 2, 1]], corner)
    inverse = torch.where(turned[:, None], inverse[:, [0, 2, 1]], inverse)
    last = torch.tensor([width - 1, height - 1], device=camera_points.device)
    low = (corner.amin(1) / SUBPIXELS).ceil().clamp(min=0).clamp(max=2.0**31).long()
    high = torch.minimum((corner.amax(1) / SUBPIXELS).floor().clamp(-1, 2.0**31).long(), last)
    sides = (high - low + 1).clamp(min=0)
    best = torch.full((height * width,), NOTHING, dtype=torch.int64, device=camera_points.device)
    for group in split_by_pixel_count(sides.prod(1)):
        part, column, row = box_pixels(low[group], sides[group])
        ends, near_parts = corner[group][part], inverse[group][part]
        edge = ends - torch.stack([column, row], -1)[:, None] * SUBPIXELS
        parts = torch.stack([cross_product(edge[:, (i + 1) % 3], edge[:, (i + 2) % 3]) for i in range(3)], -1)
        along = torch.stack([ends[:, (i + 1) % 3] - ends[:, (i + 2) % 3] for i in range(3)], 1)
        owned = (along[..., 1] > 0) | ((along[..., 1] == 0) & (along[..., 0] < 0))
        inside = ((parts > 0) | ((parts == 0) & owned)).all(-1) & (parts.sum(-1) > 0)
        parts, near_parts, part = parts[inside], near_parts[inside], part[inside]
        nearness = (parts * near_parts).sum(-1) / parts.sum(-1)
        nearness = torch.minimum(torch.maximum(nearness, near_parts.amin(-1)), near_parts.amax(-1))
        bits = (1 / nearness).float().view(torch.int32).long()
        pixel = row[inside] * width + column[inside]
        best.scatter_reduce_(0, pixel, bits << 32 | numbers[group][part], "amin")
    return torch.where(best < NOTHING, best & (2**32 - 1), -1).reshape(size)


def split_by_pixel_count(counts: Tensor) -> Iterator[Tensor]:
    """Yield indices of faces in groups whose pixel counts sum to at most `PAIRS`; a larger face forms its own group."""
    waiting = counts.nonzero()[:, 0]
    while len(waiting):
        whole = counts[waiting].cumsum(0)
        count = max(int((whole <= PAIRS).sum()), 1)
        yield waiting[:count]
        waiting = waiting[count:]


def box_pixels(low: Tensor, sides: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return three tensors with one entry for each pixel of each box: index of the box, column and row of the pixel.

    Args:
        low: smallest column and row of each box, (boxes, 2).
        sides: number of columns and of rows of each box, (boxes, 2).
    """
    counts = sides.prod(1)
    part = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    offset = torch.arange(len(part), device=counts.device) - (counts.cumsum(0) - counts)[part]
    return part, low[part, 0] + offset % sides[part, 0], low[part, 1] + offset // sides[part, 0]


def cross_product(first: Tensor, second: Tensor) -> Tensor:
    """Return the cross product of two-dimensional vectors."""
    return first[..., 0] * second[..., 1] - second[..., 0] * first[..., 1]


def compute_weights(camera_points: Tensor, corners: Tensor, lens: Tensor, pixels: Tensor) -> Tensor:
    """Return barycentric weights (pixels, 3) of faces at the pixels that show them.

    The weights are r·(B×C), r·(C×A), r·(A×B) over their sum (Olano & Greer 1997). r is the ray to the pixel, or, for a
    pixel beside the face, the ray to the nearest point of the face.

    Args:
        camera_points: (vertices, 3), vertices in camera coordinates.
        corners: (pixels, 3), vertex indices of the face at each pixel.
        lens: fx, fy, cx, cy, pixels.
        pixels: (pixels, 2), column and row.
    """
    a, b, c = camera_points[corners].unbind(-2)
    normals = torch.stack([torch.linalg.cross(*pair) for pair in ((b, c), (c, a), (a, b))], 1)
    parts = triple_products(normals, lens, pixels.to(camera_points))
    with torch.no_grad():
        nearest, weights = find_nearest_on_border(camera_points, corners, lens, pixels.to(camera_points))
        beside = ((parts <= 0).any(-1) & (parts >= 0).any(-1))[:, None]
        nearest = torch.where(beside, nearest, pixels)
    parts = triple_products(normals, lens, nearest)
    total = parts.sum(-1, keepdim=True)
    # A face seen edge-on has no gradient. Beside a face, the sum is compared with its absolute terms.
    terms = torch.where(beside, triple_products(normals, lens, nearest, absolute=True), parts.abs())
    has_area = total.abs() > 1e-12 * terms.sum(-1, keepdim=True)
    weights = torch.where(has_area, parts / torch.where(has_area, total, 1), weights).clamp(min=0)
    return weights / weights.sum(-1, keepdim=True)


def triple_products(normals: Tensor, lens: Tensor, pixels: Tensor, absolute: bool = False) -> Tensor:
    """Return the products r·n, (pixels, 3), of the ray r through each pixel and each of the pixel's three normals n.

    The pixels are given as `pixels`, (pixels, 2), column and row. Their normals are `normals`, (pixels, 3, 3).

    If `absolute` is true, return the sums of the absolute values of the terms of these products.
    """
    ray = (pixels - lens[2:]) / lens[:2]
    terms = torch.cat([ray, torch.ones_like(ray[:, :1])], -1)[:, None] * normals
    return (terms.abs() if absolute else terms).sum(-1)


def find_nearest_on_border(
    camera_points: Tensor, corners: Tensor, lens: Tensor, pixels: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the point on the border of a face that is nearest, on the screen, to each pixel.

    Args:
        camera_points: (vertices, 3), vertices in camera coordinates.
        corners: (pixels, 3), vertex indices of the face of each pixel.
        lens: fx, fy, cx, cy, pixels.
        pixels: (pixels, 2), column and row.

    Returns:
        Column and row of the nearest points, (pixels, 2), and their barycentric weights in space, (pixels, 3).
    """
    corner = camera_points[corners]
    start = lens[:2] * corner[..., :2] / corner[..., 2:] + lens[2:]
    along = start.roll(-1, 1) - start
    part = ((pixels[:, None] - start) * along).sum(-1) / along.square().sum(-1).clamp(min=1e-300)
    part = part.clamp(0, 1)
    nearest = start + part[..., None] * along
    edge = (nearest - pixels[:, None]).square().sum(-1).argmin(-1)[:, None]
    part = part.gather(1, edge)
    weights = torch.zeros_like(corner[..., 0]).scatter(1, edge, 1 - part).scatter(1, (edge + 1) % 3, part)
    weights = weights / corner[..., 2]
    return nearest.gather(1, edge[..., None].expand(-1, -1, 2))[:, 0], weights / weights.sum(-1, keepdim=True)


def sample_textures(texture: Texture, face: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return the texture's colour at each pixel, and the texture coordinates of each pixel.

    The colour is 1 for faces without a texture and for background; the texture coordinates are then 0.

    Args:
        texture: the texture.
        face: index of the face that each pixel shows; negative for background.
        weights: barycentric weights of this face at each pixel, (..., 3).
    """
    visible_face = face.clamp(min=0)
    uv = (weights[..., None] * texture.uv[texture.faces.long()[visible_face]].double()).sum(-2)
    shown = torch.zeros_like(face) if texture.shown is None else texture.shown.long()[visible_face]
    shown = shown.masked_fill(face < 0, -1)
    tint = uv.new_ones(*face.shape, texture.images[0].shape[2])
    for number, image in enumerate(texture.images):
        tint = torch.where((shown == number)[..., None], sample_image(image.double(), uv, texture), tint)
    return tint, uv * (shown >= 0)[..., None]


def sample_image(image: Tensor, uv: Tensor, texture: Texture) -> Tensor:
    """Return the colours of an image at texture coordinates, interpolated if the texture is smooth."""
    height, width, _ = image.shape
    x, y = uv[..., 0] * width - 0.5, (1 - uv[..., 1]) * height - 0.5
    if not texture.smooth:
        return image[
            wrap_index((y + 0.5).floor(), height, texture.wrap),
            wrap_index((x + 0.5).floor(), width, texture.wrap),
        ]
    left, top = x.detach().floor(), y.detach().floor()
    columns = [wrap_index(left + step, width, texture.wrap) for step in (0, 1)]
    rows = [wrap_index(top + step, height, texture.wrap) for step in (0, 1)]
    right, down = (x - left)[..., None], (y - top)[..., None]
    above, below = ((1 - right) * image[row, columns[0]] + right * image[row, columns[1]] for row in rows)
    return (1 - down) * above + down * below


def wrap_index(position: Tensor, count: int, wrap: str) -> Tensor:
    """Return the row or column from 0 to `count` - 1 that the wrap rule gives for any integer position."""
    position = position.detach().long()
    if wrap == "clamp":
        return position.clamp(0, count - 1)
    if wrap == "repeat":
        return position % count
    position = position % (2 * count)
    return torch.minimum(position, 2 * count - 1 - position)
