"""Functions that turn a scene into images and videos: shading, background, encoding of channels, output files."""

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
from framework.scenes.parts import Subject
from framework.storage.files import replacing

AMBIENT = 0.12
"""Brightness of a surface seen edge-on, as a share of the brightness of a surface that faces the camera."""
CREASE = math.cos(math.radians(40))
"""Cosine of the largest angle between faces whose common edge is smoothed."""
MOST_AROUND = 32
"""Largest number of faces at one vertex whose normals are averaged."""


@dataclass(frozen=True)
class Stage:
    """A scene prepared for drawing in colour.

    Attributes:
        scene: the scene; its last colour channel is 1 at every vertex, so that its render is the share of each pixel
            that the scene covers.
        normals: unit normals of the vertices that are shaded by a light at the camera, 0 for the other vertices; None
            if no vertex is shaded.
    """

    scene: Scene
    normals: Float[Tensor, "vertices 3"] | None

    def lit_scene(self, camera: Camera) -> Scene:
        """Return the scene as `camera` sees it, with a light at the camera that shades both sides by Lambert's law."""
        scene = replace(self.scene, camera=camera)
        if self.normals is None or scene.colors is None:
            return scene
        eye = -(camera.rotation.double().T @ camera.translation.double())
        towards = eye - scene.vertices
        towards = towards / towards.norm(dim=1, keepdim=True).clamp(min=1e-300)
        cosine = (self.normals * towards).sum(1).abs().float()
        light = torch.where(self.normals.any(1), AMBIENT + (1 - AMBIENT) * cosine, 1.0)
        colors = torch.cat([scene.colors[:, :-1] * light[:, None], scene.colors[:, -1:]], 1)
        return replace(scene, colors=colors)


def prepare_stage(subject: Subject, shade: bool | None) -> Stage:
    """Prepare the content of a scene file for drawing in colour.

    Args:
        subject: the content of the file.
        shade: True to shade every part, False to shade none, None to shade parts with a single colour and no texture.
    """
    scene = subject.scene
    lit = subject.plain if shade is None else torch.full_like(subject.plain, shade)
    texture = scene.texture
    if texture is not None:
        texture = replace(texture, images=tuple(_append_ones(image) for image in texture.images))
    colors = None if scene.colors is None else _append_ones(scene.colors)
    scene = replace(scene, colors=colors, texture=texture)
    if not lit.any() or colors is None:
        return Stage(scene, None)
    corners = scene.faces.flatten()
    normals = torch.from_numpy(corner_normals(scene.vertices.numpy(), scene.faces.numpy()))
    separate_faces = torch.arange(len(corners)).view(-1, 3)
    split = replace(scene, vertices=scene.vertices[corners], faces=separate_faces, colors=colors[corners])
    return Stage(split, normals * lit[corners, None])


def _append_ones(light: Float[Tensor, "*any channels"]) -> Float[Tensor, "*any more"]:
    return torch.cat([light, torch.ones_like(light[..., :1])], -1)


def corner_normals(vertices: NDArray, faces: NDArray) -> Float[np.ndarray, "corners 3"]:
    """Return smooth normals, one for each corner of each face.

    Each normal is the area-weighted mean of the normals of the faces at this corner. A face counts only if the angle
    between it and the corner's own face is below 40° (`CREASE`), so that sharp edges stay sharp.

    Args:
        vertices: (vertices, 3).
        faces: (faces, 3), indices of vertices.
    """
    a, b, c = vertices[faces.T]
    with np.errstate(all="ignore"):
        areas = np.nan_to_num(np.cross(b - a, c - a), posinf=0, neginf=0)
    unit = areas / np.maximum(np.linalg.norm(areas, axis=1, keepdims=True), 1e-300)
    areas = areas / max(float(np.abs(areas).max()), 1e-300)
    # equal positions, also where a seam splits a vertex
    positions = np.unique(vertices, axis=0, return_inverse=True)[1].reshape(-1)
    corners = positions[faces.reshape(-1)]
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
    normals = np.empty_like(total)
    normals[order] = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
    return normals


def color_image(
    rendered: Float[Tensor, "height width 4"], background: tuple[int, int, int] | None
) -> NDArray[np.uint8]:
    """Return the 8-bit sRGB image of linear RGB and coverage.

    Args:
        rendered: linear RGB multiplied by the coverage, and as fourth channel the coverage, which is the share of each
            pixel that the scene covers.
        background: sRGB colour behind the scene; None for a transparent background, with alpha as fourth channel.
    """
    light, covered = rendered[..., :-1], rendered[..., -1:].clamp(0, 1)
    if background is None:
        plain = light / covered.clamp(min=1e-6)
        alpha = (255 * covered).round().to(torch.uint8)
        return torch.cat([bytes_from_linear(plain), alpha], -1).numpy()
    behind = linear_from_bytes(torch.tensor(background, dtype=torch.uint8))
    return bytes_from_linear(light + (1 - covered) * behind).numpy()


def depth_image(rendered: Float[Tensor, "height width"]) -> NDArray[np.uint16]:
    """Return depths in millimetres as 16-bit integers; 0 for background."""
    millimetres = torch.where(rendered.isfinite(), 1000 * rendered, 0.0)
    if not 0 <= float(millimetres.max()) < 65_535.5:
        raise DataError(
            f"the image has a depth of {float(rendered[rendered.isfinite()].max()):g} m, but 16 bits hold at most "
            "65.535 m in "
            "millimetres. Write a .npy file instead, or move the camera nearer."
        )
    return millimetres.round().to(torch.int32).numpy().astype(np.uint16)


def face_image(rendered: Tensor) -> NDArray[np.uint16]:
    """Return the face index plus 1 as 16-bit integers; 0 for background."""
    if int(rendered.max()) >= 65_535:
        raise DataError(
            f"the image shows face {int(rendered.max())}, but 16 bits hold indices up to 65534. Write a .npy file "
            "instead."
        )
    return (rendered + 1).numpy().astype(np.uint16)


def mask_image(rendered: Tensor) -> NDArray[np.uint8]:
    """Return 255 for pixels that show a face, 0 for background."""
    return 255 * rendered.numpy().astype(np.uint8)


def normal_image(rendered: Float[Tensor, "height width 3"]) -> NDArray[np.uint8]:
    """Return normals with components from -1 to 1 as 0 to 255; black for background."""
    shares = torch.where(rendered.any(-1, keepdim=True), (rendered + 1) / 2, 0.0)
    return (255 * shares).round().to(torch.uint8).numpy()


def uv_image(rendered: Float[Tensor, "height width 2"]) -> NDArray[np.uint8]:
    """Return u modulo 1 as red and v modulo 1 as green, 0 to 255."""
    return (
        (255 * torch.cat([rendered.remainder(1), torch.zeros_like(rendered[..., :1])], -1))
        .round()
        .to(torch.uint8)
        .numpy()
    )


def barycentric_image(rendered: Float[Tensor, "height width 3"]) -> NDArray[np.uint8]:
    """Return barycentric weights from 0 to 1 as 0 to 255."""
    return (255 * rendered.clamp(0, 1)).round().to(torch.uint8).numpy()


INTEGER_IMAGES: dict[str, Callable[[Tensor], NDArray]] = {
    "barycentric": barycentric_image,
    "depth": depth_image,
    "face": face_image,
    "mask": mask_image,
    "normal": normal_image,
    "uv": uv_image,
}
"""Functions that encode a channel as the integers of an image file, by channel; `color_image` encodes colours."""
SUFFIXES = (".png", ".gif", ".mp4", ".npy")


def write_frames(out: Path, frames: Iterable[NDArray], rate: int) -> None:
    """Write one image (.png), a video (.gif, .mp4) or exact numbers (.npy), completely or not at all.

    Args:
        out: path of the file.
        frames: arrays (height, width) or (height, width, channels); 8-bit or 16-bit integers unless the file is .npy.
        rate: frames per second of a video.

    Raises:
        DataError: ffmpeg failed.
        OSError: the file cannot be written.
    """
    with replacing(out) as partial:
        suffix = out.suffix.lower()
        if suffix == ".mp4":
            _write_video(partial, iter(frames), rate)
        elif suffix == ".gif":
            first, *later_frames = (Image.fromarray(frame).convert("RGB").quantize(256) for frame in frames)
            first.save(
                partial, "GIF", save_all=True, append_images=later_frames, duration=round(1000 / rate), loop=0
            )
        elif suffix == ".npy":
            whole = list(frames)
            with partial.open("wb") as stream:
                np.save(stream, whole[0] if len(whole) == 1 else np.stack(whole))
        else:
            Image.fromarray(next(iter(frames))).save(partial, "PNG")


def find_ffmpeg() -> str:
    """Return the path of ffmpeg, which writes .mp4 files.

    Raises:
        ConfigError: ffmpeg is not installed.
    """
    program = shutil.which("ffmpeg")
    if program is None:
        raise ConfigError(
            "an .mp4 requires the program ffmpeg, which is not installed. Install ffmpeg, or choose a .gif."
        )
    return program


def _write_video(file: Path, frames: Iterator[NDArray], rate: int) -> None:
    """Write an .mp4 with ffmpeg's default encoder, which is H.264 in most builds."""
    program = find_ffmpeg()
    first = next(frames)
    height, width = first.shape[:2]
    command = [program, "-loglevel", "error", "-y", "-f", "rawvideo", "-pixel_format", "rgb24"]
    command += ["-video_size", f"{width}x{height}", "-framerate", f"{rate}", "-i", "-", "-an"]
    command += ["-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4", f"{file}"]
    with tempfile.TemporaryFile() as messages:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=messages, stderr=messages)
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
            messages.seek(0)
            words = shorten(messages.read().decode("utf-8", "replace").strip()) or "nothing"
            raise DataError(
                f"ffmpeg failed with exit code {status} and the message: {words}. Choose a .gif, or install another "
                "ffmpeg."
            )
