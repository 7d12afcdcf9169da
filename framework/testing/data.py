"""Contract tests of a data set: one function for each property; each reports its worst case."""

import math
import pickle
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import Tensor

from framework.data import Batch, Data
from framework.datasets.fields import fetch
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
from framework.testing.data_folders import Build, Workbench, cache_in, listed_backwards
from framework.testing.data_samples import (
    FEW,
    batches,
    equal_fields,
    equal_marks,
    equal_splits,
    few,
    fits,
    marks,
    numbers,
    parts,
    samples,
    trimmed,
)
from framework.testing.data_targets import belong
from framework.testing.devices import OneDevice, Questions, on_one_device
from framework.testing.finding import SEED, Finding, Worst, examined
from framework.testing.rows import DataRow

Check = Callable[[Workbench, Worst], None]
NEEDED = ("input", "target", "index", "group")
MINUTES = 5.0
"""Limit of processor time for a check, minutes; a check may generate the data again."""


def examine_data(row: DataRow, build: Build) -> Iterator[Finding]:
    """Yield one finding for each property of a data set; if it cannot be prepared, only the first."""
    with TemporaryDirectory() as scratch:
        bench = Workbench(row, build, Path(scratch))
        checks: dict[str, tuple[float, Check]] = {
            "attributes": (0.0, _attributes),
            "constructor reads nothing": (0.0, _constructor),
            "samples": (0.0, _samples),
            "samples differ": (0.5, _differ),
            "images are 0 to 1": (1e-6, _images),
            "angles are radians": (2 * math.pi, _radians),
            "no sample in two splits": (0.0, _disjoint),
            "targets go with inputs": (0.0, lambda bench, worst: belong(bench.data, worst)),
            "same data, same bits": (0.0, _repeatable),
            "one by one or at once": (0.0, _fetching),
            "a batch is nobody else's": (0.0, _owned),
            "fingerprint": (0.0, _fingerprint),
            "synthetic is said": (0.0, _synthetic),
            "pictures": (0.0, _pictures),
            "on the device of its inputs": (0.0, _on_one_device),
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
    """Return whether the row and the data set have what a check needs."""
    row = bench.row
    match name:
        case "angles are radians":
            return getattr(getattr(bench.data, "target", None), "kind", None) == "angle"
        case "images are 0 to 1":
            shape = getattr(bench.data, "input_shape", ())
            return len(shape) == 3 and shape[0] in (1, 3)
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
    """Check that `prepare` sets the attributes of the contract, each of the right type."""
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
    if bench.row.synthetic is not None:  # the files of a row are undamaged
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
    """Check that the data set can be built before its files exist and where nothing can be generated."""
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
        fields: list[str] = []
        for number, sample in samples(split):
            fields = fields or sorted(sample)
            worst.same(f"{name} {number}: fields", sorted(sample), fields)
            _sample(data, sample, number, f"{name} {number}", worst)
        if len(split) <= FEW:
            continue
        for asked in batches(numbers(split), [256]):
            _together(data, fetch(split, asked), asked, f"{name} {asked[0]} to {asked[-1]}", worst)


def _together(data: Data, batch: Batch, asked: Sequence[int], where: str, worst: Worst) -> None:
    """Check many samples at once in the way `_sample` checks one."""
    missing = [key for key in NEEDED if key not in batch]
    worst.same(f"{where}: fields missing", missing, [])
    if missing:
        return
    target = batch["target"]
    worst.count(batch["index"] != torch.tensor(asked), f"{where}: index, wanted the samples' numbers")
    group = batch["group"]
    worst.count((group < 0) | (group >= len(data.groups)), f"{where}: group of {len(data.groups)}")
    if data.target.kind == "class":
        worst.count((target < 0) | (target >= len(data.target.names)), f"{where}: class")
    else:
        worst.finite(f"{where}: target", target)
    inputs = batch["input"]
    if inputs.dim() != 3:
        worst.finite(f"{where}: input", inputs)
        return
    for number, cloud in zip(asked, inputs, strict=True):
        worst.finite(f"{where}: input of {number}", trimmed(cloud))


def _differ(bench: Workbench, worst: Worst) -> None:
    """Check that samples differ: at most half of the measured inputs of a split repeat others.

    In training, neither all inputs nor all targets may be equal.
    """
    for name, split in parts(bench.data).items():
        found = bench.contents[name].marks
        if len(found) < 2:
            worst.count(False, f"{name} has one sample")
            continue
        if name == "train":
            for key in ("input", "target"):
                worst.count(
                    len({one[key] for one in found.values()}) == 1, f"{name}: every {key} is the same"
                )
        if _measured(split[0]["input"]):
            different = len({(one["input"], one["target"]) for one in found.values()})
            worst.see(1 - different / len(found), f"{name}: {different} different samples of {len(found)}")


def _measured(inputs: Tensor) -> bool:
    """Return whether inputs are measured, rather than a few whole numbers that two samples may share by chance."""
    kept = trimmed(inputs)
    return kept.numel() >= 16 or (kept.is_floating_point() and bool((kept != kept.round()).any()))


def _images(bench: Workbench, worst: Worst) -> None:
    """Check that images of floats are in [0, 1], since encoders read bytes as 0 to 1 and floats as they are."""
    for name, split in parts(bench.data).items():
        for number, sample in samples(split):
            inputs = sample["input"]
            if not inputs.is_floating_point():
                worst.count(False, "bytes")
                continue
            worst.see((-inputs).amax(), f"{name} {number}: down to {inputs.amin().item():.4g}")
            worst.see(inputs.amax() - 1, f"{name} {number}: up to {inputs.amax().item():.4g}")


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
    """Check that no angle is beyond a turn, which most likely means degrees."""
    for name, split in parts(bench.data).items():
        for asked in batches(numbers(split), [64]):
            largest = fetch(split, asked)["target"].abs().flatten(1).amax(-1)
            worst.see(largest, lambda at, name=name, asked=asked: f"{name} {asked[at[0]]}")


def _disjoint(bench: Workbench, worst: Worst) -> None:
    """Check that no pair of input and target is in two splits."""
    seen: dict[tuple[int, int], str] = {}
    for name, split in parts(bench.data).items():
        own: dict[tuple[int, int], str] = {}
        for number in numbers(split):
            sample = split[number]
            target = sample["target"]
            # training targets may be stored in half precision
            rounded = target.half() if target.is_floating_point() else target
            one = marks({"input": sample["input"][None], "target": rounded[None]})[0]
            own[one["input"], one["target"]] = f"{name} {number}"
        worst.count(not own, f"{name} is empty")
        for content, where in own.items():
            worst.count(content in seen, f"{where} is {seen.get(content)} again")
        seen |= own


def _repeatable(bench: Workbench, worst: Worst) -> None:
    """Check that two preparations in two places give the same samples to the last bit.

    Between them the random seeds and the order in which folders list files change. A second preparation in the same
    place, and a second look at the first, must give the same samples too.
    """
    torch.manual_seed(SEED + 7)
    np.random.seed(SEED + 7)  # noqa: NPY002 - the global generator is the point
    random.seed(SEED + 7)
    place = bench.place()
    wanted = bench.contents
    with listed_backwards():
        again = bench.prepared(place)
        worst.same("target", again.target, bench.data.target)
        equal_splits(again, wanted, "another preparation", worst)
    equal_splits(bench.again, wanted, "prepared again in the same place", worst)
    equal_splits(bench.data, wanted, "a second look", worst)


SIZES = (1, 300, 37, 64, 129)
"""Sizes of the batches that are fetched from a split, in turn."""


def _fetching(bench: Workbench, worst: Worst) -> None:
    """Check that a fetched batch holds the single samples, whatever their order and number."""
    for name, split in parts(bench.data).items():
        wanted = bench.contents[name].marks
        order = list(wanted)
        random = np.random.default_rng(SEED)
        shuffled = random.permutation(order).tolist()
        for what, asked in {
            "in order": [order[:1000]],
            "shuffled": list(batches(shuffled, SIZES)),
            "backwards": [order[::-1][:300]],
            "one twice": [[*order[-2:], *order[-2:], *order[-40:]]],
        }.items():
            for part in asked:
                found = marks(fetch(split, part))
                worst.same(f"{name}, {what}: samples of a batch of {len(part)}", len(found), len(part))
                for number, one in zip(part, found, strict=False):
                    equal_marks(one, wanted[number], f"{name} {number} of {len(part)}, {what}", worst)


def _owned(bench: Workbench, worst: Worst) -> None:
    """Check that a batch has memory of its own, which may be written to, and is not changed by later fetches."""
    for name, split in parts(bench.data).items():
        order = list(bench.contents[name].marks)
        wanted = [bench.contents[name].marks[number] for number in order[:16]]
        single = split[order[0]]
        kept = fetch(split, order[:16])
        _ = fetch(split, order[-16:])
        for number, found, one in zip(order, marks(kept), wanted, strict=False):
            equal_marks(found, one, f"{name} {number} after another batch was fetched", worst)
        _ = split[order[-1]]
        found = marks({key: value[None] for key, value in single.items()})[0]
        equal_marks(found, wanted[0], f"{name} {order[0]} after another sample was fetched", worst)
        again = fetch(split, order[:16])
        for key in ("input", "target"):
            shared = kept[key].untyped_storage().data_ptr() == again[key].untyped_storage().data_ptr()
            worst.count(shared, f"{name}: {key} of two batches is one memory: what augment writes stays")


def _fingerprint(bench: Workbench, worst: Worst) -> None:
    found = _words(bench.data, worst)
    worst.same("of the same data again", _words(bench.again, worst), found)
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
            drawn = bench.data.preview(inputs)
            shape, where = np.shape(drawn), f"picture of {name} {number}"
            worst.same(f"{where}: numbers", getattr(drawn, "dtype", type(drawn)), np.dtype(np.uint8))
            worst.count(
                len(shape) != 3 or shape[2] != 3 or 0 in shape, f"{where}: {shape}, wanted (height, width, 3)"
            )
            worst.same_bits(f"{where}: the input afterwards", inputs, before)


def _on_one_device(bench: Workbench, worst: Worst) -> None:
    """Check `augment` for mixed devices: batches are on the model's device, attributes of the data set on the CPU."""
    data, train = bench.data, parts(bench.data)["train"]
    batch = fetch(train, list(range(min(8, len(train)))))

    def questions(mode: OneDevice) -> Questions:
        mode.keep(dict(vars(data)))
        mode.receive(batch)
        yield "augment", lambda: data.augment(dict(batch))

    on_one_device(questions, worst)


def _augment(bench: Workbench, worst: Worst) -> None:
    """Check that an augmented batch is valid and depends on torch's seed alone, also for models of float64."""
    data, train = bench.data, parts(bench.data)["train"]
    usual = torch.get_default_dtype()
    sizes = [(1, usual), (min(16, len(train)), usual), (min(16, len(train)), torch.float64)]
    if len(train) > 16:
        sizes.append((min(300, len(train)), usual))
    for size, kind in sizes:
        batch = fetch(train, list(range(size)))
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
        for row, target in enumerate(found["target"][:16]):
            _target(data, target, f"{where}, row {row}", worst)


def _workers(bench: Workbench, worst: Worst) -> None:
    """Check that a pickled copy of a split, as a loading process gets, has the same samples."""
    for name, split in parts(bench.data).items():
        copy = pickle.loads(pickle.dumps(split))
        worst.same(f"length of a copy of {name}", len(copy), len(split))
        for number in few(len(split), 3):
            equal_fields(copy[number], split[number], f"{name} {number} of a copy", worst)
        wanted = bench.contents[name].marks
        asked = list(wanted)[-300:]
        for number, one in zip(asked, marks(fetch(copy, asked)), strict=True):
            equal_marks(one, wanted[number], f"{name} {number} of a copy", worst)
