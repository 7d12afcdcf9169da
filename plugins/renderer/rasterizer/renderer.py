"""A differentiable rasteriser on one CPU core; the contract is framework.renderer's."""

import weakref
from collections.abc import Collection
from functools import partial
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from torch.nn.functional import avg_pool2d

from framework.errors import did_you_mean
from framework.geometry.camera import Camera
from framework.renderer import Renderer, Scene
from plugins.renderer.rasterizer import raster
from plugins.renderer.rasterizer.drawing import Gradient, Picture, View
from plugins.renderer.rasterizer.gradient import neighbours

CHANNELS = ("color", "depth", "face", "mask")


class Rasterizer(Renderer):
    """Triangle meshes with colours per vertex, drawn without holes, differentiable in all that a scene is made of.

    Corners are rounded to 1/256 pixel and whole numbers decide which pixels a triangle covers: triangles that
    share an edge leave no pixel between them out and share none. What has no area after rounding is left out; what
    the near plane cuts is clipped. Depth and colour are perspective-correct. Tensors live on the CPU.

    "color" has a gradient in vertices, colours and the camera's rotation, translation, focal lengths and principal
    point; "depth" too, but for the edges of what is seen.

    Args:
        cull: leave out faces seen from behind; right for closed meshes only, and faster.
        gradient: "boundary": what the inside of faces does and what moving edges hand from one surface to another;
            "interior": the former alone; "nmr": the approximation of Kato et al., for comparison; "soft": the picture
            itself is that of Liu et al., blurred and blended, for comparison, in "color" alone.
        sigma: how far coverage blurs ("soft" alone): squared distance, where the image's shorter side is 2.
        gamma: how far depths blend ("soft" alone): of the nearest depth over a face's.
        supersampling: samples a pixel along each axis, of "color" alone, whose mean it then is.
    """

    channels = frozenset(CHANNELS)
    differentiable = frozenset(("vertices", "colors", "rotation", "translation", "focal", "principal"))
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
    ) -> None:
        self.cull = cull
        self.gradient: Gradient = gradient
        self.softness = (sigma, gamma)
        self.supersampling = supersampling
        self._known: tuple[weakref.ref[Tensor], int, np.ndarray] | None = None

    def __call__(self, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, Tensor]:
        check_channels(channels)
        vertices = numbers("vertices", scene.vertices)
        faces = indices(scene.faces)
        colors = None
        if "color" in channels:
            if scene.colors is None:
                raise ValueError(
                    '"color" was asked of a scene without colours; give colors, or ask other channels.'
                )
            colors = numbers("colors", scene.colors)
            if len(colors) != len(vertices):
                raise ValueError(f"{len(colors)} colors came for {len(vertices)} vertices; wanted one each.")
        largest = raster.largest_index(faces.reshape(-1).view(f"u{faces.itemsize}"))
        if faces.size and largest >= len(vertices):
            raise ValueError(
                f"faces name the vertices {faces.min()} to {faces.max()}; wanted 0 to {len(vertices) - 1}, "
                f"since the scene has {len(vertices)} vertices."
            )
        lens = check_camera(scene.camera)
        if not channels:
            return {}
        wanted = frozenset(channels)
        times = self.supersampling if "color" in wanted else 1
        once = wanted - {"color"} if times > 1 else wanted
        given = (scene, vertices, faces, colors, lens)
        drawn = self._drawn(*given, once, 1) if once else {}
        if times > 1:
            drawn |= self._drawn(*given, frozenset({"color"}), times)
        return {name: drawn[name] for name in channels}

    def _drawn(
        self,
        scene: Scene,
        vertices: Tensor,
        faces: np.ndarray,
        colors: Tensor | None,
        lens: Tensor,
        channels: frozenset[str],
        times: int,
    ) -> dict[str, Tensor]:
        """The channels, with so many samples a pixel along each axis."""
        camera = scene.camera
        size = (camera.height * times, camera.width * times)
        near = max(float(camera.near), raster.NEAREST)
        beside = partial(self._neighbours, scene.faces, faces)
        view = View(faces, beside, near, size, self.cull, channels, self.gradient, self.softness, times == 1)
        if times > 1:  # the middle of pixel 0 is that of its samples
            lens = torch.cat([lens[:2] * times, (lens[2:] + 0.5) * times - 0.5])
        shown = colors if "color" in channels else None
        found = Picture.apply(vertices, shown, camera.rotation, camera.translation, lens, view)
        drawn: dict[str, Tensor] = dict(zip(CHANNELS, found, strict=True))
        if times > 1:
            drawn["color"] = avg_pool2d(drawn["color"].movedim(-1, 0), times).movedim(0, -1)
        return {name: drawn[name] for name in channels}

    def _neighbours(self, tensor: Tensor, faces: np.ndarray) -> np.ndarray:
        """Of the faces that came as `tensor`; kept for the next picture of the same mesh, which may have moved."""
        if self._known is None or self._known[0]() is not tensor or self._known[1] != tensor._version:
            self._known = (weakref.ref(tensor), tensor._version, neighbours(faces))
        return self._known[2]


def check_channels(channels: Collection[str]) -> None:
    if isinstance(channels, str):
        raise ValueError(
            f"channels came as the string {channels!r}; wanted a collection, e.g. ({channels!r},)."
        )
    for name in channels:
        if name not in CHANNELS:
            raise ValueError(
                f"{name!r} is no channel of rasterizer.{did_you_mean(name, CHANNELS)} "
                f"It draws {', '.join(CHANNELS)}."
            )


def check_device(name: str, tensor: Tensor) -> None:
    if tensor.device.type != "cpu":
        raise ValueError(f"{name} came on {tensor.device}; rasterizer draws on the CPU: give {name}.cpu().")


def check_shape(name: str, tensor: Tensor) -> None:
    check_device(name, tensor)
    wrong = tensor.ndim != 2 or tensor.shape[1] < 1 or (name != "colors" and tensor.shape[1] != 3)
    if wrong:
        columns = "channels, 1 or more" if name == "colors" else "3"
        raise ValueError(f"{name} came with the shape {tuple(tensor.shape)}; wanted ({name}, {columns}).")


def indices(faces: Tensor) -> np.ndarray:
    """Faces as an array, without a copy where a kernel can take it as it is."""
    check_shape("faces", faces)
    if faces.dtype not in (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64):
        raise ValueError(f"faces came as {faces.dtype}; wanted whole numbers, e.g. torch.int64.")
    kept = faces.dtype in (torch.int32, torch.int64)
    return (faces if kept else faces.long()).contiguous().numpy()


def numbers(name: str, tensor: Tensor) -> Tensor:
    """Coordinates or colours in a type that kernels take."""
    check_shape(name, tensor)
    if not tensor.is_floating_point():
        raise ValueError(f"{name} came as {tensor.dtype}; wanted floating point, e.g. torch.float32.")
    return tensor if tensor.dtype in (torch.float32, torch.float64) else tensor.float()


def check_camera(camera: Camera) -> Tensor:
    """Its lens, (fx, fy, cx, cy), float64."""
    for name, side in (("height", camera.height), ("width", camera.width)):
        if not 1 <= side <= 2**16:
            raise ValueError(f"camera.{name} = {side}; wanted 1 to {2**16} pixels.")
    check_device("camera.rotation", camera.rotation)
    check_device("camera.translation", camera.translation)
    rotation, translation = camera.rotation.shape, camera.translation.shape
    if rotation != (3, 3) or translation != (3,):
        raise ValueError(
            f"camera.rotation and camera.translation came with the shapes {tuple(rotation)} and "
            f"{tuple(translation)}; wanted (3, 3) and (3,)."
        )
    lens = torch.cat(
        [torch.as_tensor(part, dtype=torch.float64) for part in (camera.focal, camera.principal)]
    )
    everything = torch.cat([camera.rotation.double().flatten(), camera.translation.double(), lens])
    if (
        not bool(everything.isfinite().all())
        or not 0 < camera.near < np.inf
        or not bool((lens[:2] > 0).all())
    ):
        raise ValueError(
            f"camera holds a number that is not finite, or a focal or near that is not above 0: {camera}."
        )
    return lens
