"""Data set of labelled scans, whose samples are points; framework.data describes the contract."""

import hashlib
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.configuration.paths import FilePath, Words
from framework.data import Batch, Data, Splits
from framework.datasets import images
from framework.datasets.class_names import compare_classes
from framework.datasets.cloud_picture import draw_cloud
from framework.datasets.fields import FetchedInBatches
from framework.datasets.new_files import (
    TestShare,
    Trained,
    are_all_for_test,
    describe_tested_share,
    hash_contents,
    hash_files,
    leave_out_trained,
    restore_trained,
)
from framework.errors import DataError, count_of
from framework.geometry.meshes import stream
from framework.storage.names import as_bytes, spell_name
from framework.storage.progress import track_progress
from framework.target import Target
from plugins.data.labelled_points.features import (
    POSITION,
    Bases,
    Features,
    Scan,
    check_reach,
    draw_bases,
    local_features,
    scan_code,
)
from plugins.data.labelled_points.scans import (
    LAYOUT,
    SUFFIXES,
    Classes,
    LabelledScan,
    choose_classes,
    divide_scans,
    list_scans,
    read_labelled,
    read_points,
)

Seed = Annotated[int, Field(ge=0, lt=2**31)]


class Scaling(NamedTuple):
    """Basis points, and scaling of the features; a trained model needs them to read further scans.

    Attributes:
        bases: Basis points.
        location: Mean of each feature over the points for training.
        scale: Standard deviation of each feature, above 0.
    """

    bases: Bases
    location: Float[np.ndarray, "features"]
    scale: Float[np.ndarray, "features"]

    def local(self, values: Float[np.ndarray, "rows local"]) -> Float32[Tensor, "rows local"]:
        """Return standardised features that differ between the points of a scan."""
        count = values.shape[1]
        return torch.from_numpy(((values - self.location[:count]) / self.scale[:count]).astype(np.float32))

    def code(self, scans: Sequence[Scan]) -> Float32[Tensor, "scans basis"]:
        """Return the standardised distances from the basis points to each scan."""
        length = len(self.bases.whole)
        codes = np.array([scan_code(scan, self.bases) for scan in scans]).reshape(len(scans), length)
        start = len(self.location) - length
        return torch.from_numpy(((codes - self.location[start:]) / self.scale[start:]).astype(np.float32))


class Points(FetchedInBatches):
    """Points of scans, whose features are computed when they are fetched or, if `stored` is true, once.

    Args:
        scans: The scans.
        rows: Indices of the points of each scan.
        features: Settings of the features.
        scaling: Basis points, and scaling of the features.
        labels: Class of each point in `rows`; None: the points have no label.
        stored: Whether the features are kept in memory; this is faster if the points are fetched more than once.
    """

    def __init__(
        self,
        scans: Sequence[Scan],
        rows: Sequence[Int[np.ndarray, "_rows"]],
        features: Features,
        scaling: Scaling,
        labels: Sequence[Int[np.ndarray, "_rows"]] | None = None,
        *,
        stored: bool = False,
    ) -> None:
        self.scans, self.features, self.scaling = scans, features, scaling
        nothing = np.zeros(0, np.int64)
        self.row = np.concatenate([nothing, *rows])
        self.scan = np.repeat(np.arange(len(scans)), [len(part) for part in rows])
        self.label = None if labels is None else torch.from_numpy(np.concatenate([nothing, *labels]))
        self.code = scaling.code(scans)
        self.local = self._local(np.arange(len(self.row))) if stored else None

    def __len__(self) -> int:
        return len(self.row)

    def __getitems__(self, indices: Sequence[int]) -> Batch:
        chosen = np.asarray(indices, np.int64)
        place = torch.from_numpy(chosen)
        scan = torch.from_numpy(self.scan[chosen])
        local = self._local(chosen) if self.local is None else self.local[place]
        batch = {"input": torch.cat([local, self.code[scan]], 1), "index": place}
        if self.label is None:
            return batch
        group = torch.zeros(len(place), dtype=torch.int64)
        return {**batch, "target": self.label[place], "group": group, "scan": scan}

    def _local(self, chosen: Int[np.ndarray, "rows"]) -> Float32[Tensor, "rows local"]:
        """Return the standardised features of the samples `chosen` that differ between the points of a scan."""
        table = np.empty((len(chosen), len(self.features.local_names)))
        for number in np.unique(self.scan[chosen]):
            in_scan = self.scan[chosen] == number
            rows = self.row[chosen[in_scan]]
            table[in_scan] = local_features(self.scans[number], rows, self.features, self.scaling.bases)
        return self.scaling.local(table)


class _Prepared(NamedTuple):
    """Content of the folder; `LabelledPoints` describes the parts."""

    classes: tuple[str, ...]
    scaling: Scaling
    splits: Splits
    fingerprint: dict[str, str]
    remarks: tuple[str, ...]
    own: Trained
    labels: Int[np.ndarray, "classes"]


class LabelledPoints(Data):
    """Scans in which every point has a class; a sample is one point, described by its neighbours and by its scan.

    An input is a vector of named features (`Data.columns`), standardised over the training points: the position of the
    point in its scan, the offsets and distances of its nearest points, distances from basis points around it, and
    distances from basis points of the whole scan. The last ones are the same for all points of a scan (thesis §8.2).
    Scans are divided into splits as wholes. Batches also hold "scan", int64, the number of the scan in its split.

    Args:
        root: The folder of the scans.
        label: Name of the column or array of the labels.
        classes: Names of the labels 0, 1, 2, …; None: each label of the training scans is a class.
        unlabelled: Labels of points without a class. They are no samples, but they count as neighbours of other points.
        points: Largest number of points of a scan in training and validation, drawn at random. The test has all points.
        features: Settings of the features.
        validation: Share of the scans for validation, if there are no folders of splits; at least one scan. With 0,
            the training points are also used for validation.
        test: Share of the scans for the test, if there are no folders of splits; at least one scan. 1 makes all scans
            test scans, for a model that was trained on other scans.
        data_seed: Seed of points, basis points and splits, independent of the seed of the run.
    """

    bibtex = "prokudin2019efficient"
    groups = ("labelled_points",)
    suffixes = SUFFIXES
    varies = False
    synthetic = False

    # More than seven parameters: each keyword is a config key that a user sets alone.
    def __init__(
        self,
        *,
        root: FilePath | None = None,
        label: Words = "label",
        classes: list[Words] | None = None,
        unlabelled: list[int] | None = None,
        points: Annotated[int, Field(ge=1, le=100_000_000)] = 2048,
        features: Features,
        validation: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = 0.15,
        test: TestShare = 0.15,
        data_seed: Seed = 0,
    ) -> None:
        self.root, self.label, self.points = root, label, points
        self.classes = None if classes is None else tuple(classes)
        self.unlabelled = tuple(unlabelled or ())
        self.features = features
        self.shares = (validation, test)
        self.data_seed = data_seed
        self.columns = features.names
        self._trained: Scaling | None = None
        self._trained_on: Trained | None = None
        self._trained_labels: NDArray | None = None

    def prepare(self) -> None:
        prepared = self._prepared
        self.title = Path(self.root or "").expanduser().resolve().name
        self.target = Target("class", tuple(map(spell_name, prepared.classes)))
        self.input_shape = (len(self.columns),)
        self.remarks = prepared.remarks

    @cached_property
    def _prepared(self) -> _Prepared:
        if self.root is None:
            raise DataError(f"data.root is not set. {LAYOUT}")
        root, seed = Path(self.root).expanduser(), self.data_seed
        is_trained = self._trained is not None
        listed = list_scans(root, test_only=is_trained)
        files = listed.files
        paths = [file.relative_to(root).as_posix() for file in files]
        content = hash_files(root, paths, [""] * len(files))
        if are_all_for_test(listed.splits, self.shares[1], self._seen_files, content, root):
            splits = np.full(len(files), "test")
        else:
            splits = divide_scans(listed, root, *self.shares, stream(seed, "splits"))
        hashes = hash_contents(files)
        splits, left_out = leave_out_trained(listed.splits, splits, hashes, self._seen_files, content, root)
        labelled = self._read_all(files)
        validated_on = "validation" if self.shares[0] or "validation" in splits else "train"
        numbers = {
            name: np.flatnonzero(splits == (validated_on if name == "validation" else name))
            for name in Splits._fields
        }
        classes = self._classes_of([scan for scan, _ in labelled], files, numbers["train"])
        names, labels = classes
        chosen = {
            name: [self._choose(labelled[i][0], files[i], labels, every=name == "test") for i in part]
            for name, part in numbers.items()
        }
        for name, rows in chosen.items():
            if not sum(map(len, rows)) and (name == "test" or not is_trained):
                raise DataError(
                    f"{root}: no point of the {name} split has a class, because data.unlabelled = "
                    f"{list(self.unlabelled)} names all their labels. Add scans, or correct data.unlabelled."
                )
        scans = {name: [labelled[i][1] for i in part] for name, part in numbers.items()}
        if self._trained is None:
            check_reach(scans["train"], chosen["train"], self.features)
        scaling = self._trained or _fit_scaling(scans["train"], chosen["train"], self.features, seed)
        datasets = {
            name: Points(
                scans[name],
                chosen[name],
                self.features,
                scaling,
                [
                    np.searchsorted(labels, labelled[i][0].labels[rows])
                    for i, rows in zip(part, chosen[name], strict=True)
                ],
                stored=name != "test",
            )
            for name, part in numbers.items()
        }
        digest = hashlib.sha256()
        for file, split, (scan, _) in zip(files, splits, labelled, strict=True):
            digest.update(as_bytes(f"{split} {file.relative_to(root).as_posix()}\n"))
            digest.update(np.ascontiguousarray(scan.points).tobytes() + scan.labels.tobytes())
        fingerprint = {
            "root": str(self.root),
            "version": "labelled_points 1",
            "classes": ", ".join(f"{label} {name}" for label, name in zip(labels, names, strict=True)),
            "points": f"{self.points}, seed {seed}",
            "features": str(self.features),
            **{name: f"{len(datasets[name])} points of {len(scans[name])} scans" for name in Splits._fields},
            "sha256": digest.hexdigest(),
        }
        remarks = [
            *compare_classes(names, f"data.classes = {list(names)}"),
            *describe_tested_share(listed.splits, splits, self._seen_files, content, root),
            *left_out,
        ]
        if listed.ignored:
            remarks.append(f"left out: {count_of(listed.ignored, 'file')} of other kinds")
        without = sum(int(np.isin(scan.labels, self.unlabelled).sum()) for scan, _ in labelled)
        if without:
            remarks.append(f"left out, except as neighbours: {count_of(without, 'point')} without a class")
        own = Trained.on(content, names, hashes, splits)
        return _Prepared(names, scaling, Splits(**datasets), fingerprint, tuple(remarks), own, labels)

    @property
    def _seen_files(self) -> Trained | None:
        """Return what a trained model stores about its scans; None without a trained model."""
        return None if self._trained is None else self._trained_on or Trained()

    def _classes_of(
        self, scans: Sequence[LabelledScan], files: Sequence[Path], training: Int[np.ndarray, "scans"]
    ) -> Classes:
        """Return the classes of the trained model or, without one, those of the scans with the indices `training`."""
        sources = [str(file) for file in files]
        if self._trained_on is None or self._trained_labels is None:
            if not len(training):
                raise DataError(
                    f"{self.root} holds no scans for training, from which the classes could be read, and an older "
                    "version stored the model without its classes. Train the model again."
                )
            return choose_classes(scans, sources, training.tolist(), self.classes, self.unlabelled)
        classes = Classes(self._trained_on.classes, self._trained_labels)
        classes.require_known(scans, sources, self.unlabelled)
        return classes

    def _read_all(self, files: Sequence[Path]) -> list[tuple[LabelledScan, Scan]]:
        """Return the labelled points of each file, and the scan that finds their neighbours."""
        labelled, faults = [], []
        for file in track_progress(files, "reading scans", len(files), "files"):
            try:
                scan = read_labelled(file, self.label)
                labelled.append((scan, Scan(scan.points, str(file), self.features.neighbours)))
            except DataError as error:
                faults.append(error)
        if faults:
            remedy = "Correct these files, copy them again from their source, or move them out of the folder."
            raise DataError(images.fault_message(faults, len(files), remedy))
        return labelled

    def _choose(
        self, scan: LabelledScan, file: Path, labels: Int[np.ndarray, "classes"], *, every: bool
    ) -> Int[np.ndarray, "rows"]:
        """Return the indices of the points of a scan that are samples, ascending."""
        rows = np.flatnonzero(np.isin(scan.labels, labels))
        if every or len(rows) <= self.points:
            return rows
        return np.sort(stream(self.data_seed, file.name).choice(rows, self.points, replace=False))

    def check_files(self) -> None:
        if self.root is None:
            raise DataError(f"data.root is not set. {LAYOUT}")
        root = Path(self.root).expanduser()
        listed = list_scans(root, test_only=self._trained is not None)
        if self.shares[1] < 1:
            divide_scans(listed, root, *self.shares, stream(self.data_seed, "splits"))
        read_labelled(listed.files[0], self.label)

    def splits(self) -> Splits:
        return self._prepared.splits

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        """Return all points of the scans, file by file, in the order of the files; labels are not read."""
        if not files:
            raise DataError(f"No file was given. Give at least one scan of {', '.join(SUFFIXES)}.")
        scans, faults = [], []
        for file in files:
            try:
                scans.append(Scan(read_points(Path(file)), str(file), self.features.neighbours))
            except DataError as error:
                faults.append(error)
        if faults:
            remedy = "Leave them out, or copy them again from their source."
            raise DataError(images.fault_message(faults, len(files), remedy))
        rows = [np.arange(len(scan.points)) for scan in scans]
        return Points(scans, rows, self.features, self._scaling)

    @property
    def _scaling(self) -> Scaling:
        # before training nothing is stored; the training scans provide it
        return self._trained or self._prepared.scaling

    def state_dict(self) -> Mapping[str, Any]:
        bases, location, scale = self._scaling
        parts = {"around": bases.around, "whole": bases.whole, "location": location, "scale": scale}
        state: dict[str, Any] = {name: torch.from_numpy(part.copy()) for name, part in parts.items()}
        if self._trained is None:
            files, labels = self._prepared.own, self._prepared.labels
        else:  # a model that an older version stored has neither
            files, labels = self._trained_on, self._trained_labels
        if files is not None and labels is not None:
            state |= {**files.state(), "labels": labels.tolist()}
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        if not state:
            return
        shapes = {
            "around": (self.features.surrounding_points, 3),
            "whole": (self.features.basis_points, 3),
            "location": (len(self.columns),),
            "scale": (len(self.columns),),
        }
        parts = {}
        for name, shape in shapes.items():
            part = state.get(name)
            array = part.detach().cpu().double().numpy() if isinstance(part, Tensor) else None
            if array is None or array.shape != shape or not np.isfinite(array).all():
                raise DataError(
                    f"The stored state of labelled_points must hold {name}, {'×'.join(map(str, shape))} finite "
                    "numbers, but holds something else. Load another checkpoint, or leave out settings of the features "
                    "(data.neighbours, data.surrounding_points, data.basis_points), which a trained model fixes."
                )
            parts[name] = array
        if (parts["scale"] <= 0).any():
            raise DataError(
                "The stored state of labelled_points holds a scale that is not above 0. Load another checkpoint, or "
                "train the model again."
            )
        files = restore_trained(
            {name: state[name] for name in Trained._fields if name in state}, "labelled_points"
        )
        labels = state.get("labels", [])
        are_labels = isinstance(labels, list) and all(isinstance(label, int) for label in labels)
        if not are_labels or len(labels) != len(files.classes) or sorted(set(labels)) != labels:
            raise DataError(
                "The stored state of labelled_points must hold one label for each class, in ascending order, but holds "
                "something else. Load another checkpoint, or train the model again."
            )
        self._trained_on = files if labels else None
        self._trained_labels = np.array(labels, np.int64) if labels else None
        self._trained = Scaling(Bases(parts["around"], parts["whole"]), parts["location"], parts["scale"])
        vars(self).pop("_prepared", None)

    def augment(self, batch: Batch) -> Batch:
        return batch

    def fingerprint(self) -> Mapping[str, str]:
        return self._prepared.fingerprint

    def preview(self, inputs: Tensor) -> np.ndarray:
        """Return an image of the point and its neighbours, or of its position if it has no neighbours."""
        scaling, count = self._scaling, self.features.neighbours
        values = inputs.detach().cpu().double().numpy() * scaling.scale + scaling.location
        start = len(POSITION)
        offsets = values[start : start + 3 * count].reshape(count, 3)
        return draw_cloud(torch.from_numpy(np.concatenate([np.zeros((1, 3)), offsets])))


def _fit_scaling(
    scans: Sequence[Scan], rows: Sequence[Int[np.ndarray, "_rows"]], features: Features, seed: int
) -> Scaling:
    """Return basis points in the box of the training scans, and the scaling of the features of the training points.

    All basis points of the whole scan have one common scaling, because there are few scans. A feature that is constant
    is not divided.
    """
    extents = np.stack(
        [
            np.min([scan.points.min(0) for scan in scans], axis=0),
            np.max([scan.points.max(0) for scan in scans], axis=0),
        ]
    )
    bases = draw_bases(features, extents, stream(seed, "basis points"))
    parts = [
        local_features(scan, part, features, bases)
        for scan, part in zip(scans, rows, strict=True)
        if len(part)
    ]
    table = np.concatenate(parts)
    location, scale = table.mean(0), table.std(0)
    code = np.stack([scan_code(scan, bases) for scan in scans])
    if code.size:
        location = np.concatenate([location, np.full(code.shape[1], code.mean())])
        scale = np.concatenate([scale, np.full(code.shape[1], code.std())])
    constant = scale <= 1e-9 * np.maximum(np.abs(location), np.finfo(np.float64).tiny)
    return Scaling(bases, location, np.where(constant, 1.0, scale))
