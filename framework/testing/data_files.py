"""Checks of a data set's files: roots that are missing, files that are damaged, and a user's own files."""

import io
import math
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from pickle import UnpicklingError

import numpy as np
import torch
from torch import Tensor

from framework.data import Data
from framework.errors import DataError
from framework.storage.generated import MARK
from framework.testing.data_folders import Workbench, cache_in, damage, first_match
from framework.testing.data_samples import FEW, equal_splits, parts, samples, total, trimmed
from framework.testing.finding import TooSlow, Worst
from framework.testing.rows import DAMAGES, Damage


def read_back(bench: Workbench, worst: Worst) -> None:
    """Check that generated files give the same samples through `root`, and are synthetic while marked so."""
    for what, synthetic in {"as it is": True, "without its mark": False}.items():
        place, source = bench.spoilt(lambda root, keep=synthetic: None if keep else (root / MARK).unlink())
        found = bench.prepared(place, **source)
        worst.same(f"{what}: synthetic", found.synthetic, synthetic)
        worst.same(f"{what}: target", found.target, bench.data.target)
        worst.same(f"{what}: input_shape", found.input_shape, bench.data.input_shape)
        equal_splits(found, bench.contents, what, worst, only=("input", "target", "index", "group"))


def missing_root(bench: Workbench, worst: Worst) -> None:
    """Check that a missing folder is named in the error.

    Without a folder, real data must be asked for, or be replaced by generated data that are marked as synthetic.
    """
    nowhere = bench.folder() / "nowhere"
    for key in bench.says_where:
        refused(
            lambda key=key: bench.prepared(bench.first, **{key: str(nowhere)}),
            [nowhere.name],
            f"{key} = {nowhere}",
            worst,
        )
        if bench.row.synthetic is not False or bench.default(key) is not None:
            continue  # other data sets may generate many samples here
        try:
            found = bench.prepared(bench.first, **{key: None})
        except DataError as error:
            worst.count(
                f"data.{key}" not in str(error), f"{key} = None: {error}, which does not say data.{key}"
            )
        else:
            worst.same(f"{key} = None: synthetic", found.synthetic, True)


def damaged_files(bench: Workbench, worst: Worst) -> None:
    """Check that each damaged file of the row raises an error that names it."""
    for pattern, kinds in bench.row.fragile.items():
        for kind in kinds:
            names: list[str] = []

            def spoil(
                root: Path, pattern: str = pattern, kind: Damage = kind, names: list[str] = names
            ) -> None:
                file = first_match(root, pattern)
                damage(file, kind)
                names.append(file.name)

            place, source = bench.spoilt(spoil)
            refused(
                lambda place=place, source=source: bench.prepared(place, **source),
                names,
                f"{names[0]}: {kind}",
                worst,
            )


def left_out(bench: Workbench, worst: Worst) -> None:
    """Check that the samples of an unreadable file are left out, and that `skipped` counts them."""
    pattern = next(iter(bench.row.fragile))
    place, source = bench.spoilt(lambda root: damage(first_match(root, pattern), "garbage"))
    found = bench.prepared(place, **source, **bench.row.skip)
    left = total(bench.data) - total(found)
    worst.count(found.skipped < 1, f"skipped {found.skipped} after damage to {pattern}")
    worst.same("samples fewer", left, found.skipped - bench.data.skipped)


def own_files(bench: Workbench, worst: Worst) -> None:
    """Check that user files are read without `prepare`, in their order, in the format of the splits' samples."""
    files, data = _own(bench)
    unknown = [file.name for file in files if data.suffixes and file.suffix.lower() not in data.suffixes]
    worst.count(bool(unknown), f"suffixes do not name that of {', '.join(unknown)}")
    refused(lambda: data.read([]), [], "no file", worst)
    together = _read(data, files, bench, worst)
    apart = [sample for file in files for sample in _read(data, [file], bench, worst)]
    backwards = _read(data, files[::-1], bench, worst)
    count = len(_read(data, files[-1:], bench, worst))
    times = max(1, min(5, FEW // max(len(together), 1)))  # only FEW samples are compared
    renamed = _exchanged(files, bench.folder())
    swapped = [_read(data, [file], bench, worst) for file in renamed]
    for what, found, wanted in (
        ("one file at a time", apart, together),
        (f"every file {times} times", _read(data, [*files] * times, bench, worst), together * times),
        (
            "files that have each other's names",
            [sample for part in swapped[::-1] for sample in part],
            [sample for file in files[: len(renamed)] for sample in _read(data, [file], bench, worst)],
        ),
        ("files backwards", backwards[:count], together[-count:]),
        ("without prepare", _read(bench.data, files, bench, worst), together),
    ):
        worst.same(f"{what}: samples", len(found), len(wanted))
        for number, (one, other) in enumerate(zip(found, wanted, strict=False)):
            worst.same_bits(f"{what}: sample {number}", one, other)


def _exchanged(files: Sequence[Path], folder: Path) -> list[Path]:
    """Copy the first two files under each other's names, and return the copies; none where their suffixes differ."""
    if len(files) < 2 or files[0].suffix != files[1].suffix or not all(file.is_file() for file in files[:2]):
        return []
    return [Path(shutil.copy(files[other], folder / files[one].name)) for one, other in ((0, 1), (1, 0))]


def raw_input(bench: Workbench, worst: Worst) -> None:
    """Check that the config and the stored state alone read files as the prepared data set does."""
    files = list(bench.row.files(bench.folder())) if bench.row.files else []
    nowhere = {key: str(bench.folder() / "nowhere") for key in bench.says_where}
    data, trained = bench.built(bench.first, **nowhere), bench.data
    data.target, data.input_shape, data.columns = trained.target, trained.input_shape, trained.columns
    stored = io.BytesIO()
    torch.save(dict(trained.state_dict()), stored)
    stored.seek(0)
    try:
        data.load_state_dict(torch.load(stored, weights_only=True))
    except UnpicklingError as error:
        worst.count(True, f"state_dict holds more than plain values and tensors: {str(error)[:200]}")
        return
    for file in files:
        with cache_in(bench.first.cache):
            found, wanted = (
                data.inputs(file),
                [sample["input"] for _, sample in samples(trained.read([file]))],
            )
        worst.same(f"{file.name}: samples", len(found), len(wanted))
        for number, (one, other) in enumerate(zip(found, wanted, strict=False)):
            worst.same_bits(f"{file.name}: sample {number}", trimmed(one), trimmed(other))
    for what, given in {
        "an object": object(),
        "words": [["a"]],
        "99991 numbers": np.zeros((2, 99991)),
    }.items():
        refused(lambda given=given: data.inputs(given), [], what, worst)


def damaged_own_files(bench: Workbench, worst: Worst) -> None:
    """Check that a damaged file of a user raises an error that names it."""
    for kind in DAMAGES:
        files, data = _own(bench)
        damage(files[0], kind)
        # reading a sample counts too, since large collections are read on use
        refused(
            lambda files=files, data=data: data.read(files[::-1])[len(files) - 1],
            [files[0].name],
            kind,
            worst,
        )


def refused(act: Callable[[], object], wanted: Sequence[str], what: str, worst: Worst) -> None:
    """Check that a call raises a DataError that contains these words and says what to do."""
    try:
        act()
    except DataError as error:
        told = " ".join(str(error).split())
        missing = [word for word in wanted if word not in told]
        short = len(told) < sum(map(len, wanted)) + 20
        lacks = ", ".join(missing) or "what to do" * short
        worst.count(
            bool(lacks), f"{what}: {f'an error that does not say {lacks}: ' * bool(lacks)}{told[:300]}"
        )
    except TooSlow:
        raise
    except Exception as error:
        worst.see(math.inf, f"{what}: {type(error).__name__} ({error}), wanted a DataError")
    else:
        worst.count(True, f"{what}: taken without a word, where the error should say {', '.join(wanted)}")


def _own(bench: Workbench) -> tuple[list[Path], Data]:
    """Return a user's own files, and a data set that is not prepared."""
    assert bench.row.files is not None
    return list(bench.row.files(bench.folder())), bench.built(bench.first)


def _read(data: Data, files: Sequence[Path], bench: Workbench, worst: Worst) -> list[Tensor]:
    """Return every input without padding."""
    with cache_in(bench.first.cache):
        found = data.read(files)
    sample_of_split = parts(bench.data)["train"][0]
    like, wanted = sample_of_split["input"], bench.data.input_shape
    inputs = []
    for number, sample in samples(found):
        where = f"sample {number} of {len(files)} files"
        further = set(sample) - (set(sample_of_split) - {"target", "group"})
        lacking = {"input", "index"} - set(sample)
        worst.same(f"{where}: fields too many or missing", sorted(further | lacking), [])
        if lacking:
            continue
        shape = tuple(sample["input"].shape)
        # any cloud of a user may have more points than those of training
        known = (len(shape) == len(wanted) == 2 and shape[1:] == wanted[1:]) or shape == wanted
        worst.count(not known, f"{where}: input of {shape}, wanted {wanted}")
        worst.same(f"{where}: input", sample["input"].dtype, like.dtype)
        worst.same(f"{where}: index", (sample["index"].dtype, int(sample["index"])), (torch.int64, number))
        inputs.append(trimmed(sample["input"]))
    worst.count(not inputs, f"{len(files)} files without a sample")
    return inputs
