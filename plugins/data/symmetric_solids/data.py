"""Data set of symmetric solids in random rotations; framework.data describes the contract."""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.data import Batch, Data, Splits
from framework.datasets import given_images, images
from framework.datasets.fields import Fields
from framework.datasets.images import Crop
from framework.errors import ConfigError, DataError, did_you_mean
from framework.geometry import quaternions
from framework.geometry.symmetry import (
    GROUPS,
    draw_members,
    draw_noise,
    log_blurred,
    noise_concentration,
)
from framework.renderer import Renderer
from framework.storage import arrays, cache
from framework.storage.reading import read_bytes, translate_errors
from framework.target import Target
from plugins.data.symmetric_solids.generator import VERSION, ensure_solid, stream
from plugins.data.symmetric_solids.solids import SOLIDS, solid

Count = Annotated[int, Field(ge=1, le=1_000_000)]


@dataclass(frozen=True, kw_only=True)
class Counts:
    """Number of images of each solid in each split."""

    train: Count = 5000
    validation: Count = 500
    test: Count = 500


class SymmetricSolids(Data):
    """Grey images of symmetric solids in uniformly random rotations, with labels of known density; generated.

    The images are those of SYMSOL I (Murphy et al. 2021), drawn small. An image shows the rotation R of its solid only
    up to the group G of rotations that leave the solid unchanged. The label of an image is R g N, where g is drawn
    uniformly from G, and N is a random rotation of known density. The exact density of the label given the image is
    therefore known.

    Further fields of a batch are "symmetry_group" (int64, an index into `framework.geometry.symmetry.GROUPS`),
    "true_rotation" (float64, (batch, 4), the quaternion of R) and, if labels are noisy, "true_log_density" (float64,
    the exact log-density of the label given the image, nats, with respect to the rotation-invariant measure of total
    mass 1). With each training batch, `augment` draws new labels.

    Args:
        solids: names of the solids.
        counts: number of images of each solid in each split.
        image_size: side of the images, pixels.
        label_noise_deg: standard deviation of N about each axis, degrees.
        data_seed: seed of the rotations and labels, independent of the seed of the run.
        renderer: draws the images.

    Raises:
        ConfigError: a solid is unknown or given twice; or the renderer draws no colours.
    """

    bibtex = "murphy2021implicit"
    target = Target("angle", ("azimuth", "elevation", "tilt"))
    suffixes = images.SUFFIXES
    synthetic = True

    def __init__(
        self,
        *,
        solids: Annotated[list[str], Field(min_length=1)] = ["tetrahedron", "cube", "cone", "cylinder"],  # noqa: B006 - never written
        counts: Counts,
        image_size: Annotated[int, Field(ge=8, le=224)] = 32,
        label_noise_deg: Annotated[float, Field(ge=0, le=60, allow_inf_nan=False)] = 10.0,
        data_seed: Annotated[int, Field(ge=0, lt=2**31)] = 0,
        renderer: Renderer = "rasterizer",  # pyright: ignore[reportArgumentType]  # built by the framework
    ) -> None:
        for name in solids:
            if name not in SOLIDS:
                raise ConfigError(
                    f"data.solids has {name!r}, which is no known solid.{did_you_mean(name, SOLIDS)} Choose from "
                    f"{', '.join(SOLIDS)}."
                )
        if len(set(solids)) < len(solids):
            raise ConfigError(f"data.solids = {', '.join(solids)} names a solid twice. Name each solid once.")
        if "color" not in renderer.channels:
            raise ConfigError(
                f"data.renderer = {type(renderer).__name__} does not draw the channel `color`. Choose another "
                "renderer, such as rasterizer."
            )
        if 0 < label_noise_deg < 0.1:
            raise ConfigError(
                f"data.label_noise_deg = {label_noise_deg:g} is above 0 but below 0.1. Images of at most 224 pixels "
                "are too coarse to read rotations so exactly. Give 0 for exact labels, or at least 0.1 degrees."
            )
        self.groups = tuple(solids)
        self.counts = asdict(counts)
        self.input_shape = (1, image_size, image_size)
        self.concentration = noise_concentration(math.radians(label_noise_deg)) if label_noise_deg else None
        self.noise_deg = label_noise_deg
        self.varies = label_noise_deg > 0 or any(solid(name).group != "none" for name in solids)
        self.data_seed = data_seed
        self.renderer = renderer

    def prepare(self) -> None:
        self.skipped = 0
        parent = cache.folder("symmetric_solids")
        size = self.input_shape[-1]
        folders = [
            ensure_solid(parent, name, self.counts, size, self.data_seed, self.renderer)
            for name in self.groups
        ]
        self._tables = [self._table(folders, number) for number in range(len(Splits._fields))]

    def _table(self, folders: Sequence[Path], number: int) -> Fields:
        """Return the samples of split `number`, the solids one after another."""
        split = Splits._fields[number]
        pixels = [_read(folder / f"{split}_images.npy", np.uint8) for folder in folders]
        turns = [_read(folder / f"{split}_rotations.npy", np.float64) for folder in folders]
        fields: dict[str, list[Tensor]] = {}
        for group, (name, turn) in enumerate(zip(self.groups, turns, strict=True)):
            symmetry = torch.full((len(turn),), GROUPS.index(solid(name).group))
            labels = self._labels(turn, symmetry, stream(self.data_seed, name, number, 1))
            more = {
                "true_rotation": turn,
                "symmetry_group": symmetry,
                "group": torch.full_like(symmetry, group),
            }
            for key, values in (labels | more).items():
                fields.setdefault(key, []).append(values)
        table = {key: torch.cat(parts) for key, parts in fields.items()}
        return Fields(input=torch.cat(pixels), index=torch.arange(len(table["group"])), **table)

    def _labels(
        self, turns: Tensor, symmetry: Tensor, generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """Return random labels, "target", of solids in the rotations `turns`, and their log-density."""
        turns = turns.double()
        labels, log_density = turns.clone(), turns.new_zeros(len(turns))
        for index in symmetry.unique().tolist():
            rows, group = (symmetry == index).nonzero().flatten(), GROUPS[index]
            members = draw_members(len(rows), group, generator).to(turns)
            label = quaternions.product(turns[rows], members)
            if self.concentration is not None:
                noise = draw_noise(len(rows), self.concentration, generator).to(turns)
                label = quaternions.product(label, noise)
                density = log_blurred(turns[rows], label, group, self.concentration)
                log_density = log_density.index_copy(0, rows, density)
            labels = labels.index_copy(0, rows, label)
        fields = {"target": quaternions.to_viewpoint(labels).float()}
        return fields if self.concentration is None else {**fields, "true_log_density": log_density}

    def splits(self) -> Splits:
        return Splits(*self._tables)

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        size = self.input_shape[-1]
        return images.load_unlabelled([Crop(Path(file), None, 0.0, size, 1, upright=True) for file in files])

    def inputs(self, user_data: Any) -> Tensor:
        return given_images.to_inputs(self, user_data)

    def augment(self, batch: Batch) -> Batch:
        labels = self._labels(batch["true_rotation"].cpu(), batch["symmetry_group"].cpu())
        return {**batch, **{name: values.to(batch[name]) for name, values in labels.items()}}

    def fingerprint(self) -> Mapping[str, str]:
        digest = hashlib.sha256()
        for table in self._tables:
            for name in ("input", "target", "group"):
                digest.update(table.fields[name].numpy().tobytes())
        return {
            "root": f"synthetic, seed {self.data_seed}",
            "version": f"generator {VERSION}",
            "solids": " ".join(self.groups),
            "label_noise_deg": f"{self.noise_deg:g}",
            **{split: str(len(table)) for split, table in zip(Splits._fields, self._tables, strict=True)},
            "sha256": digest.hexdigest(),
        }

    def preview(self, inputs: Tensor) -> np.ndarray:
        return images.to_rgb8(inputs)


def _read(file: Path, dtype: type) -> Tensor:
    """Return a generated array.

    Raises:
        DataError: the file is missing or damaged, or holds numbers of another type.
    """
    remedy = f"Delete the folder {file.parent}; its data are then generated again."
    with translate_errors(file, "an array of generated data", remedy):
        array = arrays.read_npy(read_bytes(file))
    if array.dtype != dtype:
        raise DataError(
            f"{file}: holds numbers of type {array.dtype}, but {np.dtype(dtype)} is expected. {remedy}"
        )
    return torch.from_numpy(array)
