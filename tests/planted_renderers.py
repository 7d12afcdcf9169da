"""Renderers like those of other authors: correct ones, and ones with a planted fault that `mode=check` must find."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from framework.renderer import Renderer, Scene
from plugins.renderer.rasterizer.renderer import Rasterizer
from tests.planted_base import ChangedClass
from tests.stranger.stranger_package.renderer import Hits, RayCaster, rays


class Discs(Renderer):
    """Renders vertices as discs of one size, nearer discs in front of farther ones; faces are not drawn."""

    bibtex = ""
    channels = frozenset({"color", "depth"})
    radius = 1.2

    def __call__(self, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, Tensor]:
        unknown = sorted(set(channels) - self.channels)
        if unknown:
            raise ValueError(
                f"Discs cannot draw the channel {unknown[0]!r}, only color and depth. Leave the channel out."
            )
        if scene.faces.numel() and not 0 <= scene.faces.min() <= scene.faces.max() < len(scene.vertices):
            raise ValueError(
                "The faces hold indices of vertices that do not exist. Set indices from 0 to below the number "
                "of vertices."
            )
        if "color" in channels and (scene.colors is None or scene.texture is not None):
            raise ValueError(
                'The channel "color" requires vertex colours, but the scene has none, or has a texture. Add '
                "vertex colours."
            )
        seen = scene.camera
        pixels, depth = seen.project(scene.vertices.double())
        there = pixels.isfinite().all(-1) & depth.isfinite() & (depth >= seen.near)
        pixels, depth = pixels[there], depth[there]
        nearest = torch.full((seen.height, seen.width), torch.inf, dtype=torch.float64)
        shown = torch.full((seen.height, seen.width), -1)
        for index in self.order(depth).tolist():
            column, row = pixels[index].tolist()
            up, left = max(int(row - self.radius), 0), max(int(column - self.radius), 0)
            if not (up < seen.height and left < seen.width and row > -2 and column > -2):
                continue
            part = slice(up, int(row + self.radius) + 2), slice(left, int(column + self.radius) + 2)
            y, x = torch.meshgrid(
                torch.arange(seen.height)[part[0]], torch.arange(seen.width)[part[1]], indexing="ij"
            )
            covered = (x - column).square() + (y - row).square() <= self.radius**2
            nearest[part][covered] = depth[index]
            shown[part][covered] = index
        drawn = {"depth": nearest.float()}
        if "color" in channels:
            assert scene.colors is not None
            paint = torch.cat([scene.colors[there], torch.zeros_like(scene.colors[:1])])
            if not len(scene.colors):
                paint = torch.zeros(1, scene.colors.shape[1])
            drawn["color"] = paint[shown].float()
        return {channel: drawn[channel] for channel in channels}

    def order(self, depth: Tensor) -> Tensor:
        """Return the indices of the depths, the farthest first."""
        return depth.argsort(descending=True)


ALL = (
    "only the requested channels",
    "scenes that cannot be drawn are refused",
    "same scene, same bits",
    "empty view is background",
    "no faces, only background",
    "bad triangles are left out",
    "lower face wins",
    "no holes",
    "nearer hides farther",
    "sphere: depth, metres",
    "one pixel, one row",
    "drawn at the projected pixel",
    "faces cut by the near plane",
    "extreme scenes",
    "colours",
    "visible faces",
    "depth, relative",
    "several scenes",
    "points",
    "normal",
    "barycentric",
    "uv",
    "textures are drawn or refused",
    "gradient",
    "gradient in colours",
)
OF_POINTS: Mapping[str, str] = dict.fromkeys(
    ("no faces, only background", "bad triangles are left out"), "it draws vertices, of a set of points too"
)
RIGHT: dict[str, tuple[Callable[[], Renderer], Mapping[str, str]]] = {
    "discs": (Discs, OF_POINTS),
}
"""Correct renderers and the checks that their contract-test cases leave out, with the reasons.

The ray caster of the stranger package is checked elsewhere.
"""


class Wrapped(Renderer):
    """A shipped renderer whose scenes or images can be changed."""

    bibtex = ""
    channels = frozenset({"color", "depth", "face", "mask"})
    differentiable = frozenset({"colors"})

    def __init__(self) -> None:
        self.sound = Rasterizer()

    def __call__(self, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, Tensor]:
        return self.sound(scene, channels)


@dataclass(frozen=True)
class Fault(ChangedClass):
    """A renderer with one planted fault."""

    base: type[Renderer] = RayCaster

    def build(self) -> Renderer:
        return self.kind()


def colored(change: Callable[[Tensor], Tensor]) -> Mapping[str, Any]:
    """Return a method that changes the colours of the visible points."""

    def color(renderer: Any, scene: Scene, face: Tensor, weights: Tensor) -> Tensor:
        return change(RayCaster._color(renderer, scene, face, weights))

    return {"_color": color}


def seen_by(change: Callable[[Scene], Scene]) -> Mapping[str, Any]:
    """Return a method that renders a changed scene."""

    def draw(renderer: Any, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, Tensor]:
        return RayCaster.__call__(renderer, change(scene), channels)

    return {"__call__": draw}


def painted(change: Callable[[Scene, dict[str, Tensor]], dict[str, Tensor]]) -> Mapping[str, Any]:
    """Return a method that changes the rendered images."""

    def draw(renderer: Any, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, Tensor]:
        return change(scene, RayCaster.__call__(renderer, scene, channels))

    return {"__call__": draw}


def affine(renderer: Any, scene: Scene, face: Tensor, weights: Tensor) -> Tensor:
    """Return colours that are interpolated linearly on the screen, without perspective."""
    seen = scene.vertices.double() @ scene.camera.rotation.double().T + scene.camera.translation.double()
    flat = weights * seen[scene.faces.long()[face]][..., 2]
    return RayCaster._color(renderer, scene, face, flat / flat.sum(-1, keepdim=True))


def flat(renderer: Any, scene: Scene, face: Tensor, weights: Tensor) -> Tensor:
    first = torch.zeros_like(weights)
    first[:, 0] = 1
    return RayCaster._color(renderer, scene, face, first)


def next_corner(renderer: Any, scene: Scene, face: Tensor, weights: Tensor) -> Tensor:
    return RayCaster._color(renderer, scene, face, weights.roll(1, -1))


def of_kept_faces(scene: Scene, drawn: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return images whose face indices count only the faces in front of the camera."""
    if "face" not in drawn or not len(scene.faces):
        return drawn
    depth = scene.vertices @ scene.camera.rotation.T + scene.camera.translation
    kept = (depth[scene.faces.long()][..., 2] > 0).any(-1)
    number = torch.cat([kept.long().cumsum(0) - 1, torch.tensor([-1])])
    return {**drawn, "face": number[drawn["face"].long()].int()}


def by_their_middle(scene: Scene, drawn: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return face indices drawn in order of the faces' mean depths, which is wrong for intersecting faces."""
    if "face" not in drawn or len(scene.faces) > 60:
        return drawn
    seen = scene.vertices.double() @ scene.camera.rotation.double().T + scene.camera.translation.double()
    corners = seen[scene.faces.long()]
    found = torch.full(drawn["face"].shape, -1, dtype=torch.int32)
    for index in corners[..., 2].mean(-1).argsort(descending=True).tolist():
        one = Rasterizer()(replace(scene, faces=scene.faces[index : index + 1], colors=None), ("mask",))[
            "mask"
        ]
        found[one] = index
    return {**drawn, "face": found}


def nothing_beyond_128(scene: Scene, drawn: dict[str, Tensor]) -> dict[str, Tensor]:
    if "mask" in drawn:
        drawn["mask"][:, 128:] = False
    return drawn


def no_face_beyond_30(scene: Scene) -> Scene:
    return replace(scene, faces=scene.faces[:30]) if len(scene.faces) < 100 else scene


def square_pixels(scene: Scene) -> Scene:
    focal = scene.camera.focal
    return replace(scene, camera=replace(scene.camera, focal=(float(focal[0]), float(focal[0]))))


def in_the_middle(scene: Scene) -> Scene:
    seen = scene.camera
    return replace(scene, camera=replace(seen, principal=((seen.width - 1) / 2, (seen.height - 1) / 2)))


def half_a_pixel(scene: Scene) -> Scene:
    across, down = (float(part) for part in scene.camera.principal)
    return replace(scene, camera=replace(scene.camera, principal=(across + 0.5, down + 0.5)))


def backwards(renderer: Any, scenes: Sequence[Scene], channels: Collection[str] = ("color",)) -> Any:
    return [renderer(scene, channels) for scene in scenes[::-1]]


def of_one_size(renderer: Any, scenes: Sequence[Scene], channels: Collection[str] = ("color",)) -> Any:
    first = [replace(scene, camera=scenes[0].camera) for scene in scenes]
    return [renderer(scene, channels) for scene in first]


def in_place(scene: Scene) -> Scene:
    scene.vertices.mul_(1.0).add_(1e-6)
    return scene


def one_buffer(renderer: Any, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, Tensor]:
    drawn = RayCaster.__call__(renderer, scene, channels)
    kept = renderer.__dict__.setdefault("kept", {})
    for name, value in drawn.items():
        if name in kept and kept[name].shape == value.shape:
            kept[name].copy_(value)
        else:
            kept[name] = value
    return {name: kept[name] for name in drawn}


def red_green_blue(scene: Scene, drawn: dict[str, Tensor]) -> dict[str, Tensor]:
    if "color" in drawn:
        drawn["color"] = drawn["color"].expand(-1, -1, max(3, drawn["color"].shape[-1]))[..., :3]
    return drawn


def slope(factor: float, which: slice = slice(None)) -> Mapping[str, Any]:
    """Return a method that multiplies the gradients in the colours of some vertices by a factor."""

    def draw(renderer: Any, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, Tensor]:
        colors = scene.colors
        if colors is not None and colors.requires_grad:
            bent = colors.detach().clone() * (1 - factor) + colors * factor
            mixed = colors.clone()
            mixed[which] = bent[which]
            scene = replace(scene, colors=mixed)
        return renderer.sound(scene, channels)

    return {"__call__": draw}


def farthest_last(renderer: Any, depth: Tensor) -> Tensor:
    return depth.argsort()


def a_row_down(renderer: Any, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, Tensor]:
    return {name: value.roll(6, 0) for name, value in Discs.__call__(renderer, scene, channels).items()}


def linear_depth(renderer: Any, name: str, scene: Scene, hits: Hits) -> Tensor:
    """Return a channel; depth is interpolated linearly on the screen, without perspective."""
    if name != "depth":
        return RayCaster._channel(renderer, name, scene, hits)
    shown = hits.face >= 0
    seen = scene.vertices.double() @ scene.camera.rotation.double().T + scene.camera.translation.double()
    if not shown.any():
        return hits.depth.float()
    corners = seen[scene.faces.long()[hits.face[shown]]][..., 2]
    flat = hits.weights[shown] * corners
    found = hits.depth.clone()
    found[shown] = (flat / flat.sum(-1, keepdim=True) * corners).sum(-1)
    return found.float()


def along_the_ray(renderer: Any, name: str, scene: Scene, hits: Hits) -> Tensor:
    found = RayCaster._channel(renderer, name, scene, hits)
    return found * rays(scene.camera).norm(dim=-1).reshape(-1).float() if name == "depth" else found


COLORS, FACES, SEVERAL, SLOPES = "colours", "visible faces", "several scenes", "gradient in colours"
ALL_FAULTS = (
    Fault("colours linear on the screen", COLORS, changes={"_color": affine}),
    Fault("one colour a face", COLORS, changes={"_color": flat}),
    Fault("colours of the next corner", COLORS, changes={"_color": next_corner}),
    Fault("blue for red", COLORS, changes=colored(lambda color: color.flip(-1))),
    Fault("colours encoded", COLORS, changes=colored(lambda color: color.clamp(min=0) ** (1 / 2.2))),
    Fault("colours of bytes", COLORS, changes=colored(lambda color: (255 * color).round() / 255)),
    Fault("colours cut at 0.8", COLORS, changes=colored(lambda color: color.clamp(max=0.8))),
    Fault("half a pixel off", COLORS, changes=seen_by(half_a_pixel)),
    Fault("three channels always", COLORS, changes=painted(red_green_blue)),
    Fault("numbers of the faces that are left", FACES, changes=painted(of_kept_faces)),
    Fault("faces sorted by their middle", FACES, changes=painted(by_their_middle)),
    Fault("nothing beyond 128 columns", FACES, changes=painted(nothing_beyond_128)),
    Fault("no face beyond the 30th", FACES, changes=seen_by(no_face_beyond_30)),
    Fault("pixels are squares", FACES, changes=seen_by(square_pixels)),
    Fault("the principal point in the middle", FACES, changes=seen_by(in_the_middle)),
    Fault("depth linear on the screen", "depth, relative", changes={"_channel": linear_depth}),
    Fault("depth along the ray", "depth, relative", changes={"_channel": along_the_ray}),
    Fault("a batch backwards", SEVERAL, changes={"batch": backwards}),
    Fault("a batch of one size", SEVERAL, changes={"batch": of_one_size}),
    Fault("vertices changed in place", SEVERAL, changes=seen_by(in_place)),
    Fault("one buffer for all pictures", SEVERAL, changes={"__call__": one_buffer}),
    Fault("half of the colours' gradient", SLOPES, Wrapped, slope(0.5)),
    Fault("no gradient of a few colours", SLOPES, Wrapped, slope(0.0, slice(0, 4))),
    Fault("the farther point hides the nearer", "points", Discs, {"order": farthest_last}),
    Fault("points six rows down", "points", Discs, {"__call__": a_row_down}),
)
