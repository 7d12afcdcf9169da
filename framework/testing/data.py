"""The contract of a data set: one function a property, each reporting the worst case it saw."""

import hashlib
import math
import pickle
import random
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import Tensor

from framework.data import Batch, Data
from framework.datasets.fields import fetched
from framework.target import Target
from framework.testing.data_files import (
    damaged_files,
    damaged_own_files,
    left_out,
    missing_root,
    own_files,
    raw_input,
    read_back,
)
from framework.testing.data_folders import Build, Workbench, cache_in
from framework.testing.data_samples import (
    equal_fields,
    equal_splits,
    few,
    fits,
    parts,
    samples,
    trimmed,
)
from framework.testing.finding import SEED, Finding, Worst, examined
from framework.testing.rows import DataRow

Check = Callable[[Workbench, Worst], None]
NEEDED = ("input", "target", "index", "group")
MINUTES = 5.0
"""Of processor time that a check may take: it may generate the data anew."""


def examine_data(row: DataRow, build: Build) -> Iterator[Finding]:
    """Every property of one data set; where it cannot be prepared, nothing but that."""
    with TemporaryDirectory() as scratch:
        bench = Workbench(row, build, Path(scratch))
        checks: dict[str, tuple[float, Check]] = {
            "attributes": (0.0, _attributes),
            "constructor reads nothing": (0.0, _constructor),
            "samples": (0.0, _samples),
            "angles are radians": (2 * math.pi, _radians),
            "no sample in two splits": (0.0, _disjoint),
            "same data, same bits": (0.0, _repeatable),
            "one by one or at once": (0.0, _fetching),
            "fingerprint": (0.0, _fingerprint),
            "synthetic is said": (0.0, _synthetic),
            "pictures": (0.0, _pictures),
            "augment": (0.0, _augment),
            "workers": (0.0, _workers),
            "official layout read back": (0.0, read_back),
            "missing root": (0.0, missing_root),
            "damaged files are named": (0.0, damaged_files),
            "files left out are counted": (0.0, left_out),
            "own files": (0.0, own_files),
            "raw input": (0.0, raw_input),
            "damaged own files are named": (0.0, damaged_own_files),
        }
        for name, (limit, check) in checks.items():
            if name in row.leave_out or not _applies(name, bench):
                continue
            yield examined(
                name,
                row.limits.get(name, limit),
                lambda worst, check=check: check(bench, worst),
                seconds=60 * MINUTES,
            )
            if "data" not in vars(bench):
                return


def _applies(name: str, bench: Workbench) -> bool:
    """Whether the row gives what a check needs, or the data set has what it looks at."""
    row = bench.row
    match name:
        case "angles are radians":
            return getattr(getattr(bench.data, "target", None), "kind", None) == "angle"
        case "synthetic is said":
            return row.synthetic is not None
        case "official layout read back":
            return bench.generated is not None
        case "missing root":
            return bool(bench.says_where)
        case "damaged files are named":
            return bool(row.fragile)
        case "files left out are counted":
            return bool(row.skip)
        case "own files" | "damaged own files are named":
            return row.files is not None
    return True


def _attributes(bench: Workbench, worst: Worst) -> None:
    """What the contract lists is set by `prepare`, each of the right kind."""
    data = bench.data
    columns, shape = data.columns, data.input_shape
    worst.same("target is a Target", isinstance(data.target, Target), True)
    worst.count(not _whole(shape) or not all(shape), f"input_shape {shape}; wanted numbers above 0")
    worst.count(not _names(data.groups) or not data.groups, f"groups {data.groups}; wanted names, each once")
    worst.count(not _names(columns), f"columns {columns}; wanted names, each once")
    worst.count(
        bool(columns) and len(columns) != shape[-1], f"{len(columns)} columns of inputs of shape {shape}"
    )
    worst.same("synthetic", type(data.synthetic), bool)
    worst.same("varies", type(data.varies), bool)
    worst.count(not _whole((data.skipped,)), f"skipped {data.skipped!r}; wanted a number from 0")
    if bench.row.synthetic is not None:  # a row's own files are whole
        worst.same("skipped", data.skipped, 0)
    worst.same("bibtex", type(data.bibtex), str)
    for name, split in parts(data).items():
        worst.count(not len(split), f"the {name} split is empty")


def _whole(numbers: Any) -> bool:
    return isinstance(numbers, tuple) and all(type(number) is int and number >= 0 for number in numbers)


def _names(names: Any) -> bool:
    words = isinstance(names, tuple) and all(isinstance(name, str) for name in names)
    return words and len(set(names)) == len(names)


def _constructor(bench: Workbench, worst: Worst) -> None:
    """It can be built where its files are not there yet, and where nothing can be generated."""
    place = bench.place()
    away = place.files.rename(place.files.with_name("away"))
    no_folder = place.files.with_name("no folder")
    no_folder.touch()
    with cache_in(no_folder):
        data = bench.built(place)
    away.rename(place.files)
    with cache_in(place.cache):
        data.prepare()
    worst.same("prepared afterwards: target", data.target, bench.data.target)


def _samples(bench: Workbench, worst: Worst) -> None:
    data = bench.data
    for name, split in parts(data).items():
        for number, sample in samples(split):
            _sample(data, sample, number, f"{name} {number}", worst)


def _sample(data: Data, sample: Any, number: int, where: str, worst: Worst) -> None:
    strange = {key: type(value) for key, value in sample.items() if not isinstance(value, Tensor)}
    missing = [key for key in NEEDED if key not in sample]
    worst.same(f"{where}: fields that are no tensors", strange, {})
    worst.same(f"{where}: fields missing", missing, [])
    if strange or missing:
        return
    inputs, target = sample["input"], sample["target"]
    shape = tuple(inputs.shape)
    worst.count(not fits(shape, data.input_shape), f"{where}: input of {shape}, wanted {data.input_shape}")
    known = inputs.is_floating_point() or inputs.dtype == torch.uint8
    worst.count(not known, f"{where}: input of {inputs.dtype}, wanted a float or bytes")
    worst.finite(f"{where}: input", trimmed(inputs))
    _target(data, target, where, worst)
    for key in ("index", "group"):
        worst.same(f"{where}: {key}", (sample[key].dtype, tuple(sample[key].shape)), (torch.int64, ()))
    worst.same(f"{where}: index", int(sample["index"]), number)
    group = int(sample["group"])
    worst.count(not 0 <= group < len(data.groups), f"{where}: group {group} of {len(data.groups)}")


def _target(data: Data, target: Tensor, where: str, worst: Worst) -> None:
    kind, names = data.target.kind, data.target.names
    if kind == "class":
        worst.same(f"{where}: target", (target.dtype, tuple(target.shape)), (torch.int64, ()))
        worst.count(
            (target < 0) | (target >= len(names)), f"{where}: class {target.tolist()} of {len(names)}"
        )
        return
    worst.same(f"{where}: target", tuple(target.shape), data.target.event_shape)
    worst.count(not target.is_floating_point(), f"{where}: target of {target.dtype}, wanted a float")
    worst.finite(f"{where}: target", target)


def _radians(bench: Workbench, worst: Worst) -> None:
    """Angles beyond a turn are most likely degrees."""
    for name, split in parts(bench.data).items():
        for number, sample in samples(split):
            worst.see(sample["target"].abs().max(), f"{name} {number}: {sample['target'].tolist()}")


def _disjoint(bench: Workbench, worst: Worst) -> None:
    """No input with its target is in two splits."""
    seen: dict[bytes, str] = {}
    for name, split in parts(bench.data).items():
        own = {}
        for number, sample in samples(split):
            target = sample["target"]
            # training targets may be kept in half precision
            rounded = target.half() if target.is_floating_point() else target
            content = hashlib.sha256(trimmed(sample["input"]).numpy().tobytes() + rounded.numpy().tobytes())
            own[content.digest()] = f"{name} {number}"
        worst.count(not own, f"{name} is empty")
        for content, where in own.items():
            worst.count(content in seen, f"{where} is {seen.get(content)} again")
        seen |= own


def _repeatable(bench: Workbench, worst: Worst) -> None:
    """Two preparations in two places, after other random numbers, give the same samples, and so do two looks."""
    torch.manual_seed(SEED + 7)
    np.random.seed(SEED + 7)  # noqa: NPY002 - the global generator is the point
    random.seed(SEED + 7)
    again = bench.prepared(bench.place())
    worst.same("target", again.target, bench.data.target)
    equal_splits(again, bench.data, "another preparation", worst)
    equal_splits(bench.data, bench.data, "a second look", worst)


def _fetching(bench: Workbench, worst: Worst) -> None:
    """A fetched batch holds the single samples, in whatever order they are asked for."""
    for name, split in parts(bench.data).items():
        order = few(len(split), 24)
        shuffled = np.random.default_rng(SEED).permutation(order).tolist()
        for what, asked in {
            "in order": order,
            "shuffled": shuffled,
            "one twice": [*order[-2:], *order[-2:]],
        }.items():
            batch = fetched(split, asked)
            for row, number in enumerate(asked):
                single = split[number]
                where = f"{name} {number}, {what}"
                worst.same(f"{where}: fields", sorted(batch), sorted(single))
                for key in set(batch) & set(single):
                    # clouds of a batch are padded to the largest
                    whole = key == "input" and single[key].dim() == 2
                    found = trimmed(batch[key][row]) if whole else batch[key][row]
                    worst.same_bits(f"{where}: {key}", found, trimmed(single[key]) if whole else single[key])


def _fingerprint(bench: Workbench, worst: Worst) -> None:
    found = _words(bench.data, worst)
    worst.same("of the same data again", _words(bench.prepared(bench.first), worst), found)
    for key, value in bench.row.changes.items():
        other = bench.prepared(bench.first, **{key: value})
        worst.count(_words(other, worst) == found, f"the same with {key} = {value}")


def _words(data: Data, worst: Worst) -> dict[str, str]:
    found: Mapping[str, str] = data.fingerprint()
    strange = {key: value for key, value in found.items() if not (type(key) is type(value) is str)}
    worst.same("entries that are not text to text", strange, {})
    worst.count(not found, "it is empty")
    return dict(found)


def _synthetic(bench: Workbench, worst: Worst) -> None:
    worst.same("synthetic", bench.data.synthetic, bench.row.synthetic)


def _pictures(bench: Workbench, worst: Worst) -> None:
    for name, split in parts(bench.data).items():
        for number in few(len(split), 3):
            inputs = split[number]["input"]
            before = inputs.clone()
            drawn = bench.data.picture(inputs)
            shape, where = np.shape(drawn), f"picture of {name} {number}"
            worst.same(f"{where}: numbers", getattr(drawn, "dtype", type(drawn)), np.dtype(np.uint8))
            worst.count(
                len(shape) != 3 or shape[2] != 3 or 0 in shape, f"{where}: {shape}, wanted (height, width, 3)"
            )
            worst.same_bits(f"{where}: the input afterwards", inputs, before)


def _augment(bench: Workbench, worst: Worst) -> None:
    """A varied batch is a batch still, and a function of torch's seed alone; while a model of float64 trains, too."""
    data, train = bench.data, parts(bench.data)["train"]
    usual = torch.get_default_dtype()
    for size, kind in ((min(16, len(train)), usual), (1, usual), (min(16, len(train)), torch.float64)):
        batch = fetched(train, list(range(size)))
        if kind != usual:  # as the trainer does
            batch = {
                key: value.to(kind) if value.is_floating_point() else value for key, value in batch.items()
            }
        torch.set_default_dtype(kind)
        try:
            _varied(data, batch, f"batch of {size}{'' if kind == usual else ' in float64'}", worst)
        finally:
            torch.set_default_dtype(usual)


def _varied(data: Data, batch: Batch, where: str, worst: Worst) -> None:
    def varied(seed: int, other: int) -> Batch:
        torch.manual_seed(seed)
        np.random.seed(other)  # noqa: NPY002 - must not matter
        random.seed(other)
        return data.augment({key: value.clone() for key, value in batch.items()})

    for seed in (SEED, SEED + 7):
        found = varied(seed, 1)
        equal_fields(varied(seed, 2), found, f"{where}, one seed twice", worst)
        worst.same(f"{where}: fields", sorted(found), sorted(batch))
        if not data.varies:
            equal_fields(found, batch, f"{where}, though nothing varies", worst)
        for key in set(found) & set(batch):
            new, old = found[key], batch[key]
            worst.same(f"{where}: shape of {key}", tuple(new.shape), tuple(old.shape))
            bytes_read = key == "input" and old.dtype == torch.uint8 and new.is_floating_point()
            worst.count(
                new.dtype != old.dtype and not bytes_read, f"{where}: {key} of {new.dtype}, was {old.dtype}"
            )
            worst.count(bytes_read and not ((new >= 0) & (new <= 1)).all(), f"{where}: bytes beyond 0 to 1")
            worst.count((~new.isfinite() & old.isfinite()).sum(), f"{where}: {key} no longer finite")
        for key in ("index", "group"):
            worst.same_bits(f"{where}: {key}", found[key], batch[key])
        for row, target in enumerate(found["target"]):
            _target(data, target, f"{where}, row {row}", worst)


def _workers(bench: Workbench, worst: Worst) -> None:
    """A loading process gets a copy of a split."""
    for name, split in parts(bench.data).items():
        copy = pickle.loads(pickle.dumps(split))
        worst.same(f"length of a copy of {name}", len(copy), len(split))
        for number in few(len(split), 3):
            equal_fields(copy[number], split[number], f"{name} {number} of a copy", worst)
