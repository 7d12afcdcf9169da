"""Checks of a data set's files: a missing root, damaged files, and a user's own files.

The argument `bench` of a check builds and prepares the data set (`framework.testing.data_folders.Workbench`). Errors
are recorded in `worst` (`framework.testing.finding.Worst`), which keeps the largest one.
"""

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
from framework.testing.data_samples import (
    FEW,
    check_equal_splits,
    remove_padding,
    samples,
    splits_by_name,
    total_samples,
)
from framework.testing.finding import TooSlow, Worst
from framework.testing.rows import DAMAGES, Damage


def read_back(bench: Workbench, worst: Worst) -> None:
    """Check that generated files give the same samples when `root` names their folder.

    The data must count as synthetic as long as the folder contains the mark of synthetic data, and only then.
    """
    for mark_state, synthetic in {"generated files": True, "generated files without mark": False}.items():
        workspace, source = bench.copy_files(
            lambda root, keep=synthetic: None if keep else (root / MARK).unlink()
        )
        reread = bench.prepare_in(workspace, **source)
        worst.same(f"{mark_state}: synthetic", reread.synthetic, synthetic)
        worst.same(f"{mark_state}: target", reread.target, bench.data.target)
        worst.same(f"{mark_state}: input_shape", reread.input_shape, bench.data.input_shape)
        check_equal_splits(
            reread, bench.contents, mark_state, worst, only=("input", "target", "index", "group")
        )


def missing_root(bench: Workbench, worst: Worst) -> None:
    """Check that the error for a missing folder names the folder.

    Without a folder, a data set of real data must raise an error that names the parameter, or generate data that are
    marked as synthetic.
    """
    nowhere = bench.make_folder() / "nowhere"
    for key in bench.location_keys:
        check_refused(
            lambda key=key: bench.prepare_in(bench.first, **{key: str(nowhere)}),
            [nowhere.name],
            f"{key} = {nowhere}",
            worst,
        )
        if bench.row.synthetic is not False or bench.default(key) is not None:
            continue  # a data set that generates data by default may generate many samples here
        try:
            generated = bench.prepare_in(bench.first, **{key: None})
        except DataError as error:
            worst.count(
                f"data.{key}" not in str(error), f"{key} = None: the error does not name data.{key}: {error}"
            )
        else:
            worst.same(f"{key} = None: synthetic", generated.synthetic, True)


def damaged_files(bench: Workbench, worst: Worst) -> None:
    """Check that each damage in the row's `fragile` raises an error that names the file."""
    for pattern, kinds in bench.row.fragile.items():
        for kind in kinds:
            names: list[str] = []

            def damage_file(
                root: Path, pattern: str = pattern, kind: Damage = kind, names: list[str] = names
            ) -> None:
                file = first_match(root, pattern)
                damage(file, kind)
                names.append(file.name)

            workspace, source = bench.copy_files(damage_file)
            check_refused(
                lambda workspace=workspace, source=source: bench.prepare_in(workspace, **source),
                names,
                f"{names[0]}, damage {kind}",
                worst,
            )


def skipped_files(bench: Workbench, worst: Worst) -> None:
    """Check that the samples of an unreadable file are left out, and that `skipped` counts them.

    Without the settings that leave samples out, the error must name these settings.
    """
    pattern = next(iter(bench.row.fragile))
    workspace, source = bench.copy_files(lambda root: damage(first_match(root, pattern), "garbage"))
    settings = [f"data.{key}={str(value).lower()}" for key, value in bench.row.skip.items()]
    check_refused(lambda: bench.prepare_in(workspace, **source), settings, "an unreadable file", worst)
    remaining = bench.prepare_in(workspace, **source, **bench.row.skip)
    missing_count = total_samples(bench.data) - total_samples(remaining)
    worst.count(remaining.skipped < 1, f"skipped {remaining.skipped} after damage to {pattern}")
    worst.same("samples left out", missing_count, remaining.skipped - bench.data.skipped)


def own_files(bench: Workbench, worst: Worst) -> None:
    """Check that user files are read in order and without `prepare`, into samples like those of the splits."""
    files, data = _user_files(bench)
    unknown = [file.name for file in files if data.suffixes and file.suffix.lower() not in data.suffixes]
    worst.count(bool(unknown), f"`suffixes` lacks the suffix of {', '.join(unknown)}")
    check_refused(lambda: data.read([]), [], "no file", worst)
    together = _read(data, files, bench, worst)
    one_by_one = [sample for file in files for sample in _read(data, [file], bench, worst)]
    backwards = _read(data, files[::-1], bench, worst)
    count = len(_read(data, files[-1:], bench, worst))
    times = max(1, min(5, FEW // max(len(together), 1)))  # only FEW samples are compared
    renamed = _copy_exchanged(files, bench.make_folder())
    swapped = [_read(data, [file], bench, worst) for file in renamed]
    for comparison, actual, expected in (
        ("one file at a time", one_by_one, together),
        (f"every file {times} times", _read(data, [*files] * times, bench, worst), together * times),
        (
            "two files with exchanged names",
            [sample for part in swapped[::-1] for sample in part],
            [sample for file in files[: len(renamed)] for sample in _read(data, [file], bench, worst)],
        ),
        ("files in reverse order", backwards[:count], together[-count:]),
        ("without prepare", _read(bench.data, files, bench, worst), together),
    ):
        worst.same(f"{comparison}: samples", len(actual), len(expected))
        for number, (sample_read, sample_expected) in enumerate(zip(actual, expected, strict=False)):
            worst.same_bits(f"{comparison}: sample {number}", sample_read, sample_expected)


def _copy_exchanged(files: Sequence[Path], folder: Path) -> list[Path]:
    """Copy the first two files to a folder, each under the name of the other one, and return the copies.

    No file is copied if there are fewer than two files, or if their suffixes differ.
    """
    if len(files) < 2 or files[0].suffix != files[1].suffix or not all(file.is_file() for file in files[:2]):
        return []
    return [
        Path(shutil.copy(files[source], folder / files[target].name)) for target, source in ((0, 1), (1, 0))
    ]


def raw_input(bench: Workbench, worst: Worst) -> None:
    """Check that a data set that only loads a stored state, without `prepare`, reads files like the prepared one."""
    files = list(bench.row.files(bench.make_folder())) if bench.row.files else []
    nowhere = {key: str(bench.make_folder() / "nowhere") for key in bench.location_keys}
    data, trained = bench.build_in(bench.first, **nowhere), bench.data
    data.target, data.input_shape, data.columns = trained.target, trained.input_shape, trained.columns
    stored = io.BytesIO()
    torch.save(dict(trained.state_dict()), stored)
    stored.seek(0)
    try:
        data.load_state_dict(torch.load(stored, weights_only=True))
    except UnpicklingError as error:
        worst.count(True, f"state_dict holds objects other than plain values and tensors: {str(error)[:200]}")
        return
    for file in files:
        with cache_in(bench.first.cache):
            actual, expected = (
                data.inputs(file),
                [sample["input"] for _, sample in samples(trained.read([file]))],
            )
        worst.same(f"{file.name}: samples", len(actual), len(expected))
        for number, (input_read, input_expected) in enumerate(zip(actual, expected, strict=False)):
            worst.same_bits(
                f"{file.name}: sample {number}", remove_padding(input_read), remove_padding(input_expected)
            )
    for description, value in {
        "input that is an object": object(),
        "input that is text": [["a"]],
        "input of 99991 columns": np.zeros((2, 99991)),
    }.items():
        check_refused(lambda value=value: data.inputs(value), [], description, worst)


def damaged_own_files(bench: Workbench, worst: Worst) -> None:
    """Check that a damaged user file raises an error that names the file."""
    for kind in DAMAGES:
        files, data = _user_files(bench)
        damage(files[0], kind)
        # the error may come only when a sample is read, since large collections are read on demand
        check_refused(
            lambda files=files, data=data: data.read(files[::-1])[len(files) - 1],
            [files[0].name],
            f"damage {kind}",
            worst,
        )


def check_refused(act: Callable[[], object], expected: Sequence[str], situation: str, worst: Worst) -> None:
    """Check that a call raises a DataError whose message contains given words and is long enough to say what to do.

    Args:
        act: The call.
        expected: Words that the message must contain.
        situation: Description of the call, for the finding.
        worst: Recorder of the largest error.
    """
    try:
        act()
    except DataError as error:
        message = " ".join(str(error).split())
        missing = [word for word in expected if word not in message]
        short = len(message) < sum(map(len, expected)) + 20
        lacks = ", ".join(missing) or "what to do" * short
        prefix = f"{situation}: the error message lacks {lacks}: " if lacks else f"{situation}: "
        worst.count(bool(lacks), prefix + message[:300])
    except TooSlow:
        raise
    except Exception as error:
        worst.record(math.inf, f"{situation}: got {type(error).__name__} ({error}), expected a DataError")
    else:
        wording = f" that says {', '.join(expected)}" if expected else ""
        worst.count(True, f"{situation}: accepted, expected a DataError{wording}")


def _user_files(bench: Workbench) -> tuple[list[Path], Data]:
    """Return the user files that the contract row writes, and a data set that is not prepared."""
    assert bench.row.files is not None
    return list(bench.row.files(bench.make_folder())), bench.build_in(bench.first)


def _read(data: Data, files: Sequence[Path], bench: Workbench, worst: Worst) -> list[Tensor]:
    """Read user files, check their samples, and return the inputs without padding."""
    with cache_in(bench.first.cache):
        split = data.read(files)
    sample_of_split = splits_by_name(bench.data)["train"][0]
    like, expected = sample_of_split["input"], bench.data.input_shape
    inputs = []
    for number, sample in samples(split):
        where = f"sample {number} of {len(files)} files"
        further = set(sample) - (set(sample_of_split) - {"target", "group"})
        lacking = {"input", "index"} - set(sample)
        worst.same(f"{where}: unexpected or missing fields", sorted(further | lacking), [])
        if lacking:
            continue
        shape = tuple(sample["input"].shape)
        # a user's cloud may have more points than those of training
        known = (len(shape) == len(expected) == 2 and shape[1:] == expected[1:]) or shape == expected
        worst.count(not known, f"{where}: input of shape {shape}, expected {expected}")
        worst.same(f"{where}: type of the input", sample["input"].dtype, like.dtype)
        worst.same(f"{where}: index", (sample["index"].dtype, int(sample["index"])), (torch.int64, number))
        inputs.append(remove_padding(sample["input"]))
    worst.count(not inputs, f"{len(files)} files gave no sample")
    return inputs
