"""Frames of scene files: the same view of the subject of every file, with true images if the user has them."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from framework.data import Batch
from framework.datasets import images
from framework.errors import DataError
from framework.geometry.camera import Camera
from framework.geometry.srgb import linear_from_bytes
from framework.renderer import Scene
from framework.scenes import turntable
from framework.scenes.parts import Axis, Subject
from framework.scenes.pictures import Stage, prepare_stage
from framework.scenes.scene_files import UPWARDS, read
from framework.storage.enclosed import add_data_folder
from framework.storage.reading import translate_errors


@dataclass(frozen=True)
class View:
    """Position of the camera relative to the subject of a file.

    Attributes:
        azimuth: degrees around the subject; 0 sees its front.
        elevation: degrees above the horizon.
        tilt: degrees by which the camera rolls.
        distance: metres from the subject's centre; None: so that the whole subject is visible.
        fov: degrees from the top of the image to its bottom.
        height: pixels.
        width: pixels.
        up: vertical axis of the subject; None: the axis that is usual for the format of the file.
        camera: file with an exact camera, which replaces all of the above; None if there is none.
    """

    azimuth: float = 30.0
    elevation: float = 15.0
    tilt: float = 0.0
    distance: float | None = None
    fov: float = 40.0
    height: int = 480
    width: int = 640
    up: Axis | None = None
    camera: Path | None = None

    def cameras(self, subject: Subject, count: int) -> Iterator[Camera]:
        """Yield `count` cameras at equal steps on a circle around a subject, beginning with this view."""
        sphere, up = turntable.bounding_sphere(subject.scene), self.up or subject.up
        if self.camera is not None:
            first = turntable.read_camera(self.camera)
        else:
            angles = math.radians(self.azimuth), math.radians(self.elevation), math.radians(self.tilt)
            size = (self.height, self.width)
            first = turntable.look_at(sphere, up, angles, self.distance, math.radians(self.fov), size)
        yield from turntable.circle_cameras(first, sphere.centre, up, count)


@dataclass(frozen=True)
class FileFrames:
    """Frames of scene files, in the order of files and, for each file, of cameras.

    Attributes:
        files: scene files.
        view: position of the first camera.
        count: number of frames of each file, once around its subject.
        shade: whether surfaces are lit from the camera; None: only those with a single colour.
        truth: folder of true images, `<name of the frame>.png`; None if there are none.
        ground: linear RGB behind the subject, for true images with transparency.
    """

    files: Sequence[Path]
    view: View
    count: int = 1
    shade: bool | None = None
    truth: Path | None = None
    ground: tuple[float, float, float] = (1.0, 1.0, 1.0)
    _loaded: dict[int, tuple[Stage, list[Camera], tuple[str, ...]]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.files) * self.count

    @cached_property
    def names(self) -> list[str]:
        """Return the name of each frame: that of its file, with a number if a file has several frames."""
        stems = [file.stem for file in self.files]
        names = [
            stem if stems.count(stem) == 1 else file.name.replace(".", "_")
            for stem, file in zip(stems, self.files, strict=True)
        ]
        if self.count == 1:
            return names
        return [f"{name}_{number:04}" for name in names for number in range(self.count)]

    def scene(self, index: int) -> Scene:
        """Return the scene of a frame; its colours have a fourth channel, which is 1 on all surfaces.

        Raises:
            DataError: the file cannot be read.
        """
        stage, cameras, _ = self._load(index // self.count)
        return stage.lit_scene(cameras[index % self.count])

    def notes(self, number: int) -> tuple[str, ...]:
        """Return a sentence about each element of file `number` that its scene leaves out.

        Raises:
            DataError: the file cannot be read.
        """
        return self._load(number)[2]

    def _load(self, number: int) -> tuple[Stage, list[Camera], tuple[str, ...]]:
        """Return the prepared scene of file `number`, its cameras, and its notes; the last file stays in memory."""
        if number not in self._loaded:
            self._loaded.clear()  # frames are requested file by file
            subject = read(self.files[number])
            cameras = [*self.view.cameras(subject, self.count)]
            self._loaded[number] = prepare_stage(subject, self.shade), cameras, subject.notes
        return self._loaded[number]

    def batch(self, index: int) -> Batch:
        """Return a frame as a batch of one sample: "index", "group" and, if there are true images, "color" and "mask".

        Raises:
            DataError: the true image is missing or damaged, or has another size than the camera's image.
        """
        batch: Batch = {"index": torch.tensor([index]), "group": torch.tensor([0])}
        if self.truth is None:
            return batch
        file, camera = self.truth / f"{self.names[index]}.png", self.scene(index).camera
        if not file.is_file():
            raise DataError(
                f"{file}: no such file; expected the true image of the frame {self.names[index]}. Name the true images "
                "like the images that mode=render writes into the folder `images` of its run."
            )
        color, mask = read_true_image(file, self.ground)
        if color.shape[:2] != (camera.height, camera.width):
            raise DataError(
                f"{file}: the image has {color.shape[1]} × {color.shape[0]} pixels, but the camera's image has "
                f"{camera.width} × {camera.height}. Set mode.width and mode.height to the size of the true images."
            )
        return batch | {"color": color[None]} | ({} if mask is None else {"mask": mask[None]})


def find_scene_files(path: Path) -> list[Path]:
    """Return the scene files in the folder `path`, or `path` itself.

    Raises:
        DataError: the folder holds no scene file.
    """
    if not path.is_dir():
        return [path]
    add_data_folder(path)
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in UPWARDS and file.is_file())
    if not files:
        raise DataError(
            f"{path} holds no scene file; expected a file whose name ends in {', '.join(UPWARDS)}. Set mode.files to a "
            "scene file, or to a folder of them."
        )
    return files


def read_true_image(
    file: Path, ground: tuple[float, float, float]
) -> tuple[Float[Tensor, "height width 3"], Tensor | None]:
    """Read an image that may be transparent, and return its colours and its mask.

    Args:
        file: path of the image.
        ground: linear RGB that shows through transparent pixels.

    Returns:
        The image in linear RGB in front of `ground`; and a mask that is True where the opacity is at least a half, None
        if the image has no transparency.

    Raises:
        DataError: the file cannot be read as an image.
    """
    with translate_errors(file, "an image"), images.open_image(file) as image:
        transparent = images.has_alpha(image)
        pixels = torch.from_numpy(np.array(images.decode(image, 4, upright=False)))
    color, cover = linear_from_bytes(pixels[..., :3].contiguous()), pixels[..., 3:].float() / 255
    color = color * cover + (1 - cover) * torch.tensor(ground)
    return color, (cover[..., 0] >= 0.5) if transparent else None
