"""Data set `pose_from_image`: images of a coloured body in a random pose, with its parameters as target."""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.bodies.parametric import ImageSide, ParametricBody, parametric_body
from framework.configuration.paths import FilePath
from framework.data import Batch, Data, Splits
from framework.datasets.fields import FetchedInBatches, Fields
from framework.datasets.images import decode, has_alpha, open_image
from framework.errors import ConfigError, DataError
from framework.geometry.camera import Camera
from framework.geometry.srgb import bytes_from_linear, linear_from_bytes
from framework.renderer import Renderer, Scene
from framework.target import Target

VERSION = 1
"""Version of the random draws, part of the fingerprint; increase it if the draws change."""
Count = Annotated[int, Field(ge=1, le=1_000_000)]


@dataclass(frozen=True, kw_only=True)
class Counts:
    """Number of images of each split."""

    train: Count = 32
    validation: Count = 8
    test: Count = 10


@dataclass(frozen=True, kw_only=True)
class Apart:  # this name is part of stored fingerprints
    """Settings of the difference between the drawn bodies and the body at its nominal position, pose and shape.

    Every body is rotated by the same angle and moved by the same distance; its pose and shape are random.

    Attributes:
        turned_deg: angle of the whole body's rotation, degrees, about an axis of random direction.
        moved: length of the translation, metres, in a random direction.
        pose_spread: standard deviation of each movement of a joint, as a multiple of its usual standard deviation.
        shape_spread: standard deviation of each shape parameter, as a multiple of its standard deviation among people.
    """

    turned_deg: Annotated[float, Field(ge=0, le=180)] = 30.0
    moved: Annotated[float, Field(ge=0, le=1)] = 0.2
    pose_spread: Annotated[float, Field(ge=0, le=3)] = 1.5
    shape_spread: Annotated[float, Field(ge=0, le=2)] = 1.0


class PoseFromImage(Data):
    """Synthetic images that show one body each; the target is the body's position, pose and shape.

    An input is (4, height, width): the linear RGB of each pixel, black beyond the body, and the share of the pixel that
    the body covers. Targets are the parameters of a `ParametricBody`; 0 is the nominal position, pose and shape. A
    sample depends only on the settings, its split and its number in the split; its image is rendered when it is
    fetched. Batches also hold the image as "color" (batch, height, width, 3), and "mask" (batch, height, width), bool,
    true for pixels that the body covers by half or more.

    Args:
        renderer: draws the images.
        counts: numbers of images of the splits.
        displacement: settings of the difference between the drawn bodies and the nominal one.
        height, width: pixels, multiples of 4.
        body: file of a body model of the SMPL family (.npz, .pkl); None: the default body, extracted on first use.
        data_seed: seed of the draws, independent of the seed of the run.

    Raises:
        DataError: the body is not available or cannot be read.
        ConfigError: the renderer draws no colours.
    """

    bibtex = "bregier2026anny"
    suffixes = (".png",)
    varies = False

    def __init__(
        self,
        *,
        renderer: Renderer = "rasterizer",  # pyright: ignore[reportArgumentType]  # built by the framework
        counts: Counts,
        displacement: Apart,
        height: ImageSide = 128,
        width: ImageSide = 96,
        body: FilePath | None = None,
        data_seed: Annotated[int, Field(ge=0, lt=2**31)] = 0,
    ) -> None:
        if "color" not in renderer.channels or renderer.background:
            raise ConfigError(
                f"data.renderer = {type(renderer).__name__} does not draw the channel `color` with a black "
                "background, which this data set requires. Choose another renderer, such as rasterizer with its "
                "default background."
            )
        self.renderer = renderer
        self.counts = asdict(counts)
        self.displacement = displacement
        self.input_shape = (4, height, width)
        self.body = body
        self.data_seed = data_seed

    def prepare(self) -> None:
        self.body_model = parametric_body(self.body)
        spread = self._spread()
        self.target = Target(
            "real", self.body_model.names, (0.0,) * len(spread), tuple(spread.clip(1e-3).tolist())
        )
        self.groups = ("people",)
        self.synthetic = True
        self.skipped = 0
        camera = self.body_model.camera(*self.input_shape[1:])
        numbers = [self._draw_parameters(split) for split in range(len(self.counts))]
        self._splits = Splits(*(Poses(self.body_model, self.renderer, camera, some) for some in numbers))

    def splits(self) -> Splits:
        return self._splits

    def _spread(self) -> Float[np.ndarray, "number"]:
        """Return the standard deviation of each parameter, before movements are clipped to their limits."""
        spread, displacement = self.body_model.spread.numpy().copy(), self.displacement
        shape = 6 + len(self.body_model.slots)
        spread[:3], spread[3:6] = math.radians(displacement.turned_deg) / 3**0.5, displacement.moved / 3**0.5
        spread[6:shape] *= displacement.pose_spread
        spread[shape:] *= displacement.shape_spread
        return spread

    def _draw_parameters(self, split: int) -> Float[Tensor, "sample number"]:
        random = np.random.default_rng((self.data_seed, split))
        count = self.counts[Splits._fields[split]]
        parameters = random.normal(0, 1, (count, len(self.body_model.names)))
        for columns, length in (
            (slice(0, 3), math.radians(self.displacement.turned_deg)),
            (slice(3, 6), self.displacement.moved),
        ):
            parameters[:, columns] *= length / np.linalg.norm(parameters[:, columns], axis=1, keepdims=True)
        parameters[:, 6:] *= self._spread()[6:]
        least, most = self.body_model.limits.numpy().T
        return torch.from_numpy(parameters.clip(least, most))

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        if not files:
            raise DataError("The list of files is empty; expected one or more images of a body.")
        pictures = torch.stack([self._picture_of(Path(file)) for file in files])
        return Fields(input=pictures, index=torch.arange(len(files)))

    def _picture_of(self, file: Path) -> Float[Tensor, "4 height width"]:
        _, height, width = self.input_shape
        with open_image(file) as image:
            if not has_alpha(image) or image.size != (width, height):
                raise DataError(
                    f"{file}: {image.width} × {image.height} pixels, mode {image.mode}; expected {width} × {height} "
                    "and an alpha channel that holds the share of each pixel that the body covers. Cut out the body "
                    "and scale the image."
                )
            stored = torch.from_numpy(np.array(decode(image, 4, upright=False)))
        cover = stored[..., 3:].float() / 255
        return torch.cat([linear_from_bytes(stored[..., :3]) * cover, cover], -1).movedim(-1, 0)

    def augment(self, batch: Batch) -> Batch:
        return batch

    def fingerprint(self) -> Mapping[str, str]:
        digest = hashlib.sha256(np.ascontiguousarray(self.body_model.template.numpy()).tobytes())
        for split in self._splits:
            assert isinstance(split, Poses)
            digest.update(split.numbers.numpy().tobytes())
        return {
            "root": "generated",
            "version": f"pose_from_image {VERSION}",
            "body": self.body_model.source,
            "renderer": f"{type(self.renderer).__module__}.{type(self.renderer).__qualname__}",
            "apart": str(self.displacement),
            "size": "×".join(map(str, self.input_shape[1:])),
            "data_seed": str(self.data_seed),
            **{name: str(count) for name, count in self.counts.items()},
            "sha256": digest.hexdigest(),
        }

    def preview(self, inputs: Tensor) -> np.ndarray:
        return bytes_from_linear(inputs[:3].float()).movedim(0, -1).cpu().numpy()


class Poses(FetchedInBatches):
    """Images of the bodies of one split, which are rendered when they are fetched.

    Args:
        body_model: body that the images show.
        renderer: renderer that draws the images.
        camera: camera of all images.
        numbers: parameters of the body in each image.
    """

    def __init__(
        self,
        body_model: ParametricBody,
        renderer: Renderer,
        camera: Camera,
        numbers: Float[Tensor, "sample number"],
    ) -> None:
        self.body_model, self.renderer, self.camera, self.numbers = body_model, renderer, camera, numbers

    def __len__(self) -> int:
        return len(self.numbers)

    @torch.no_grad()
    def __getitems__(self, indices: Sequence[int]) -> Batch:
        chosen = torch.tensor(list(indices), dtype=torch.int64)
        body_model = self.body_model
        scenes = [
            Scene(body_model(numbers), body_model.faces, body_model.colors, self.camera)
            for numbers in self.numbers[chosen]
        ]
        rendered = torch.stack([channels["color"] for channels in self.renderer.batch(scenes)])
        return {
            "input": rendered.movedim(-1, 1).contiguous(),
            "target": self.numbers[chosen].float(),
            "color": rendered[..., :3].contiguous(),
            "mask": rendered[..., 3] >= 0.5,
            "group": torch.zeros(len(chosen), dtype=torch.int64),
            "index": chosen,
        }
