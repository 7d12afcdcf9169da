"""Data set PASCAL3D+ as labelled crops; framework.data describes the contract."""

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.configuration.paths import FilePath
from framework.data import Batch, Data, Splits
from framework.datasets import given_images, images
from framework.datasets.images import Box, Crop
from framework.errors import DataError, did_you_mean
from framework.renderer import Renderer
from framework.storage import cache
from framework.storage.generated import read_mark
from framework.storage.names import as_bytes
from framework.storage.parsed_files import ParsedFiles
from framework.target import Target
from plugins.data.pascal3d import layout
from plugins.data.pascal3d.generator import VERSION, generate_class
from plugins.data.pascal3d.layout import CLASSES, Annotation, Content

SPLIT_SEED = 13  # the seed of the thesis authors' code
MIRRORED = (-1.0, 1.0, -1.0)
"""Factors by which mirroring an image multiplies the azimuth, elevation and tilt of a mirror-symmetric object."""


class Sample(NamedTuple):
    """One object as a sample.

    Attributes:
        annotation: Annotation of the object.
        group: Index of the object's class among the groups of the data set.
    """

    annotation: Annotation
    group: int


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Choice of the objects.

    Attributes:
        category: The class, or a list of classes.
        include_occluded: Whether training uses truncated and occluded objects too.
        validation_share: Share of the training images that are for validation.
    """

    category: str | list[str] = "car"
    include_occluded: bool = False
    validation_share: Annotated[float, Field(gt=0, lt=1, allow_inf_nan=False)] = 0.2


@dataclass(frozen=True, kw_only=True)
class Framing:
    """Settings of the crop of an object.

    Attributes:
        image_size: Side of the square input, pixels.
        margin: Margin at each side of the box, as a share of the longer side of the box.
    """

    image_size: Annotated[int, Field(ge=8, le=1024)] = 48
    margin: Annotated[float, Field(ge=0, le=2, allow_inf_nan=False)] = 0.1

    def crop(self, annotation: Annotation) -> Crop:
        """Return the settings with which the crop around an annotated object is read from its image."""
        return Crop(annotation.image, annotation.box, self.margin, self.image_size)

    def scale(self, box: Box) -> float:
        """Return the number of pixels of the input per pixel of the image, for a crop around `box` with `margin`."""
        left, top, right, bottom = box
        return self.image_size / ((1 + 2 * self.margin) * max(right - left, bottom - top))


@dataclass(frozen=True, kw_only=True)
class Variation:
    """Random variation of training images.

    Attributes:
        mirror: Whether half of the images are mirrored.
        jitter: Largest share by which images are shifted, scaled and made brighter or darker.
    """

    mirror: bool = True
    jitter: Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False)] = 0.08


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """Settings of the images that are generated if no root is given.

    Attributes:
        images: Number of images of each class.
        generator_seed: Seed of the images.
        renderer: Renderer of the objects.
    """

    images: Annotated[int, Field(ge=20, le=1_000_000)] = 2400
    generator_seed: Annotated[int, Field(ge=0)] = 0
    renderer: Renderer = "rasterizer"  # pyright: ignore[reportAssignmentType]  # built by the framework


class Pascal3D(Data):
    """Rigid objects in photographs and their azimuth, elevation and tilt; generated if no root is given.

    A batch holds the fields that `framework.data.Batch` requires, and "symmetry" (see there), 1 for real objects. For
    generated data it also holds "blur", the standard deviation of the blur (float32, pixels of the input).

    Args:
        root: The unpacked PASCAL3D+_release1.1; None to generate images in the same layout.
        selection: Choice of the objects.
        framing: Settings of the crop of an object.
        skip_unreadable: Whether files that cannot be read are left out and counted; otherwise they are an error.
        variation: Random variation of training images.
        drawing: Settings of the generated images.

    Attributes:
        excluded: Number of objects that the protocol leaves out, by reason; `prepare` sets it.
    """

    bibtex = "xiang2014beyond"
    target = Target("angle", ("azimuth", "elevation", "tilt"))
    directions = ("front", "left side", "back", "right side")

    suffixes = images.SUFFIXES

    def __init__(
        self,
        *,
        root: FilePath | None = None,
        selection: Selection,
        framing: Framing,
        skip_unreadable: bool = False,
        variation: Variation,
        drawing: Drawing,
    ) -> None:
        self.root = root
        category = selection.category
        self.categories = (category,) if isinstance(category, str) else tuple(dict.fromkeys(category))
        self.selection = selection
        self.framing = framing
        self.skip_unreadable = skip_unreadable
        self.variation = variation
        self.varies = variation.mirror or variation.jitter > 0
        self.drawing = drawing
        self.input_shape = (3, framing.image_size, framing.image_size)
        names = self.categories if len(self.categories) < 4 else (f"{len(self.categories)} classes",)
        self.title = " ".join(["pascal3d", *names])

    def check_files(self) -> None:
        if self.root is not None:
            self._roots()

    def prepare(self) -> None:
        roots = self._roots()
        self.groups = tuple(roots)
        self.synthetic = any(read_mark(root) is not None for root in roots.values())
        self.excluded: Counter[str] = Counter()
        faults: list[DataError] = []
        samples: dict[str, list[Sample]] = {"train": [], "validation": [], "test": []}
        for group, (category, root) in enumerate(roots.items()):
            lists = layout.split_lists(category)
            parsed = layout.parsed_annotations(root, category)
            training = list(
                self._select(root, category, lists["train"], self.selection.include_occluded, faults, parsed)
            )
            held_out = validation_files(training, self.selection.validation_share)
            for annotation in training:
                split = "validation" if annotation.file in held_out else "train"
                samples[split].append(Sample(annotation, group))
            test = self._select(root, category, lists["test"], False, faults, parsed)
            samples["test"] += [Sample(annotation, group) for annotation in test]
            parsed.save()
        _refuse_wrong_labels(samples)
        self._read(samples, faults)
        self._digest = _digest(samples)

    def _roots(self) -> dict[str, Path]:
        """Return the root of each class by the name of the class.

        If no root is given, there is one generated root for each class.
        """
        for category in self.categories:
            if category not in CLASSES:
                raise DataError(
                    f"data.category = {category!r} is not a class of PASCAL3D+."
                    f"{did_you_mean(category, CLASSES)} Choose one or more of {', '.join(CLASSES)}."
                )
        if not self.categories:
            raise DataError(f"data.category is empty. Choose one or more of {', '.join(CLASSES)}.")
        if self.root is not None:
            root = Path(self.root).expanduser()
            for category in self.categories:
                layout.check_root(root, category)
            return dict.fromkeys(self.categories, root)
        parent, drawing = cache.folder("pascal3d"), self.drawing
        return {
            category: generate_class(
                parent, category, drawing.images, drawing.generator_seed, drawing.renderer
            )
            for category in self.categories
        }

    def _select(
        self,
        root: Path,
        category: str,
        lists: Sequence[tuple[str, Path]],
        include_occluded: bool,
        faults: list[DataError],
        parsed: ParsedFiles[Content],
    ) -> Iterator[Annotation]:
        """Yield the objects of a split that the protocol uses; add the errors of unreadable files to `faults`."""
        names = [(source, name) for source, file in lists for name in layout.read_list(root / file)]
        for source, name in dict.fromkeys(names):
            try:
                annotations = layout.read_annotations(root, category, source, name, parsed)
            except DataError as error:
                faults.append(error)
                continue
            for annotation in annotations:
                reason = reason_to_exclude(annotation, include_occluded)
                if reason is None:
                    yield annotation
                else:
                    self.excluded[reason] += 1

    def _read(self, samples: Mapping[str, Sequence[Sample]], faults: Sequence[DataError]) -> None:
        """Read the crops of all splits.

        One error names all files that cannot be read: the annotation files in `faults`, and the images of the crops.
        """
        self._tables, self.skipped = images.load_splits(
            {
                split: [self.framing.crop(annotation) for annotation, _ in chosen]
                for split, chosen in samples.items()
            },
            {split: self._fields(chosen) for split, chosen in samples.items()},
            faults,
            skip_unreadable=self.skip_unreadable,
            generated_in=cache.folder("pascal3d") if self.root is None else None,
        )
        for split, table in self._tables.items():
            if len(table) == 0:
                reasons = ", ".join(f"{count} {reason}" for reason, count in self.excluded.items()) or "none"
                raise DataError(
                    f"The {split} split of {', '.join(self.groups)} is empty: none of the objects in its lists is used "
                    f"(left out: {reasons}; unreadable: {self.skipped}). Check the lists, or use other data."
                )

    def _fields(self, samples: Sequence[Sample]) -> dict[str, Tensor]:
        """Return the fields of samples besides "input" and "index"."""
        labels = [[layout.radians(angle) for angle in annotation.angles or ()] for annotation, _ in samples]
        fields = {
            "target": torch.tensor(labels, dtype=torch.float32).reshape(len(samples), 3),
            "group": torch.tensor([group for _, group in samples], dtype=torch.int64),
            "symmetry": torch.tensor([annotation.symmetry for annotation, _ in samples], dtype=torch.int64),
        }
        if self.synthetic:
            blur = [
                self.framing.scale(annotation.box) * (annotation.blur or 0.0) for annotation, _ in samples
            ]
            fields["blur"] = torch.tensor(blur, dtype=torch.float32)
        return fields

    def splits(self) -> Splits:
        return Splits(**self._tables)

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        side = self.framing.image_size
        return images.load_unlabelled([Crop(Path(file), None, 0.0, side, upright=True) for file in files])

    def inputs(self, user_data: Any) -> Tensor:
        return given_images.to_inputs(self, user_data)

    def augment(self, batch: Batch) -> Batch:
        return images.vary(batch, MIRRORED if self.variation.mirror else (), self.variation.jitter)

    def fingerprint(self) -> Mapping[str, str]:
        generated_root = f"synthetic, seed {self.drawing.generator_seed}"
        return {
            "root": generated_root if self.root is None else self.root,
            "version": f"generator {VERSION}" if self.synthetic else "PASCAL3D+ release 1.1",
            **{split: str(len(table)) for split, table in self._tables.items()},
            "sha256": self._digest,
        }

    def preview(self, inputs: Tensor) -> np.ndarray:
        return images.to_rgb8(inputs)


def reason_to_exclude(annotation: Annotation, include_occluded: bool) -> str | None:
    """Return why the protocol leaves an object out; None if it uses the object.

    `include_occluded` says whether truncated and occluded objects are used.
    """
    if annotation.angles is None:
        return "without a fine label"
    if annotation.difficult:
        return "difficult"
    if (annotation.truncated or annotation.occluded) and not include_occluded:
        return "truncated or occluded"
    return None


def validation_files(annotations: Sequence[Annotation], share: float) -> set[Path]:
    """Return the annotation files of the images that are moved from training to validation, a random `share` of all.

    All objects of an image are in the same split.
    """
    files = sorted({annotation.file for annotation in annotations})
    order = np.random.default_rng(SPLIT_SEED).permutation(len(files))
    return {files[index] for index in order[: round(share * len(files))]}


def _refuse_wrong_labels(samples: Mapping[str, Sequence[Sample]]) -> None:
    wrong = [
        f"{annotation.file}: azimuth, elevation, theta = {annotation.angles}"
        for chosen in samples.values()
        for annotation, _ in chosen
        if not np.isfinite(annotation.angles or ()).all()
    ]
    images.refuse_listed(
        wrong,
        "objects have an angle that is not a finite number of degrees",
        "Correct these annotations, or remove the images from their lists.",
    )


def _digest(samples: Mapping[str, Sequence[Sample]]) -> str:
    """Return a hash of the names, boxes and labels of every split."""
    digest = hashlib.sha256()
    for split, chosen in samples.items():
        for annotation, _ in chosen:
            line = f"{split} {annotation.image.name} {annotation.box} {annotation.angles}\n"
            digest.update(as_bytes(line))
    return digest.hexdigest()
