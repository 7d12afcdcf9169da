"""Differentiable rasteriser on one CPU core, or in plain torch on a GPU."""

from collections.abc import Collection, Sequence
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor
from torch.nn.functional import avg_pool2d

from framework.renderer import Renderer, Report, Scene
from framework.storage.threads import POOL
from plugins.renderer.rasterizer import reference
from plugins.renderer.rasterizer.canvas import Canvas, MeshCache
from plugins.renderer.rasterizer.checks import CHANNELS, TEXTURED, CheckedScene, check_on_device, check_scene
from plugins.renderer.rasterizer.drawing import DrawImage, DrawingSettings, Gradient, Saving, draw
from plugins.renderer.rasterizer.raster import NEAREST

DEFAULT_SAVINGS: tuple[Saving, ...] = ("view", "box", "unchanged")


class Rasterizer(Renderer):
    """A rasteriser of coloured and textured meshes, without gaps between faces, differentiable in all scene inputs.

    Corners are rounded to 1/256 pixel, and integers decide which pixels a triangle covers: triangles that share an edge
    leave no pixel between them uncovered and cover no pixel twice. Faces without area after rounding are left out;
    faces that the near plane cuts are clipped. Depth and colour are perspective-correct and are interpolated between
    corners that are not rounded.

    A scene on the CPU is drawn by compiled kernels. A scene on a GPU is drawn there in plain torch (`on_device`): faces
    that the near plane cuts are left out, and only the gradient "interior" is available.

    "color" has a gradient with respect to vertices, colours, texture images, uv and the camera's rotation, translation,
    focal lengths and principal point. "depth" has a gradient too, but without the effect of moving edges.

    Args:
        cull: whether faces seen from behind are left out; faster, but correct for closed meshes only.
        gradient: "boundary": gradients inside of faces, and from moving edges at which one surface replaces another;
            "interior": gradients inside of faces only; "nmr": the approximation of Kato et al., for comparison; "soft":
            the blurred and blended image of Liu et al., for comparison, which changes "color" and shows vertex colours
            only.
        sigma: blur of coverage ("soft" only), as a squared distance in units in which the image's shorter side is 2.
        gamma: blur of depth ("soft" only), in units of the ratio of the nearest depth to a face's depth.
        supersampling: samples per pixel along each axis; "color" is their mean, other channels take one sample.
        savings: work that may be skipped; the image stays the same to the last bit. "view": scenes completely out of
            view; "box": pixels outside of the box around the drawn faces; "hidden": faces behind faces that were drawn
            before, which sorts faces by depth and is faster if many faces are hidden; "unchanged": results that have
            not changed since the last image.
    """

    channels = frozenset(CHANNELS)
    bibtex = "pineda1988parallel, li2018differentiable, kato2018neural, liu2019soft"

    def __init__(
        self,
        *,
        cull: bool = False,
        gradient: Gradient = "boundary",
        sigma: Annotated[float, Field(ge=1e-8, le=1)] = 1e-5,
        gamma: Annotated[float, Field(ge=1e-6, le=1)] = 1e-4,
        supersampling: Annotated[int, Field(ge=1, le=16)] = 1,
        savings: tuple[Saving, ...] = DEFAULT_SAVINGS,
    ) -> None:
        self.cull = cull
        self.gradient: Gradient = gradient
        self.softness = (sigma, gamma)
        self.supersampling = supersampling
        self.savings: frozenset[Saving] = frozenset(savings)
        self.differentiable = frozenset(
            ("vertices", "colors", "rotation", "translation", "focal", "principal")
        )
        if gradient != "soft":
            self.differentiable |= {"texture", "uv"}
        self.report: Report | None = None
        self._mesh_cache, self._pool = MeshCache(), list[Canvas]()

    def __call__(self, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, Tensor]:
        rendered, self.report = self._render(scene, channels)
        return rendered

    def batch(
        self, scenes: Sequence[Scene], channels: Collection[str] = ("color",)
    ) -> list[dict[str, Tensor]]:
        """Draw several scenes in parallel on as many threads as torch uses.

        The attribute `report` then describes the last scene.
        """
        learning = torch.is_grad_enabled()
        results: list[tuple[dict[str, Tensor], Report | None]] = [({}, None)] * len(scenes)

        def draw(number: int) -> None:
            with torch.set_grad_enabled(learning):  # each thread has its own setting
                results[number] = self._render(scenes[number], channels)

        POOL.share(draw, len(scenes), torch.get_num_threads())
        if results:
            self.report = results[-1][1]
        return [channels for channels, _ in results]

    def _render(self, scene: Scene, channels: Collection[str]) -> tuple[dict[str, Tensor], Report | None]:
        if scene.vertices.device.type == "cuda":
            return self.on_device(scene, channels), None
        checked = check_scene(scene, channels, self._mesh_cache, self.gradient)
        rendered: dict[str, Tensor] = {}
        report = None
        for names, times in group_by_samples(channels, self.supersampling):
            group, report = self._render_samples(scene, checked, names, times)
            rendered |= group
        return {name: rendered[name] for name in channels}, report

    def on_device(self, scene: Scene, channels: Collection[str]) -> dict[str, Tensor]:
        """Draw the channels in plain torch (`reference`) on the device of the scene's tensors."""
        lens, camera = check_on_device(scene, channels, self.gradient), scene.camera
        if self.gradient == "soft":
            raise ValueError(
                "gradient=soft draws only on the CPU. Move the scene to the CPU, or choose another gradient."
            )
        rendered: dict[str, Tensor] = {}
        for names, times in group_by_samples(channels, self.supersampling):
            shift = torch.tensor([0.0, 0.0, 0.5, 0.5], dtype=torch.float64, device=lens.device)
            pose = (camera.rotation, camera.translation, (lens + shift) * times - shift)
            size = (camera.height * times, camera.width * times)
            near = max(float(camera.near), NEAREST)
            colors = scene.colors if "color" in names else None  # colours are checked only if they are drawn
            texture = None if set(TEXTURED).isdisjoint(names) else scene.texture
            surface = (scene.vertices, scene.faces, colors, texture)
            group = reference.render(*surface, pose, near, size, names, self.cull)
            rendered |= average_samples(group, times)
        return {name: rendered[name] for name in channels}

    def _render_samples(
        self, scene: Scene, checked: CheckedScene, channels: tuple[str, ...], times: int
    ) -> tuple[dict[str, Tensor], Report]:
        """Draw channels of a checked scene with `times` samples per pixel along each axis."""
        camera = scene.camera
        settings = DrawingSettings(
            checked.faces,
            checked.near,
            (camera.height * times, camera.width * times),
            self.cull,
            channels,
            self.gradient,
            self.softness,
            self.savings,
            times == 1,
        )
        arrays, lens = checked.to_arrays(times, "color" in channels)
        if checked.needs_gradient and not {"color", "depth"}.isdisjoint(channels):
            reports: list[Report] = []
            colors = checked.colors if "color" in channels else None
            uv, images = checked.uv_and_images if "color" in channels else (None, ())
            learned = (checked.vertices, colors, camera.rotation, camera.translation, lens, uv)
            tensors = DrawImage.apply(*learned, arrays, settings, self._pool, reports, *images)
            rendered, report = dict(zip(channels, tensors, strict=True)), reports[0]
        else:
            image = draw(arrays, settings, self._pool, learning=False)
            rendered, report = image.channels, image.report
        return average_samples(rendered, times), report


def group_by_samples(channels: Collection[str], supersampling: int) -> list[tuple[tuple[str, ...], int]]:
    """Return groups of channels that are drawn together, each with its number of samples per pixel along each axis.

    If there are several samples per pixel, "color" forms a group of its own, which is the last one; the other channels
    take one sample.
    """
    names = tuple(dict.fromkeys(channels))
    rest = tuple(name for name in names if name != "color")
    if supersampling == 1 or rest == names:
        return [(names, 1)] if names else []
    return [*([(rest, 1)] if rest else []), (("color",), supersampling)]


def average_samples(channels: dict[str, Tensor], times: int) -> dict[str, Tensor]:
    """Return the mean of `times` × `times` samples for each pixel of every channel."""
    if times == 1:
        return channels
    return {name: avg_pool2d(image.movedim(-1, 0), times).movedim(0, -1) for name, image in channels.items()}
