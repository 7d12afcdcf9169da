"""Functions that turn a scene into 8-bit images and films: shading, background, other channels, and output files."""

import math
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from framework.errors import ConfigError, DataError, shorten
from framework.geometry.camera import Camera
from framework.geometry.srgb import bytes_from_linear, linear_from_bytes
from framework.renderer import Scene
from framework.storage.files import replacing
from plugins.renderer.rasterizer.parts import Subject

AMBIENT = 0.12
"""Brightness of a surface seen edge-on, as a share of the brightness of a surface that faces the camera."""
CREASE = math.cos(math.radians(40))
"""Cosine of the largest angle between faces whose common edge is smoothed."""
MOST_AROUND = 32
"""Largest number of faces around a vertex whose directions are averaged."""


@dataclass(frozen=True)
class Stage:
    """A scene that is drawn in colour, with coverage as its last channel.

    Attributes:
        normals: normals of the vertices that a light at the camera shades, and 0 for the other vertices; None if no
            vertex is shaded.
    """

    scene: Scene
    normals: Float[Tensor, "vertices 3"] | None

    def seen(self, camera: Camera) -> Scene:
        """Return the scene as seen by a camera and lit from there, by Lambert's law for both sides of a surface."""
        scene = replace(self.scene, camera=camera)
        if self.normals is None or scene.colors is None:
            return scene
        place = -(camera.rotation.double().T @ camera.translation.double())
        towards = place - scene.vertices
        towards = towards / towards.norm(dim=1, keepdim=True).clamp(min=1e-300)
        cosine = (self.normals * towards).sum(1).abs().float()
        light = torch.where(self.normals.any(1), AMBIENT + (1 - AMBIENT) * cosine, 1.0)
        colors = torch.cat([scene.colors[:, :-1] * light[:, None], scene.colors[:, -1:]], 1)
        return replace(scene, colors=colors)


def stage(subject: Subject, shade: bool | None) -> Stage:
    """Prepare a file's content for drawing in colour.

    Args:
        subject: the content of the file.
        shade: whether to shade everything, nothing, or (None) parts with one colour and no texture.
    """
    scene = subject.scene
    lit = subject.plain if shade is None else torch.full_like(subject.plain, shade)
    texture = scene.texture
    if texture is not None:
        texture = replace(texture, images=tuple(_with_ones(image) for image in texture.images))
    colors = None if scene.colors is None else _with_ones(scene.colors)
    scene = replace(scene, colors=colors, texture=texture)
    if not lit.any() or colors is None:
        return Stage(scene, None)
    corners = scene.faces.flatten()
    normals = torch.from_numpy(corner_normals(scene.vertices.numpy(), scene.faces.numpy()))
    apart = torch.arange(len(corners)).view(-1, 3)
    split = replace(scene, vertices=scene.vertices[corners], faces=apart, colors=colors[corners])
    return Stage(split, normals * lit[corners, None])


def _with_ones(light: Float[Tensor, "*any channels"]) -> Float[Tensor, "*any more"]:
    return torch.cat([light, torch.ones_like(light[..., :1])], -1)


def corner_normals(vertices: NDArray, faces: NDArray) -> Float[np.ndarray, "corners 3"]:
    """Return smooth normals, one for each corner of each face.

    A normal is the mean direction, by area, of the faces around the corner that no crease separates from its face.
    """
    a, b, c = vertices[faces.T]
    with np.errstate(all="ignore"):
        areas = np.nan_to_num(np.cross(b - a, c - a), posinf=0, neginf=0)
    unit = areas / np.maximum(np.linalg.norm(areas, axis=1, keepdims=True), 1e-300)
    areas = areas / max(float(np.abs(areas).max()), 1e-300)
    places = np.unique(vertices, axis=0, return_inverse=True)[1].reshape(-1)  # joins vertices split at seams
    corners = places[faces.reshape(-1)]
    order = np.argsort(corners, kind="stable")
    corners, face = corners[order], order // 3
    total = areas[face]
    for step in range(1, MOST_AROUND):
        same = np.flatnonzero(corners[step:] == corners[:-step])
        if not len(same):
            break
        smooth = same[(unit[face[same]] * unit[face[same + step]]).sum(1) > CREASE]
        total[smooth] += areas[face[smooth + step]]
        total[smooth + step] += areas[face[smooth]]
    found = np.empty_like(total)
    found[order] = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
    return found


def color(
    drawn: Float[Tensor, "height width 4"], background: tuple[int, int, int] | None
) -> NDArray[np.uint8]:
    """Return sRGB of a linear image before a background; None: transparent, with coverage as a fourth channel."""
    light, covered = drawn[..., :-1], drawn[..., -1:].clamp(0, 1)
    if background is None:
        plain = light / covered.clamp(min=1e-6)
        alpha = (255 * covered).round().to(torch.uint8)
        return torch.cat([bytes_from_linear(plain), alpha], -1).numpy()
    behind = linear_from_bytes(torch.tensor(background, dtype=torch.uint8))
    return bytes_from_linear(light + (1 - covered) * behind).numpy()


def depth(drawn: Float[Tensor, "height width"]) -> NDArray[np.uint16]:
    """Return depths in millimetres; 0 where there is nothing."""
    millimetres = torch.where(drawn.isfinite(), 1000 * drawn, 0.0)
    if not 0 <= float(millimetres.max()) < 65_535.5:
        raise DataError(
            f"a depth of {float(drawn[drawn.isfinite()].max()):g} m came; 16 bits hold up to 65.535 m in millimetres. "
            "Write a .npy instead, or go nearer."
        )
    return millimetres.round().to(torch.int32).numpy().astype(np.uint16)


def face(drawn: Tensor) -> NDArray[np.uint16]:
    """Return numbers of faces from 1; 0 where there is nothing."""
    if int(drawn.max()) >= 65_535:
        raise DataError(
            f"face {int(drawn.max())} came; 16 bits hold numbers up to 65534. Write a .npy instead."
        )
    return (drawn + 1).numpy().astype(np.uint16)


def mask(drawn: Tensor) -> NDArray[np.uint8]:
    """Return 255 where there is a face, otherwise 0."""
    return 255 * drawn.numpy().astype(np.uint8)


def normal(drawn: Float[Tensor, "height width 3"]) -> NDArray[np.uint8]:
    """Return (-1, 1) as 0 to 255, black where there is nothing."""
    shares = torch.where(drawn.any(-1, keepdim=True), (drawn + 1) / 2, 0.0)
    return (255 * shares).round().to(torch.uint8).numpy()


def uv(drawn: Float[Tensor, "height width 2"]) -> NDArray[np.uint8]:
    """Return u as red and v as green, both modulo 1."""
    return (
        (255 * torch.cat([drawn.remainder(1), torch.zeros_like(drawn[..., :1])], -1))
        .round()
        .to(torch.uint8)
        .numpy()
    )


def barycentric(drawn: Float[Tensor, "height width 3"]) -> NDArray[np.uint8]:
    """Return weights of 0 to 1 as 0 to 255."""
    return (255 * drawn.clamp(0, 1)).round().to(torch.uint8).numpy()


CODES: dict[str, Callable[[Tensor], NDArray]] = {
    "barycentric": barycentric,
    "depth": depth,
    "face": face,
    "mask": mask,
    "normal": normal,
    "uv": uv,
}
"""Functions that turn channels other than colour into integers of an image; other channels are written as .npy only."""
SUFFIXES = (".png", ".gif", ".mp4", ".npy")


def write(out: Path, frames: Iterable[NDArray], rate: int) -> None:
    """Write one image (.png), a film (.gif, .mp4) or numbers (.npy), completely or not at all.

    Args:
        out: path of the file.
        frames: (height, width) or (height, width, channels), 8 or 16 bits, except for .npy.
        rate: frames per second.

    Raises:
        DataError: ffmpeg failed.
        OSError: the place cannot be written.
    """
    with replacing(out) as partial:
        suffix = out.suffix.lower()
        if suffix == ".mp4":
            _film(partial, iter(frames), rate)
        elif suffix == ".gif":
            first, *more = (Image.fromarray(frame).convert("RGB").quantize(256) for frame in frames)
            first.save(partial, "GIF", save_all=True, append_images=more, duration=round(1000 / rate), loop=0)
        elif suffix == ".npy":
            whole = list(frames)
            with partial.open("wb") as stream:
                np.save(stream, whole[0] if len(whole) == 1 else np.stack(whole))
        else:
            Image.fromarray(next(iter(frames))).save(partial, "PNG")


def encoder() -> str:
    """Return the path of the program that makes an .mp4.

    Raises:
        ConfigError: the machine has no such program.
    """
    program = shutil.which("ffmpeg")
    if program is None:
        raise ConfigError(
            "an .mp4 needs the program ffmpeg, which is not here; install it, or ask for a .gif."
        )
    return program


def _film(file: Path, frames: Iterator[NDArray], rate: int) -> None:
    """Write a film in H.264 if the machine's ffmpeg supports it."""
    program = encoder()
    first = next(frames)
    height, width = first.shape[:2]
    command = [program, "-loglevel", "error", "-y", "-f", "rawvideo", "-pixel_format", "rgb24"]
    command += ["-video_size", f"{width}x{height}", "-framerate", f"{rate}", "-i", "-", "-an"]
    command += ["-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4", f"{file}"]
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=said, stderr=said)
        try:
            assert process.stdin is not None
            for frame in chain([first], frames):
                pixels = frame if frame.ndim == 3 else np.repeat(frame[..., None], 3, 2)
                process.stdin.write(np.ascontiguousarray(pixels).tobytes())
            process.stdin.close()
        except BrokenPipeError:
            pass  # ffmpeg ended early; its message is reported below
        except BaseException:
            process.kill()
            raise
        finally:
            status = process.wait()
        if status != 0:
            said.seek(0)
            words = shorten(said.read().decode("utf-8", "replace").strip()) or "nothing"
            raise DataError(
                f"ffmpeg ended with {status} and said: {words}. Ask for a .gif, or install another ffmpeg."
            )
