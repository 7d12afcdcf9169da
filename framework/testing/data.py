"""Contract tests of a data set: one function for each property; each records its largest error."""

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

from framework.data import Batch, Data, shape_fits
from framework.datasets.fields import fetch
from framework.target import Target
from framework.testing.data_files import (
    damaged_files,
    damaged_own_files,
    missing_root,
    own_files,
    raw_input,
    read_back,
    skipped_files,
)
from framework.testing.data_folders import Build, Workbench, cache_in, list_folders_backwards
from framework.testing.data_samples import (
    FEW,
    batches,
    check_equal_fields,
    check_equal_hashes,
    check_equal_splits,
    hash_samples,
    indices_to_check,
    remove_padding,
    samples,
    spaced_indices,
    splits_by_name,
)
from framework.testing.data_targets import check_targets_belong
from framework.testing.devices import Calls, OneDevice, check_devices
from framework.testing.finding import SEED, Finding, Worst, run_check
from framework.testing.rows import DataRow

Check = Callable[[Workbench, Worst], None]
NEEDED = ("input", "target", "index", "group")
"""Fields that every sample must have."""
MINUTES = 5.0
"""Limit of processor time for one check, minutes; a check may generate the data again."""


def examine_data(row: DataRow, build: Build) -> Iterator[Finding]:
    """Yield one finding for each property of a data set, or only the first if the data set cannot be prepared.

    Args:
        row: Contract row of the data set.
        build: Function that returns the data set for given parameters, without preparing it.
    """
    with TemporaryDirectory() as scratch:
        bench = Workbench(row, build, Path(scratch))
        checks: dict[str, tuple[float, Check]] = {
            "attributes": (0.0, _attributes),
            "constructor reads nothing": (0.0, _constructor),
            "samples": (0.0, _samples),
            "samples differ": (0.5, _samples_differ),
            "images are 0 to 1": (1e-6, _image_range),
            "angles are radians": (2 * math.pi, _angle_size),
            "no sample in two splits": (0.0, _disjoint),
            "targets go with inputs": (0.0, lambda bench, worst: check_targets_belong(bench.data, worst)),
            "same data, same bits": (0.0, _repeatable),
            "batches equal single samples": (0.0, _fetching),
            "batches share no memory": (0.0, _own_memory),
            "fingerprint": (0.0, _fingerprint),
            "synthetic is stated": (0.0, _synthetic),
            "pictures": (0.0, _pictures),
            "on the device of its inputs": (0.0, _on_one_device),
            "augment": (0.0, _augment),
            "workers": (0.0, _workers),
            "official layout read back": (0.0, read_back),
            "missing root": (0.0, missing_root),
            "damaged files are named": (0.0, damaged_files),
            "files left out are counted": (0.0, skipped_files),
            "own files": (0.0, own_files),
            "raw input": (0.0, raw_input),
            "damaged own files are named": (0.0, damaged_own_files),
        }
        for name, (limit, check) in checks.items():
            if name in row.leave_out or not _applies(name, bench):
                continue
            yield run_check(
                name,
                row.limits.get(name, limit),
                lambda worst, check=check: check(bench, worst),
                seconds=60 * MINUTES,
            )
            if "data" not in vars(bench):
                return


def _applies(name: str, bench: Workbench) -> bool:
    """Return whether the property `name` can be checked for the contract row and the data set."""
    row = bench.row
    match name:
        case "angles are radians":
            return getattr(getattr(bench.data, "target", None), "kind", None) == "angle"
        case "images are 0 to 1":
            shape = getattr(bench.data, "input_shape", ())
            return len(shape) == 3 and shape[0] in (1, 3)
        case "synthetic is stated":
            return row.synthetic is not None
        case "official layout read back":
            return bench.generated is not None
        case "missing root":
            return bool(bench.location_keys)
        case "damaged files are named":
            return bool(row.fragile)
        case "files left out are counted":
            return bool(row.skip)
        case "own files" | "damaged own files are named":
            return row.files is not None
    return True


def _attributes(bench: Workbench, worst: Worst) -> None:
    """Check that `prepare` sets the attributes that `Data` requires, each of the right type."""
    data = bench.data
    columns, shape = data.columns, data.input_shape
    worst.same("target is a Target", isinstance(data.target, Target), True)
    worst.count(
        not _are_counts(shape) or not all(shape),
        f"input_shape is {shape}, expected a tuple of integers above 0",
    )
    worst.count(
        not _are_names(data.groups) or not data.groups,
        f"groups is {data.groups}, expected a tuple of different names",
    )
    worst.count(not _are_names(columns), f"columns is {columns}, expected a tuple of different names")
    worst.count(
        bool(columns) and len(columns) != shape[-1], f"{len(columns)} columns, but inputs of shape {shape}"
    )
    worst.same("type of synthetic", type(data.synthetic), bool)
    worst.same("type of varies", type(data.varies), bool)
    worst.count(
        not _are_counts((data.skipped,)), f"skipped is {data.skipped!r}, expected an integer of 0 or more"
    )
    if bench.row.synthetic is not None:  # the files of a row are undamaged
        worst.same("skipped", data.skipped, 0)
    worst.same("type of bibtex", type(data.bibtex), str)
    for name, split in splits_by_name(data).items():
        worst.count(not len(split), f"the {name} split is empty")


def _are_counts(numbers: Any) -> bool:
    return isinstance(numbers, tuple) and all(type(number) is int and number >= 0 for number in numbers)


def _are_names(names: Any) -> bool:
    strings = isinstance(names, tuple) and all(isinstance(name, str) for name in names)
    return strings and len(set(names)) == len(names)


def _constructor(bench: Workbench, worst: Worst) -> None:
    """Check that the constructor needs neither the files of the data set nor a cache in which to generate them."""
    workspace = bench.make_workspace()
    away = workspace.files.rename(workspace.files.with_name("away"))
    unusable_cache = workspace.files.with_name("no folder")
    unusable_cache.touch()
    with cache_in(unusable_cache):
        data = bench.build_in(workspace)
    away.rename(workspace.files)
    with cache_in(workspace.cache):
        data.prepare()
    worst.same("target after prepare", data.target, bench.data.target)


def _samples(bench: Workbench, worst: Worst) -> None:
    data = bench.data
    for name, split in splits_by_name(data).items():
        fields: list[str] = []
        for number, sample in samples(split):
            fields = fields or sorted(sample)
            worst.same(f"{name} sample {number}: fields", sorted(sample), fields)
            _sample(data, sample, number, f"{name} sample {number}", worst)
        if len(split) <= FEW:
            continue
        for indices in batches(indices_to_check(split), [256]):
            _sample_batch(
                data, fetch(split, indices), indices, f"{name} {indices[0]} to {indices[-1]}", worst
            )


def _sample_batch(data: Data, batch: Batch, indices: Sequence[int], where: str, worst: Worst) -> None:
    """Check a batch of many samples, as `_sample` checks a single one."""
    missing = [key for key in NEEDED if key not in batch]
    worst.same(f"{where}: missing fields", missing, [])
    if missing:
        return
    target = batch["target"]
    worst.count(batch["index"] != torch.tensor(indices), f"{where}: samples with a wrong index")
    group = batch["group"]
    worst.count(
        (group < 0) | (group >= len(data.groups)),
        f"{where}: samples whose group is not below {len(data.groups)}",
    )
    if data.target.kind == "class":
        worst.count(
            (target < 0) | (target >= len(data.target.names)),
            f"{where}: samples whose class is not below {len(data.target.names)}",
        )
    else:
        worst.finite(f"{where}: target", target)
    inputs = batch["input"]
    if inputs.dim() != 3:
        worst.finite(f"{where}: input", inputs)
        return
    for number, cloud in zip(indices, inputs, strict=True):
        worst.finite(f"{where}: input of sample {number}", remove_padding(cloud))


def _samples_differ(bench: Workbench, worst: Worst) -> None:
    """Check that at most half of the samples of a split repeat other samples.

    This is checked only for measured inputs (`_measured`). In the training split, neither all inputs nor all targets
    may be equal.
    """
    for name, split in splits_by_name(bench.data).items():
        hashes_by_sample = bench.contents[name].hashes
        if len(hashes_by_sample) < 2:
            worst.count(False, f"{name} has fewer than two samples")
            continue
        if name == "train":
            for key in ("input", "target"):
                worst.count(
                    len({hashes[key] for hashes in hashes_by_sample.values()}) == 1,
                    f"{name}: all samples have the same {key}",
                )
        if _measured(split[0]["input"]):
            different = len({(hashes["input"], hashes["target"]) for hashes in hashes_by_sample.values()})
            worst.record(
                1 - different / len(hashes_by_sample),
                f"{name}: {different} of {len(hashes_by_sample)} samples are different",
            )


def _measured(inputs: Tensor) -> bool:
    """Return whether two inputs like this one can hardly be equal by chance; false for inputs of a few integers."""
    trimmed_inputs = remove_padding(inputs)
    return trimmed_inputs.numel() >= 16 or (
        trimmed_inputs.is_floating_point() and bool((trimmed_inputs != trimmed_inputs.round()).any())
    )


def _image_range(bench: Workbench, worst: Worst) -> None:
    """Check that images of floats are in [0, 1], since encoders scale bytes to [0, 1] but do not scale floats."""
    for name, split in splits_by_name(bench.data).items():
        for number, sample in samples(split):
            inputs = sample["input"]
            if not inputs.is_floating_point():
                worst.count(False, "the images are bytes")
                continue
            worst.record((-inputs).amax(), f"{name} sample {number}: lowest value {inputs.amin().item():.4g}")
            worst.record(
                inputs.amax() - 1, f"{name} sample {number}: highest value {inputs.amax().item():.4g}"
            )


def _sample(data: Data, sample: Any, number: int, where: str, worst: Worst) -> None:
    strange = {key: type(value) for key, value in sample.items() if not isinstance(value, Tensor)}
    missing = [key for key in NEEDED if key not in sample]
    worst.same(f"{where}: fields that are not tensors", strange, {})
    worst.same(f"{where}: missing fields", missing, [])
    if strange or missing:
        return
    inputs, target = sample["input"], sample["target"]
    shape = tuple(inputs.shape)
    worst.count(
        not shape_fits(shape, data.input_shape),
        f"{where}: input of shape {shape}, expected {data.input_shape}",
    )
    known = inputs.is_floating_point() or inputs.dtype == torch.uint8
    worst.count(not known, f"{where}: input of {inputs.dtype}, expected a float or torch.uint8")
    worst.finite(f"{where}: input", remove_padding(inputs))
    _target(data, target, where, worst)
    for key in ("index", "group"):
        worst.same(
            f"{where}: type and shape of {key}",
            (sample[key].dtype, tuple(sample[key].shape)),
            (torch.int64, ()),
        )
    worst.same(f"{where}: index", int(sample["index"]), number)
    group = int(sample["group"])
    worst.count(not 0 <= group < len(data.groups), f"{where}: group {group} of {len(data.groups)}")


def _target(data: Data, target: Tensor, where: str, worst: Worst) -> None:
    kind, names = data.target.kind, data.target.names
    if kind == "class":
        worst.same(
            f"{where}: type and shape of the target", (target.dtype, tuple(target.shape)), (torch.int64, ())
        )
        worst.count(
            (target < 0) | (target >= len(names)), f"{where}: class {target.tolist()} of {len(names)}"
        )
        return
    worst.same(f"{where}: shape of the target", tuple(target.shape), data.target.event_shape)
    worst.count(not target.is_floating_point(), f"{where}: target of {target.dtype}, expected a float")
    worst.finite(f"{where}: target", target)


def _angle_size(bench: Workbench, worst: Worst) -> None:
    """Check that no angle exceeds 2π, since a larger one is most likely in degrees."""
    for name, split in splits_by_name(bench.data).items():
        for indices in batches(indices_to_check(split), [64]):
            largest = fetch(split, indices)["target"].abs().flatten(1).amax(-1)
            worst.record(largest, lambda at, name=name, indices=indices: f"{name} sample {indices[at[0]]}")


def _disjoint(bench: Workbench, worst: Worst) -> None:
    """Check that no pair of input and target occurs in two splits."""
    earlier: dict[tuple[int, int], str] = {}
    for name, split in splits_by_name(bench.data).items():
        own: dict[tuple[int, int], str] = {}
        for number in indices_to_check(split):
            sample = split[number]
            target = sample["target"]
            # training targets may be stored in half precision
            rounded = target.half() if target.is_floating_point() else target
            hashes = hash_samples({"input": sample["input"][None], "target": rounded[None]})[0]
            own[hashes["input"], hashes["target"]] = f"{name} sample {number}"
        worst.count(not own, f"{name} is empty")
        for content, where in own.items():
            worst.count(content in earlier, f"{where} is equal to {earlier.get(content)}")
        earlier |= own


def _repeatable(bench: Workbench, worst: Worst) -> None:
    """Check that samples are equal to the last bit when the data set is prepared or read again.

    The data set is prepared in another folder, with other random seeds and with files listed in another order. It is
    also prepared a second time in the same folder, and its samples are read a second time.
    """
    torch.manual_seed(SEED + 7)
    np.random.seed(SEED + 7)  # noqa: NPY002 - the global generator is the point
    random.seed(SEED + 7)
    workspace = bench.make_workspace()
    expected = bench.contents
    with list_folders_backwards():
        again = bench.prepare_in(workspace)
        worst.same("target", again.target, bench.data.target)
        check_equal_splits(again, expected, "prepared in another folder", worst)
    check_equal_splits(bench.again, expected, "prepared again in the same folder", worst)
    check_equal_splits(bench.data, expected, "read a second time", worst)


SIZES = (1, 300, 37, 64, 129)
"""Sizes of consecutive batches that are fetched from a split."""


def _fetching(bench: Workbench, worst: Worst) -> None:
    """Check that a batch holds the same samples as indexing returns one by one, for any order and batch size."""
    for name, split in splits_by_name(bench.data).items():
        expected = bench.contents[name].hashes
        order = list(expected)
        random = np.random.default_rng(SEED)
        shuffled = random.permutation(order).tolist()
        for order_name, index_batches in {
            "in order": [order[:1000]],
            "shuffled": list(batches(shuffled, SIZES)),
            "backwards": [order[::-1][:300]],
            "one twice": [[*order[-2:], *order[-2:], *order[-40:]]],
        }.items():
            for indices in index_batches:
                actual = hash_samples(fetch(split, indices))
                worst.same(
                    f"{name}, {order_name}: number of samples of a batch of {len(indices)}",
                    len(actual),
                    len(indices),
                )
                for number, hashes in zip(indices, actual, strict=False):
                    check_equal_hashes(
                        hashes,
                        expected[number],
                        f"{name} sample {number} of {len(indices)}, {order_name}",
                        worst,
                    )


def _own_memory(bench: Workbench, worst: Worst) -> None:
    """Check that each batch and each sample has memory of its own, so that changing one does not change another."""
    for name, split in splits_by_name(bench.data).items():
        order = list(bench.contents[name].hashes)
        expected = [bench.contents[name].hashes[number] for number in order[:16]]
        single = split[order[0]]
        fetched_batch = fetch(split, order[:16])
        _ = fetch(split, order[-16:])
        for number, actual, hashes in zip(order, hash_samples(fetched_batch), expected, strict=False):
            check_equal_hashes(
                actual, hashes, f"{name} sample {number} after another batch was fetched", worst
            )
        _ = split[order[-1]]
        actual = hash_samples({key: value[None] for key, value in single.items()})[0]
        check_equal_hashes(
            actual, expected[0], f"{name} sample {order[0]} after another sample was fetched", worst
        )
        again = fetch(split, order[:16])
        for key in ("input", "target"):
            shared = (
                fetched_batch[key].untyped_storage().data_ptr() == again[key].untyped_storage().data_ptr()
            )
            worst.count(
                shared,
                f"{name}: two batches share the memory of {key}, so that augment would change later batches",
            )


def _fingerprint(bench: Workbench, worst: Worst) -> None:
    original = _fingerprint_entries(bench.data, worst)
    worst.same(
        "fingerprint of the same data prepared again", _fingerprint_entries(bench.again, worst), original
    )
    for key, value in bench.row.changes.items():
        other = bench.prepare_in(bench.first, **{key: value})
        worst.count(
            _fingerprint_entries(other, worst) == original, f"fingerprint unchanged with {key} = {value}"
        )


def _fingerprint_entries(data: Data, worst: Worst) -> dict[str, str]:
    entries: Mapping[str, str] = data.fingerprint()
    strange = {key: value for key, value in entries.items() if not (type(key) is type(value) is str)}
    worst.same("entries whose key or value is not a str", strange, {})
    worst.count(not entries, "the fingerprint is empty")
    return dict(entries)


def _synthetic(bench: Workbench, worst: Worst) -> None:
    worst.same("synthetic", bench.data.synthetic, bench.row.synthetic)


def _pictures(bench: Workbench, worst: Worst) -> None:
    for name, split in splits_by_name(bench.data).items():
        for number in spaced_indices(len(split), 3):
            inputs = split[number]["input"]
            before = inputs.clone()
            rendered = bench.data.preview(inputs)
            shape, where = np.shape(rendered), f"picture of {name} sample {number}"
            worst.same(f"{where}: dtype", getattr(rendered, "dtype", type(rendered)), np.dtype(np.uint8))
            worst.count(
                len(shape) != 3 or shape[2] != 3 or 0 in shape,
                f"{where}: shape {shape}, expected (height, width, 3)",
            )
            worst.same_bits(f"input after the {where}", inputs, before)


def _on_one_device(bench: Workbench, worst: Worst) -> None:
    """Check that `augment` mixes no devices: batches are on the model's device, attributes of the data on the CPU."""
    data, train = bench.data, splits_by_name(bench.data)["train"]
    batch = fetch(train, list(range(min(8, len(train)))))

    def calls(mode: OneDevice) -> Calls:
        mode.label_cpu(dict(vars(data)))
        mode.label_device(batch)
        yield "augment", lambda: data.augment(dict(batch))

    check_devices(calls, worst)


def _augment(bench: Workbench, worst: Worst) -> None:
    """Check that an augmented batch is valid and depends on torch's seed alone, also for models in float64."""
    data, train = bench.data, splits_by_name(bench.data)["train"]
    default = torch.get_default_dtype()
    sizes = [(1, default), (min(16, len(train)), default), (min(16, len(train)), torch.float64)]
    if len(train) > 16:
        sizes.append((min(300, len(train)), default))
    for size, kind in sizes:
        batch = fetch(train, list(range(size)))
        if kind != default:  # as the trainer does
            batch = {
                key: value.to(kind) if value.is_floating_point() else value for key, value in batch.items()
            }
        torch.set_default_dtype(kind)
        try:
            where = f"batch of {size}{'' if kind == default else ' in float64'}"
            _check_augmented(data, batch, where, worst)
        finally:
            torch.set_default_dtype(default)


def _check_augmented(data: Data, batch: Batch, where: str, worst: Worst) -> None:
    def augment(seed: int, other: int) -> Batch:
        torch.manual_seed(seed)
        np.random.seed(other)  # noqa: NPY002 - must not matter
        random.seed(other)
        return data.augment({key: value.clone() for key, value in batch.items()})

    for seed in (SEED, SEED + 7):
        augmented = augment(seed, 1)
        check_equal_fields(augment(seed, 2), augmented, f"{where}, twice with the same seed", worst)
        worst.same(f"{where}: fields", sorted(augmented), sorted(batch))
        if not data.varies:
            check_equal_fields(augmented, batch, f"{where}, although `varies` is False", worst)
        for key in set(augmented) & set(batch):
            new, old = augmented[key], batch[key]
            worst.same(f"{where}: shape of {key}", tuple(new.shape), tuple(old.shape))
            bytes_read = key == "input" and old.dtype == torch.uint8 and new.is_floating_point()
            worst.count(
                new.dtype != old.dtype and not bytes_read,
                f"{where}: {key} is of {new.dtype}, was of {old.dtype}",
            )
            worst.count(
                bytes_read and not ((new >= 0) & (new <= 1)).all(),
                f"{where}: floats from bytes that are not in [0, 1]",
            )
            worst.count(
                (~new.isfinite() & old.isfinite()).sum(),
                f"{where}: values of {key} that are no longer finite",
            )
        for key in ("index", "group"):
            worst.same_bits(f"{where}: {key}", augmented[key], batch[key])
        for row, target in enumerate(augmented["target"][:16]):
            _target(data, target, f"{where}, row {row}", worst)


def _workers(bench: Workbench, worst: Worst) -> None:
    """Check that a pickled copy of a split, as a worker process receives it, has the same samples."""
    for name, split in splits_by_name(bench.data).items():
        copy = pickle.loads(pickle.dumps(split))
        worst.same(f"length of a copy of {name}", len(copy), len(split))
        for number in spaced_indices(len(split), 3):
            check_equal_fields(copy[number], split[number], f"{name} sample {number} of a copy", worst)
        expected = bench.contents[name].hashes
        indices = list(expected)[-300:]
        for number, hashes in zip(indices, hash_samples(fetch(copy, indices)), strict=True):
            check_equal_hashes(hashes, expected[number], f"{name} sample {number} of a copy", worst)
