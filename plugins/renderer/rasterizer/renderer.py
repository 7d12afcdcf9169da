"""A differentiable rasteriser on one CPU core; it implements the contract of framework.renderer."""

from collections.abc import Collection, Sequence
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor
from torch.nn.functional import avg_pool2d

from framework.renderer import Renderer, Report, Scene
from framework.storage.threads import POOL
from plugins.renderer.rasterizer import reference
from plugins.renderer.rasterizer.canvas import Canvas, Shelf
from plugins.renderer.rasterizer.checks import CHANNELS, PAINTED, Ready, check_on_device, ready
from plugins.renderer.rasterizer.drawing import Gradient, Picture, Saving, View, draw
from plugins.renderer.rasterizer.raster import NEAREST

ALL: tuple[Saving, ...] = ("view", "box", "unchanged")


class Rasterizer(Renderer):
    """A rasteriser of coloured and textured meshes, without gaps between faces, differentiable in all scene inputs.

    Corners are rounded to 1/256 pixel, and integers decide which pixels a triangle covers: triangles that share an edge
    leave out no pixel between them and share none. Faces without area after rounding are left out; faces that the near
    plane cuts are clipped. Depth and colour are perspective-correct, between corners that are not rounded. Tensors live
    on the CPU; a scene on a GPU is drawn there in plain torch, without faces that the near plane cuts and with gradient
    "interior" alone.

    "color" has a gradient in vertices, colours, textures' images and uv, and the camera's rotation, translation, focal
    lengths and principal point. "depth" has one too, except for the edges of visible surfaces.

    Args:
        cull: leave out faces seen from behind; right for closed meshes only, and faster.
        gradient: "boundary": gradients inside of faces and from moving edges, where one surface replaces another;
            "interior": gradients inside of faces alone; "nmr": the approximation of Kato et al., for comparison;
            "soft": the image itself is that of Liu et al., blurred and blended, for comparison, in "color" of vertex
            colours alone.
        sigma: how far coverage blurs ("soft" alone): squared distance, where the image's shorter side is 2.
        gamma: how far depths blend ("soft" alone), as a ratio of the nearest depth to a face's depth.
        supersampling: samples per pixel along each axis, for "color" alone, which is then their mean.
        savings: work that may be left out; the image is the same to the last bit. "view": scenes wholly out of view;
            "box": pixels around the drawn faces; "hidden": faces behind those drawn before, nearest first, which is
            faster where much is hidden; "unchanged": everything that is as it was in the last image.
    """

    channels = frozenset(CHANNELS)
    bibtex = """@article{pineda1988parallel,
  author = {Pineda, Juan},
  title = {A parallel algorithm for polygon rasterization},
  journal = {ACM SIGGRAPH Computer Graphics},
  volume = {22},
  number = {4},
  pages = {17--20},
  year = {1988}
}
@article{li2018differentiable,
  author = {Li, Tzu-Mao and Aittala, Miika and Durand, Fr{\\'e}do and Lehtinen, Jaakko},
  title = {Differentiable {Monte} {Carlo} ray tracing through edge sampling},
  journal = {ACM Transactions on Graphics},
  volume = {37},
  number = {6},
  year = {2018}
}
@inproceedings{kato2018neural,
  author = {Kato, Hiroharu and Ushiku, Yoshitaka and Harada, Tatsuya},
  title = {Neural {3D} mesh renderer},
  booktitle = {Conference on Computer Vision and Pattern Recognition},
  year = {2018}
}
@inproceedings{liu2019soft,
  author = {Liu, Shichen and Li, Tianye and Chen, Weikai and Li, Hao},
  title = {Soft rasterizer: A differentiable renderer for image-based {3D} reasoning},
  booktitle = {International Conference on Computer Vision},
  year = {2019}
}"""

    def __init__(
        self,
        *,
        cull: bool = False,
        gradient: Gradient = "boundary",
        sigma: Annotated[float, Field(ge=1e-8, le=1)] = 1e-5,
        gamma: Annotated[float, Field(ge=1e-6, le=1)] = 1e-4,
        supersampling: Annotated[int, Field(ge=1, le=16)] = 1,
        savings: tuple[Saving, ...] = ALL,
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
        self._shelf, self._pool = Shelf(), list[Canvas]()

    def __call__(self, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, Tensor]:
        drawn, self.report = self._picture(scene, channels)
        return drawn

    def batch(
        self, scenes: Sequence[Scene], channels: Collection[str] = ("color",)
    ) -> list[dict[str, Tensor]]:
        """Draw several scenes in parallel on as many threads as torch uses; `report` is then of the last scene."""
        learning = torch.is_grad_enabled()
        found: list[tuple[dict[str, Tensor], Report | None]] = [({}, None)] * len(scenes)

        def draw(number: int) -> None:
            with torch.set_grad_enabled(learning):  # each thread has its own setting
                found[number] = self._picture(scenes[number], channels)

        POOL.share(draw, len(scenes), torch.get_num_threads())
        if found:
            self.report = found[-1][1]
        return [drawn for drawn, _ in found]

    def _picture(self, scene: Scene, channels: Collection[str]) -> tuple[dict[str, Tensor], Report | None]:
        if scene.vertices.device.type == "cuda":
            return self.on_device(scene, channels), None
        checked = ready(scene, channels, self._shelf, self.gradient)
        found: dict[str, Tensor] = {}
        report = None
        for names, times in samples(channels, self.supersampling):
            drawn, report = self._drawn(scene, checked, names, times)
            found |= drawn
        return {name: found[name] for name in channels}, report

    def on_device(self, scene: Scene, channels: Collection[str]) -> dict[str, Tensor]:
        """Return the channels as drawn by `reference`, on the device of the scene's tensors."""
        lens, camera = check_on_device(scene, channels, self.gradient), scene.camera
        if self.gradient == "soft":
            raise ValueError(
                "gradient=soft draws on the CPU; give tensors there, or choose another gradient."
            )
        found: dict[str, Tensor] = {}
        for names, times in samples(channels, self.supersampling):
            shift = torch.tensor([0.0, 0.0, 0.5, 0.5], dtype=torch.float64, device=lens.device)
            pose = (camera.rotation, camera.translation, (lens + shift) * times - shift)
            size = (camera.height * times, camera.width * times)
            near = max(float(camera.near), NEAREST)
            colors = scene.colors if "color" in names else None  # colours were checked only if they are read
            texture = None if set(PAINTED).isdisjoint(names) else scene.texture
            surface = (scene.vertices, scene.faces, colors, texture)
            drawn = reference.picture(*surface, pose, near, size, names, self.cull)
            found |= pooled(drawn, times)
        return {name: found[name] for name in channels}

    def _drawn(
        self, scene: Scene, checked: Ready, channels: tuple[str, ...], times: int
    ) -> tuple[dict[str, Tensor], Report]:
        """Return the channels, with `times` samples per pixel along each axis."""
        camera = scene.camera
        view = View(
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
        given, lens = checked.given(times, "color" in channels)
        if checked.learning and not {"color", "depth"}.isdisjoint(channels):
            made: list[Report] = []
            colors = checked.colors if "color" in channels else None
            uv, images = checked.uv_and_images if "color" in channels else (None, ())
            learned = (checked.vertices, colors, camera.rotation, camera.translation, lens, uv)
            tensors = Picture.apply(*learned, given, view, self._pool, made, *images)
            found, report = dict(zip(channels, tensors, strict=True)), made[0]
        else:
            drawn = draw(given, view, self._pool, learning=False)
            found, report = drawn.channels, drawn.report
        return pooled(found, times), report


def samples(channels: Collection[str], supersampling: int) -> list[tuple[tuple[str, ...], int]]:
    """Return the groups of channels that are drawn together, each with its samples per pixel along each axis.

    Colours come last.
    """
    names = tuple(dict.fromkeys(channels))
    rest = tuple(name for name in names if name != "color")
    if supersampling == 1 or rest == names:
        return [(names, 1)] if names else []
    return [*([(rest, 1)] if rest else []), (("color",), supersampling)]


def pooled(drawn: dict[str, Tensor], times: int) -> dict[str, Tensor]:
    """Return the mean of `times` × `times` samples for each pixel."""
    if times == 1:
        return drawn
    return {name: avg_pool2d(picture.movedim(-1, 0), times).movedim(0, -1) for name, picture in drawn.items()}
