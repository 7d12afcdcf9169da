"""Contract tests of data sets: a correct data set passes, and each planted fault fails the test made for it."""

import itertools
import math
import os
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import torch

from framework.data import Data, Splits
from framework.datasets.fields import Fields
from framework.errors import DataError
from framework.storage import cache
from framework.storage.generated import ensure_generated, read_mark
from framework.target import Target
from framework.testing.contract import _shipped, contract
from framework.testing.data import examine_data
from framework.testing.data_folders import configured_row
from framework.testing.finding import require
from framework.testing.rows import DAMAGES, DataRow

COUNT = itertools.count()


def needle(number, seed=0):
    """Return the text of a file with the tip of a needle, and its angle."""
    angle = np.random.default_rng([seed, number]).uniform(-3, 3)
    return f"{math.cos(angle):.6f} {math.sin(angle):.6f} {angle:.6f}\n"


def draw(root, seed):
    for number in range(24):
        (root / f"{number:02d}.txt").write_text(needle(number, seed))


class Sorted(Fields):
    """Fields whose batches ignore the requested order."""

    def __getitems__(self, indices):
        return super().__getitems__(sorted(indices))


class Needles(Data):
    """Data set that is correct or has one fault."""

    bibtex = ""

    def __init__(self, *, root=None, data_seed=0, skip=False, fault=""):
        self.root, self.data_seed, self.skip, self.fault = root, data_seed, skip, fault
        if fault == "the constructor prepares":
            self.prepare()

    def prepare(self):
        if self.fault == "without a root nothing is asked for" and self.root is None:
            raise DataError("there is nothing to read; wanted something else.")
        if self.root is None or (
            self.fault == "a missing root is generated" and not Path(self.root).exists()
        ):
            mark = {"seed": self.data_seed}
            place = cache.folder("needles") / str(self.data_seed)
            root = ensure_generated(place, mark, lambda part: draw(part, self.data_seed))
        else:
            root = Path(self.root)
            if not root.is_dir():
                raise DataError(f"data.root = {root}: no such folder; wanted a folder of needles.")
        self.target = Target("angle", ("needle",))
        self.input_shape = (2,)
        self.columns = ("x", "y", "z") if self.fault == "a column too many" else ("x", "y")
        if self.fault != "no groups":
            self.groups = ("needles",)
        real = self.fault == "said to be real" and self.root is None
        self.synthetic = not real and (read_mark(root) is not None or self.fault == "the mark is ignored")
        self.varies = self.fault != "said not to vary"
        numbers, faults = [], 0
        for name in (f"{number:02d}.txt" for number in range(24)):
            try:
                numbers.append(self.line(root / name, 3))
            except DataError:
                if not self.skip:
                    raise
                faults += 1
        self.skipped = 0 if self.fault == "nothing is counted" else faults
        table = torch.tensor(numbers)
        if self.fault == "another unit in a root" and self.root is not None:
            table[:, :2] *= 100
        if self.fault == "degrees":
            table[:, 2] = table[:, 2].rad2deg()
        if self.fault == "a label that is not finite":
            table[3, 2] = math.nan
        order = np.random.default_rng(self.data_seed).permutation(len(table))
        if self.fault == "noise of the run":
            order = np.random.permutation(order)  # noqa: NPY002
        cuts = torch.from_numpy(order).split([len(order) - 12, 6, 6])
        if self.fault == "a leak":
            cuts = (cuts[0], torch.cat([cuts[1], cuts[0][:1]]), cuts[2])
        self.tables = [self.fields(table[cut]) for cut in cuts]

    def line(self, file, count):
        try:
            numbers = [float(word) for word in file.read_text(encoding="ascii").split()]
            if len(numbers) != count:
                raise ValueError(f"{len(numbers)} numbers, wanted {count}")
        except (OSError, ValueError) as error:
            if self.fault == "bad files are zeros" or (
                self.fault == "bad own files are zeros" and count == 2
            ):
                return [0.0] * count
            if self.fault == "an error of Python's":
                raise
            name = "a file" if self.fault == "bad files have no name" else file
            remedy = (
                "Mend it." if self.fault == "the remedy is not named" else "Mend it, or set data.skip=true."
            )
            raise DataError(f"{name} cannot be read ({error}); wanted {count} numbers. {remedy}") from error
        return numbers

    def fields(self, table):
        made = Sorted if self.fault == "batches are sorted" else Fields
        first = 1 if self.fault == "counted from one" else 0
        found = made(
            input=table[:, :2].clone(),
            target=table[:, 2:].clone(),
            index=torch.arange(len(table)) + first,
            group=torch.zeros(len(table), dtype=torch.int64),
        )
        if self.fault == "no worker can have it":
            found.fetch = lambda index: index
        return found

    def splits(self):
        return Splits(*self.tables)

    def state_dict(self):
        return {"moment": datetime(2020, 1, 1)} if self.fault == "a state that is not plain" else {}

    def inputs(self, user_data):
        if self.fault == "anything is an input":
            return torch.zeros(1, 2)
        return Data.inputs(self, user_data)

    def read(self, files):
        if self.fault == "read wants prepare":
            assert self.input_shape == (2,)
        if self.fault == "read sorts":
            files = sorted(files)
        if not files and self.fault != "no file is not a sample":
            raise DataError("no file was given; wanted one for each needle.")
        points = torch.tensor([self.line(Path(file), 2) for file in files]).reshape(-1, 2)
        if self.fault == "the scaling stays behind" and hasattr(self, "tables"):
            points = points / self.tables[0].fields["input"].std(0)
        if self.fault == "read doubles":
            points = points.double()
        more = {"target": points[:, :1]} if self.fault == "read guesses the target" else {}
        return Fields(input=points, index=torch.arange(len(points)), **more)

    def augment(self, batch):
        if self.fault == "half of the batch":
            return {name: value[::2] for name, value in batch.items()}
        if self.fault == "a field is lost":
            return {name: value for name, value in batch.items() if name != "group"}
        inputs = batch["input"]
        noise = torch.randn(inputs.shape, device=inputs.device)
        if self.fault == "noise of numpy's":
            noise = torch.from_numpy(np.random.randn(*inputs.shape)).float()  # noqa: NPY002
            noise = noise.to(inputs.device)
        if self.fault == "noise of one type alone":
            noise = inputs.lerp(noise, torch.rand(len(inputs), 1, dtype=torch.float32, device=inputs.device))
        return {**batch, "input": inputs + 0.01 * noise}

    def fingerprint(self):
        if self.fault == "one fingerprint":
            return {"name": "needles"}
        if self.fault == "a fingerprint of its own":
            return {"name": f"needles {next(COUNT)}"}
        seed = self.data_seed if self.fault == "numbers in the fingerprint" else str(self.data_seed)
        return {"root": str(self.root), "data_seed": seed}

    def preview(self, inputs):
        canvas = np.zeros((8, 8, 3), np.float64 if self.fault == "pictures of floats" else np.uint8)
        if self.fault == "pictures change the input":
            inputs.zero_()
        return canvas[..., 0] if self.fault == "grey pictures" else canvas


def files(folder):
    found = []
    for number in (3, 1, 2):
        found.append(folder / f"own{number}.txt")
        found[-1].write_text(f"0.{number}2345 0.5\n")
    return found


def written(folder):
    draw(folder, 5)
    return {"root": str(folder)}


ROW = DataRow(
    "needles",
    synthetic=True,
    files=files,
    fragile={"*.txt": DAMAGES},
    skip={"skip": True},
    changes={"data_seed": 1},
)
REAL = DataRow("real", write=written, synthetic=False, files=files, fragile={"03.txt": DAMAGES})


def findings(row, fault=""):
    return list(examine_data(row, lambda config: Needles(fault=fault, **config)))


def failed(row, fault=""):
    return {finding.name for finding in findings(row, fault) if not finding.holds}


def test_a_sound_data_set_passes_generated_or_from_a_root() -> None:
    names = [finding.name for finding in findings(ROW)]
    assert len(names) == 23
    require(*findings(ROW))
    real = findings(REAL)
    assert {"missing root", "damaged files are named"} <= {finding.name for finding in real}
    require(*real)


@pytest.mark.parametrize("fault", ["said to be real", "without a root nothing is asked for"])
def test_without_a_root_data_are_asked_for_or_generated_and_said_to_be(fault: str) -> None:
    assert failed(REAL, fault) == {"missing root"}


FAULTS = {
    "the constructor prepares": "constructor reads nothing",
    "no groups": "attributes",
    "a column too many": "attributes",
    "counted from one": "samples",
    "a label that is not finite": "samples",
    "degrees": "angles are radians",
    "a leak": "no sample in two splits",
    "noise of the run": "same data, same bits",
    "batches are sorted": "batches equal single samples",
    "one fingerprint": "fingerprint",
    "a fingerprint of its own": "fingerprint",
    "numbers in the fingerprint": "fingerprint",
    "said to be real": "synthetic is stated",
    "the mark is ignored": "official layout read back",
    "another unit in a root": "official layout read back",
    "a missing root is generated": "missing root",
    "bad files are zeros": "damaged files are named",
    "bad files have no name": "damaged files are named",
    "an error of Python's": "damaged files are named",
    "nothing is counted": "files left out are counted",
    "the remedy is not named": "files left out are counted",
    "pictures of floats": "pictures",
    "grey pictures": "pictures",
    "pictures change the input": "pictures",
    "said not to vary": "augment",
    "half of the batch": "augment",
    "a field is lost": "augment",
    "noise of numpy's": "augment",
    "noise of one type alone": "augment",
    "no worker can have it": "workers",
    "read wants prepare": "own files",
    "read sorts": "own files",
    "read doubles": "own files",
    "no file is not a sample": "own files",
    "read guesses the target": "own files",
    "bad own files are zeros": "damaged own files are named",
    "the scaling stays behind": "raw input",
    "a state that is not plain": "raw input",
    "anything is an input": "raw input",
}
ALSO = {
    "the constructor prepares": {"raw input"},  # nothing of the data is at hand where a model is used
    "no groups": {"samples"},
    "noise of the run": {"official layout read back"},
    "said to be real": {"missing root"},  # real data have to be asked for
    "a label that is not finite": {"angles are radians", "augment"},
    "bad files are zeros": {"files left out are counted", "damaged own files are named"},
    "bad files have no name": {"damaged own files are named"},
    "an error of Python's": {"files left out are counted", "damaged own files are named"},
    "pictures change the input": {"official layout read back", "workers"},
    "read wants prepare": {"damaged own files are named"},
    "the scaling stays behind": {"own files"},
}
"""Further contract tests that a planted fault breaks."""


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_found_by_its_property(fault: str) -> None:
    found = failed(ROW, fault)
    assert FAULTS[fault] in found
    assert found - {FAULTS[fault]} <= ALSO.get(fault, set()), found


def test_what_cannot_be_prepared_is_examined_no_further() -> None:
    (only,) = findings(DataRow("nowhere", {"root": "/nowhere"}))
    assert (only.name, only.holds) == ("attributes", False)
    assert "no such folder" in only.worst


def test_a_pattern_that_no_file_has_is_the_rows_fault() -> None:
    (found,) = (
        finding
        for finding in findings(DataRow("rows", fragile={"*.csv": ("missing",)}))
        if finding.name == "damaged files are named"
    )
    assert "'*.csv' of `fragile` matches no file" in found.worst


def test_the_users_cache_is_left_alone(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path))
    require(*findings(ROW))
    assert not list(tmp_path.iterdir())
    assert os.environ["FRAMEWORK_CACHE"] == str(tmp_path)
    monkeypatch.delenv("FRAMEWORK_CACHE")
    next(iter(examine_data(ROW, lambda config: Needles(**config))))
    assert "FRAMEWORK_CACHE" not in os.environ


def test_a_users_own_root_is_read_and_never_damaged() -> None:
    row = configured_row(ROW, {"root": "/own", "data_seed": 0})
    assert row.config == {"root": "/own", "data_seed": 0}
    assert (row.fragile, row.skip, row.changes, row.synthetic, row.files) == ({}, {}, {}, None, None)
    assert configured_row(ROW, {"data_seed": 1}).changes == {}  # which would change nothing
    row = configured_row(REAL, {"data_seed": 3})
    assert (row.write, row.fragile) == (written, {"03.txt": DAMAGES})


def test_rows_stand_beside_the_class_or_in_its_familys_folder(tmp_path, monkeypatch) -> None:
    row = "from framework.testing.rows import DataRow, MetricRow\nfrom framework.target import Target\n"
    ofmetric = 'MetricRow("", Target("real", ("x",)))'
    for place, text in {
        "kin/data/rows.py": "raise RuntimeError('of the drawer, and nobody's')",
        "kin/data/family/rows.py": row
        + 'ROWS = {name: (DataRow(f"{name} of all"),) for name in ("one", "two")}',
        "kin/data/family/first/rows.py": row
        + f'ROWS = {{"one": (DataRow("one alone"),), "two": ({ofmetric},)}}',
        "kin/data/lonely/data.py": "",
    }.items():
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)

    def shipped(name, module):
        monkeypatch.setattr("framework.testing.contract.load", lambda group, name: Needles)
        monkeypatch.setattr(Needles, "__module__", module)
        return [row.name for row in _shipped("data", name)]

    assert shipped("one", "kin.data.family.first.data") == ["one alone"]
    assert shipped("two", "kin.data.family.first.data") == ["two of all"]
    assert shipped("two", "kin.data.family.second") == ["two of all"]
    assert shipped("one", "kin.data.lonely.data") == []


def test_parameters_of_a_shipped_data_set_stand_beside_those_of_its_first_row(tmp_path) -> None:
    first, *shipped = contract("data", "moons", {"noise": 0.2}).rows
    assert (first.name, *shipped) == ("as configured", *contract("data", "moons").rows)
    assert first.config == {**shipped[0].config, "noise": 0.2}
    assert contract("data", "moons", {}).rows == tuple(shipped)
