"""A z-buffer on one CPU core; the contract is framework.renderer's."""

from collections.abc import Collection

import numpy as np
import torch
from torch import Tensor

from framework.errors import did_you_mean
from framework.geometry.camera import Camera
from framework.renderer import Renderer, Scene
from plugins.renderer.zbuffer import raster

CHANNELS = ("color", "depth", "face", "mask")


class ZBuffer(Renderer):
    """Triangle meshes with a colour per vertex, drawn on one CPU core without holes.

    Corners are rounded to 1/256 pixel and whole numbers decide which pixels a triangle covers: triangles that
    share an edge leave no pixel between them out and share none. What has no area after rounding is left out.
    Depth and colour are perspective-correct. Tensors live on the CPU; no gradients flow.
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
}"""

    def __init__(self, *, cull: bool = False) -> None:
        self.cull = cull

    def __call__(self, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, Tensor]:
        check_channels(channels)
        vertices = array("vertices", scene.vertices)
        faces = array("faces", scene.faces)
        colors = None
        if "color" in channels:
            if scene.colors is None:
                raise ValueError(
                    '"color" was asked of a scene without colours; give colors, or ask other channels.'
                )
            colors = array("colors", scene.colors)
            if len(colors) != len(vertices):
                raise ValueError(f"{len(colors)} colors came for {len(vertices)} vertices; wanted one each.")
        largest = raster.largest_index(faces.reshape(-1).view(f"u{faces.itemsize}"))
        if faces.size and largest >= len(vertices):
            raise ValueError(
                f"faces name the vertices {faces.min()} to {faces.max()}; wanted 0 to {len(vertices) - 1}, "
                f"since the scene has {len(vertices)} vertices."
            )
        view = check_camera(scene.camera)
        if not channels:
            return {}

        size = (scene.camera.height, scene.camera.width)
        want_depth = not {"color", "depth", "face"}.isdisjoint(channels)
        want_face = not {"color", "face"}.isdisjoint(channels)
        depth = np.empty(size if want_depth else (0, 0), np.float32)
        face = np.empty(size if want_face else (0, 0), np.int32)
        # Fresh zeros cost nothing until they are touched, which pixels that no face covers are not.
        mask = np.zeros(size if "mask" in channels else (0, 0), np.bool_)
        color = np.zeros((*size, 3) if colors is not None else (0, 0, 3), np.float32)
        if raster.out_of_view(vertices, *view, *size):
            faces = faces[:0]
        screen = np.empty((len(vertices) if len(faces) else 0, 3))
        if len(faces):
            raster.project(vertices, *view, screen)
        box = raster.rasterise(screen, faces, self.cull, *size, depth, face, mask)
        if colors is not None:
            raster.shade(screen, faces, colors, face, box, color)
        drawn = {"color": color, "depth": depth, "face": face, "mask": mask}
        return {name: torch.from_numpy(drawn[name]) for name in channels}


def check_channels(channels: Collection[str]) -> None:
    if isinstance(channels, str):
        raise ValueError(
            f"channels came as the string {channels!r}; wanted a collection, e.g. ({channels!r},)."
        )
    for name in channels:
        if name not in CHANNELS:
            raise ValueError(
                f"{name!r} is no channel of zbuffer.{did_you_mean(name, CHANNELS)} "
                f"It draws {', '.join(CHANNELS)}."
            )


def check_device(name: str, tensor: Tensor) -> None:
    if tensor.device.type != "cpu":
        raise ValueError(f"{name} came on {tensor.device}; zbuffer draws on the CPU: give {name}.cpu().")


def array(name: str, tensor: Tensor) -> np.ndarray:
    """A (n, 3) tensor as an array, without a copy where a kernel can take it as it is."""
    check_device(name, tensor)
    if tensor.ndim != 2 or tensor.shape[1] != 3:
        raise ValueError(f"{name} came with the shape {tuple(tensor.shape)}; wanted ({name}, 3).")
    if name == "faces":
        if tensor.dtype not in (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64):
            raise ValueError(f"faces came as {tensor.dtype}; wanted whole numbers, e.g. torch.int64.")
        kept, other = (torch.int32, torch.int64), torch.int64
    else:
        if not tensor.is_floating_point():
            raise ValueError(f"{name} came as {tensor.dtype}; wanted floating point, e.g. torch.float32.")
        kept, other = (torch.float32, torch.float64), torch.float32
    return tensor.detach().to(tensor.dtype if tensor.dtype in kept else other).contiguous().numpy()


def check_camera(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
    """Rotation, translation, focal, principal and near of a camera in float64."""
    for name, side in (("height", camera.height), ("width", camera.width)):
        if not 1 <= side <= 2**16:
            raise ValueError(f"camera.{name} = {side}; wanted 1 to {2**16} pixels.")
    check_device("camera.rotation", camera.rotation)
    check_device("camera.translation", camera.translation)
    rotation = camera.rotation.detach().double().contiguous().numpy()
    translation = camera.translation.detach().double().contiguous().numpy()
    if rotation.shape != (3, 3) or translation.shape != (3,):
        raise ValueError(
            f"camera.rotation and camera.translation came with the shapes {rotation.shape} and "
            f"{translation.shape}; wanted (3, 3) and (3,)."
        )
    focal, principal = np.array(camera.focal, dtype=np.float64), np.array(camera.principal, dtype=np.float64)
    everything = np.concatenate([rotation.ravel(), translation, focal, principal, [camera.near]])
    if not np.isfinite(everything).all() or not camera.near > 0 or not (focal > 0).all():
        raise ValueError(
            f"camera holds a number that is not finite, or a focal or near that is not above 0: {camera}."
        )
    return rotation, translation, focal, principal, max(float(camera.near), raster.NEAREST)
