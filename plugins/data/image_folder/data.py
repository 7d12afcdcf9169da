"""Data sets of a user's labelled images; framework.data describes the contract."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from pydantic import Field
from torch import Tensor
from torch.nn import functional
from torch.utils.data import Dataset

from framework.configuration.paths import FilePath
from framework.data import Batch, Data, Splits
from framework.datasets import given_images, images
from framework.datasets.class_names import describe_dominant
from framework.datasets.fields import FetchedInBatches, fetch
from framework.datasets.new_files import Trained, restore_trained
from framework.errors import ConfigError
from framework.target import Target
from plugins.data.image_folder.corruption import Corrupted, Corruption
from plugins.data.image_folder.labelled import LabelledImages, Loaded, find_folder
from plugins.data.image_folder.policy import Policy, require_package, vary_images

Centre = Literal["image", "mass"]
"""Point about which an image is turned."""
Jitter = Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False)]


class LabelledData(Data):
    """Base of the data sets of this folder.

    Args:
        root: Folder of the images. It holds folders that are named by class, perhaps within folders train, validation
            and test; or idx files such as train-images-idx3-ubyte.gz, with the files of their labels.
        labelled: Settings of the images and their labels.
        jitter: Largest share by which training images are shifted, scaled and made brighter or darker.
    """

    bibtex = "image_folder"
    suffixes = images.SUFFIXES
    synthetic = False
    fewest: ClassVar[int] = 2
    """Smallest number of classes."""
    predicts_classes: ClassVar[bool] = True
    """True if the target is the class of an image."""

    def __init__(self, root: str | None, labelled: LabelledImages, jitter: float) -> None:
        self.root = root
        self.labelled = labelled
        self.jitter = jitter
        self.input_shape = labelled.input_shape
        self._trained: Trained | None = None
        self._own = Trained()

    _splits: Splits

    def _keep(self, loaded: Loaded) -> None:
        """Store name, sizes, digest and remarks of the loaded images as attributes."""
        self.title = find_folder(self.root).resolve().name
        self.skipped, self.remarks = loaded.skipped, loaded.remarks
        self._digest = loaded.digest
        self._own = loaded.own if self.predicts_classes else loaded.own._replace(classes=())
        self._sizes = {split: str(len(table)) for split, table in loaded.splits.items()}

    def state_dict(self) -> Mapping[str, Any]:
        return (self._trained or self._own).state()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._trained = restore_trained(state, type(self).__name__)

    def check_files(self) -> None:
        self.labelled.list_images(find_folder(self.root), self.fewest)

    def splits(self) -> Splits:
        return self._splits

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        return images.load_unlabelled([self.labelled.crop(Path(file)) for file in files])

    def inputs(self, user_data: Any) -> Tensor:
        return given_images.to_inputs(self, user_data)

    def fingerprint(self) -> Mapping[str, str]:
        shape = "×".join(map(str, self.input_shape))
        return {"root": str(self.root), "version": "1", "shape": shape, **self._sizes, "sha256": self._digest}

    def preview(self, inputs: Tensor) -> np.ndarray:
        return images.to_rgb8(inputs)


class ImageFolder(LabelledData):
    """A user's own images with classes: folders named by class, a table of labels, or idx files (the format of MNIST).

    Args:
        root: Folder of the images. It holds folders that are named by class, perhaps within folders train, validation
            and test; or idx files such as train-images-idx3-ubyte.gz, with the files of their labels.
        labelled: Settings of the images and their labels.
        mirror: Whether half of the training images are mirrored left to right.
        jitter: Largest share by which training images are shifted, scaled and made brighter or darker.
        policy: Policy that also varies the training images, after mirror and jitter: one random operation
            (TrivialAugment) or two (RandAugment) for each batch; None for none.
        corruption: Corruption of the test images: Gaussian noise, a Gaussian blur, less contrast, or JPEG compression;
            None for none.
        strength: Strength of the corruption, as in ImageNet-C; None: 3 if there is a corruption.

    Raises:
        ConfigError: A strength is given without a corruption, or kornia, which a policy needs, is not installed.
    """

    bibtex = (
        "image_folder, hendrycks2019benchmarking, muller2021trivial, cubuk2020randaugment, riba2020kornia"
    )

    def __init__(
        self,
        *,
        root: FilePath | None = None,
        labelled: LabelledImages,
        mirror: bool = False,
        jitter: Jitter = 0.08,
        policy: Policy | None = None,
        corruption: Corruption | None = None,
        strength: Annotated[int, Field(ge=1, le=5)] | None = None,
    ) -> None:
        super().__init__(root, labelled, jitter)
        self.mirror = mirror
        require_package(policy)
        self.policy: Policy | None = policy
        self.varies = mirror or jitter > 0 or policy is not None
        self.corruption: Corruption | None = corruption
        if corruption is None and strength is not None:
            raise ConfigError(
                f"data.strength = {strength} has no effect without a corruption. Set data.corruption, or leave "
                "data.strength out."
            )
        self.strength = 3 if strength is None else strength

    def prepare(self) -> None:
        loaded = self.labelled.load(
            find_folder(self.root),
            lambda labels, split: {"target": labels, "group": torch.zeros_like(labels)},
            self.fewest,
            self._trained,
        )
        self._keep(loaded)
        self.target = Target("class", loaded.classes)
        self.groups = (self.title,)
        self._splits = Splits(**loaded.splits)
        self.remarks += describe_dominant(loaded.classes, loaded.tested)
        if self.corruption is not None:
            self._splits = self._splits._replace(
                test=Corrupted(self._splits.test, self.corruption, self.strength)
            )
            self.remarks += (f"test images are corrupted: {self.corruption}, strength {self.strength} of 5",)

    def augment(self, batch: Batch) -> Batch:
        varied = batch["input"]
        if self.jitter or self.mirror:
            mirrored = (torch.rand(len(varied)) < 0.5) & self.mirror
            varied = images.augment(varied, mirrored, self.jitter)
        if self.policy is not None:
            varied = vary_images(varied, self.policy)
        return {**batch, "input": varied}

    def fingerprint(self) -> Mapping[str, str]:
        corruption = "none" if self.corruption is None else f"{self.corruption} {self.strength}"
        return {**super().fingerprint(), "corruption": corruption}


class TurnedImages(LabelledData):
    """A user's own images, each turned by a random angle, which is the target; results are also given for each class.

    An image is turned counter-clockwise about its centre, and only the largest disc inside the square is kept, since
    the corners would reveal the angle. Each image of the validation or test split has one angle, which never changes. A
    training image is turned by a new angle in every epoch.

    If the subjects of all images lie to the same side of the centre, even by half a pixel, the place of the subject in
    the turned image reveals the angle. `centre="mass"` turns each image about its centre of mass, which lies in the
    middle of the turned image.

    Args:
        root: Folder of the images. It holds folders that are named by class, perhaps within folders train, validation
            and test; or idx files such as train-images-idx3-ubyte.gz, with the files of their labels.
        labelled: Settings of the images and their labels.
        jitter: Largest share by which training images are shifted, scaled and made brighter or darker.
        centre: Point about which an image is turned: "image", its middle, or "mass", its centre of mass.
    """

    fewest = 1
    predicts_classes = False

    def __init__(
        self,
        *,
        root: FilePath | None = None,
        labelled: LabelledImages,
        jitter: Jitter = 0.0,
        centre: Centre = "image",
    ) -> None:
        super().__init__(root, labelled, jitter)
        self.centre: Centre = centre

    def prepare(self) -> None:
        loaded = self.labelled.load(find_folder(self.root), self._choose_angles, self.fewest, self._trained)
        self._keep(loaded)
        self.target = Target("angle", ("turn",))
        self.groups = loaded.classes
        self._upright = loaded.splits["train"]
        self._splits = Splits(**{split: Turned(table, self.centre) for split, table in loaded.splits.items()})

    def _choose_angles(self, labels: Int[Tensor, "samples"], split: str) -> dict[str, Tensor]:
        """Return an angle for each sample, uniform in [-π, π), and its class as its group."""
        seed = [self.labelled.data_seed, Splits._fields.index(split)]
        turns = np.random.default_rng(seed).uniform(-math.pi, math.pi, (len(labels), 1))
        return {"target": torch.from_numpy(turns.astype(np.float32)), "group": labels}

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        return Turned(super().read(files), self.centre)

    def inputs(self, user_data: Any) -> Tensor:
        inputs = super().inputs(user_data)
        items = user_data if isinstance(user_data, list | tuple) else [user_data]
        if all(isinstance(item, str | Path) for item in items):  # files, which `read` has centred
            return inputs
        return stand_upright(inputs, self.centre)

    def augment(self, batch: Batch) -> Batch:
        angles = (2 * torch.rand(len(batch["target"]), dtype=torch.float32) - 1) * math.pi
        upright = fetch(self._upright, batch["index"].tolist())["input"].to(batch["input"].device)
        if self.jitter:
            upright = images.augment(upright, torch.zeros(len(upright), dtype=torch.bool), self.jitter)
        angles = angles.to(batch["target"])
        turned = turn(upright, angles, find_centres(upright, self.centre))
        return {**batch, "input": turned, "target": angles[:, None]}

    def fingerprint(self) -> Mapping[str, str]:
        return {**super().fingerprint(), **({} if self.centre == "image" else {"centre": self.centre})}


class Turned(FetchedInBatches):
    """Data set whose images are turned by their targets when they are fetched; images without targets stay upright.

    Args:
        upright: Data set of upright images.
        centre: Point about which an image is turned, as in `TurnedImages`.
    """

    def __init__(self, upright: Dataset[Batch], centre: Centre) -> None:
        self.upright = upright
        self.centre: Centre = centre

    def __len__(self) -> int:
        return len(self.upright)  # type: ignore[arg-type]

    def __getitems__(self, indices: Sequence[int]) -> Batch:
        batch = fetch(self.upright, indices)
        pixels = batch["input"]
        if "target" not in batch:
            return {**batch, "input": stand_upright(pixels, self.centre)}
        return {**batch, "input": turn(pixels, batch["target"][:, 0], find_centres(pixels, self.centre))}


def stand_upright(
    pixels: Shaped[Tensor, "batch channels side side"], centre: Centre
) -> Shaped[Tensor, "batch channels side side"]:
    """Return images as `turn` returns them for the angle 0."""
    if centre == "image":
        return keep_disc(pixels)
    return turn(pixels, torch.zeros(len(pixels), device=pixels.device), find_centres(pixels, centre))


def find_centres(
    pixels: Shaped[Tensor, "batch channels side side"], centre: Centre
) -> Float[Tensor, "batch 2"] | None:
    """Return (x, y) of the centre of mass of each image, in units of half a side from the middle; y counts downwards.

    The mass of a pixel is the distance of its brightness from that of the background, which is the median of the
    outermost pixels. An image of one brightness has its centre of mass in the middle.

    Returns:
        The centres of mass, or None if `centre` is "image".
    """
    if centre == "image":
        return None
    brightness = pixels.float().mean(1)
    edges = [brightness[:, 0], brightness[:, -1], brightness[:, 1:-1, 0], brightness[:, 1:-1, -1]]
    mass = (brightness - torch.cat(edges, 1).median(1).values[:, None, None]).abs()
    side = pixels.shape[-1]
    place = (2 * torch.arange(side, device=pixels.device) - side + 1) / side
    moments = torch.stack([(mass * place).sum((1, 2)), (mass * place[:, None]).sum((1, 2))], 1)
    return moments / mass.sum((1, 2)).clamp(min=torch.finfo(mass.dtype).tiny)[:, None]


def turn(
    pixels: Shaped[Tensor, "batch channels side side"],
    angles: Float[Tensor, "batch"],
    centres: Float[Tensor, "batch 2"] | None = None,
) -> Shaped[Tensor, "batch channels side side"]:
    """Turn images counter-clockwise about their centres, with linear interpolation, and keep only the disc inside.

    Args:
        pixels: Square images; integers are rounded.
        angles: Angle of each image, radians.
        centres: Points that are turned into the middle of the result (`find_centres`); None: the middle of the image.
    """
    cosine, sine = angles.cos(), angles.sin()
    x, y = (torch.zeros_like(angles),) * 2 if centres is None else centres.to(angles).unbind(1)
    # Rows count downwards: a pixel of the result is read from the image at its position turned clockwise.
    rows = [torch.stack([cosine, -sine, x], -1), torch.stack([sine, cosine, y], -1)]
    grid = functional.affine_grid(torch.stack(rows, 1), list(pixels.shape), align_corners=False)
    values = pixels if pixels.is_floating_point() else pixels.float()
    turned = functional.grid_sample(values, grid.to(values), padding_mode="border", align_corners=False)
    return keep_disc(turned if pixels.is_floating_point() else turned.round().to(pixels.dtype))


def keep_disc(
    pixels: Shaped[Tensor, "batch channels side side"],
) -> Shaped[Tensor, "batch channels side side"]:
    """Set pixels whose centres lie outside the largest disc in the square to 0."""
    side = pixels.shape[-1]
    offset = torch.arange(side, device=pixels.device) - (side - 1) / 2
    inside = offset[:, None].square() + offset.square() <= (side / 2) ** 2
    return pixels * inside
