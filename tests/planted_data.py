"""Data sets like those of other authors: correct ones, and ones with a planted fault that `mode=check` must find."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from framework.data import Batch, Data, Splits
from framework.errors import DataError
from framework.storage import cache as storage
from framework.target import Target
from framework.testing.rows import NEEDS_ROWS, DataRow
from tests.planted_base import Planted

LENGTHS = (560, 51, 450)


class Held(Dataset[Batch]):
    """Samples in memory that are read one at a time."""

    def __init__(self, **fields: Tensor) -> None:
        self.fields = fields

    def __len__(self) -> int:
        return len(self.fields["index"])

    def __getitem__(self, index: int) -> Batch:
        return {name: values[index] for name, values in self.fields.items()}


class AtOnce(Held):
    """Samples in memory that can also be read many at a time."""

    def __getitems__(self, asked: Sequence[int]) -> Batch:
        return {name: values[list(asked)] for name, values in self.fields.items()}


class Waves(Data):
    """Five values of a sine wave as input and its phase as target; raw files hold five numbers."""

    bibtex = ""
    lengths: tuple[int, ...] = LENGTHS
    kind: type[Held] = AtOnce
    seeds = (0, 1, 2)

    def __init__(self, *, noise: float = 0.01) -> None:
        self.noise = noise

    def prepare(self) -> None:
        self.target = Target("angle", ("phase",))
        self.input_shape = (5,)
        self.groups = ("waves",)
        self.synthetic = True
        self.made = [self.split(number) for number in range(3)]

    def table(self, number: int) -> tuple[Tensor, Tensor]:
        """Return inputs, (samples, 5), and targets, (samples, 1), of the split with this number."""
        random = np.random.default_rng([17, self.seeds[number]])
        phase = random.uniform(-3, 3, (self.lengths[number], 1))
        places = np.sin(phase + np.arange(5)) + self.noise * random.normal(size=(len(phase), 5))
        return torch.from_numpy(places).float(), torch.from_numpy(phase).float()

    def split(self, number: int) -> Held:
        inputs, target = self.table(number)
        index = torch.arange(len(inputs))
        return self.kind(input=inputs, target=target, index=index, group=torch.zeros_like(index))

    def splits(self) -> Splits:
        return Splits(*self.made)

    def numbers(self, file: Path) -> Tensor:
        try:
            found = [float(word) for word in file.read_text(encoding="ascii").split()]
        except (OSError, ValueError) as error:
            raise DataError(
                f"{file} cannot be read ({error}); expected five numbers. Write the file again."
            ) from error
        if len(found) != 5:
            raise DataError(f"{file} holds {len(found)} numbers; expected five. Write the file again.")
        return torch.tensor(found)

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        if not files:
            raise DataError("Got no file, but one file for each wave is required.")
        inputs = torch.stack([self.numbers(file) for file in files])
        return AtOnce(input=inputs, index=torch.arange(len(inputs)))

    def augment(self, batch: Batch) -> Batch:
        return {**batch, "input": batch["input"] + 0.01 * torch.randn_like(batch["input"])}

    def fingerprint(self) -> Mapping[str, str]:
        return {"waves": f"{self.lengths} {self.noise}"}

    def preview(self, inputs: Tensor) -> np.ndarray:
        return np.zeros((4, 4, 3), np.uint8)


class Odd(Waves):
    """Waves with few samples, an odd number of them, which are read one at a time."""

    lengths = (7, 1, 3)
    kind = Held


class Coins(Waves):
    """Coin tosses with two classes, so that many samples of a split are equal."""

    kind = Held

    def prepare(self) -> None:
        super().prepare()
        self.target = Target("class", ("low", "high"))
        self.columns = ("one", "two", "three", "four", "split")

    def table(self, number: int) -> tuple[Tensor, Tensor]:
        random = np.random.default_rng([18, number])
        faces = random.integers(0, 2, (self.lengths[number], 5))
        faces[:, 4] = number
        return torch.from_numpy(faces).float(), torch.from_numpy(faces[:, :4].sum(1) > 2).long()


class Dots(Waves):
    """Images of bytes with a bright dot, whose row and column are the target."""

    lengths = (65, 13, 14)
    size = (1, 9, 8)

    def prepare(self) -> None:
        super().prepare()
        self.target = Target("real", ("row", "column"))
        self.input_shape = self.size
        self.varies = False

    def table(self, number: int) -> tuple[Tensor, Tensor]:
        random = np.random.default_rng([19, number])
        pixels = random.integers(0, 99, (self.lengths[number], *self.size), np.uint8)
        place = np.stack([random.integers(0, side, len(pixels)) for side in self.size[1:]], -1)
        pixels[np.arange(len(pixels)), 0, place[:, 0], place[:, 1]] = 255
        return torch.from_numpy(pixels), torch.from_numpy(place).float()

    def augment(self, batch: Batch) -> Batch:
        return batch

    def numbers(self, file: Path) -> Tensor:
        raise DataError(f"{file} cannot be read; expected an image of 9 × 8 pixels. Write the file again.")


class Shuffled(Dots):
    """Images in a folder, whose file names state the target."""

    def __init__(self, *, root: str | None = None) -> None:
        super().__init__()
        self.root = root

    def table(self, number: int) -> tuple[Tensor, Tensor]:
        files = self.files(Path(self.root or "") / str(number))
        pixels = [torch.from_numpy(np.load(file)) for file in files]
        return torch.stack(pixels), torch.tensor([self.place(file, files) for file in files])

    def files(self, folder: Path) -> list[Path]:
        if not folder.is_dir():
            raise DataError(
                f"{folder}: no such folder; expected a folder of images. Set data.root to a folder that holds "
                "such files."
            )
        return sorted(folder.iterdir())

    def place(self, file: Path, files: list[Path]) -> list[float]:
        return [float(number) for number in file.stem.split("_")[1:]]

    @staticmethod
    def write(folder: Path) -> Mapping[str, Any]:
        for number in range(3):
            (folder / str(number)).mkdir()
            random = np.random.default_rng([20, number])
            for sample in range(20):
                place = random.integers(0, 8, 2)
                name = f"{sample:02d}_{place[0]}_{place[1]}.npy"
                np.save(folder / str(number) / name, random.integers(0, 256, (1, 9, 8), np.uint8))
        return {"root": str(folder)}


PLAIN = DataRow("without a rows.py", leave_out=NEEDS_ROWS)


def own_waves(folder: Path) -> list[Path]:
    files = [folder / f"{name}.txt" for name in "bac"]
    for number, file in enumerate(files):
        file.write_text(f"{number} 1 2 3 0.5", encoding="ascii")
    return files


OWN = DataRow("own files", files=own_waves, changes={"noise": 0.1})
WRITTEN = DataRow("a folder", write=Shuffled.write, synthetic=True)
RIGHT: dict[str, tuple[type[Data], DataRow]] = {
    "in memory": (Waves, PLAIN),
    "own files": (Waves, OWN),
    "an odd number": (Odd, PLAIN),
    "whole numbers": (Coins, PLAIN),
    "images": (Dots, PLAIN),
    "a folder": (Shuffled, WRITTEN),
}
"""Correct data sets and their contract-test cases."""


@dataclass(frozen=True)
class Fault(Planted):
    """A data set with one planted fault.

    Attributes:
        changes: methods and attributes of `base` that are replaced.
        samples: methods of the splits' data set that are replaced.
        base: correct data set.
        row: contract-test case of the correct data set.
    """

    changes: Mapping[str, Any] = field(default_factory=dict)
    samples: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    base: type[Waves] = Waves
    row: DataRow = PLAIN

    def build(self, config: Mapping[str, Any]) -> Data:
        return type(self.base.__name__, (self.base,), {"kind": self.kind, **self.changes})(**config)

    @cached_property
    def kind(self) -> type[Held]:
        """Class of the splits' data set; it is a name of this module, so that it can be pickled."""
        kind = type(self.name, (self.base.kind,), {**self.samples, "__module__": __name__})
        globals()[self.name] = kind
        return kind


def changed(change: Callable[[int, Tensor, Tensor], None]) -> Mapping[str, Any]:
    """Return a method `table` whose inputs and targets `change(split number, inputs, targets)` changes in place."""

    def table(data: Waves, number: int) -> tuple[Tensor, Tensor]:
        inputs, target = Waves.table(data, number)
        change(number, inputs, target)
        return inputs, target

    return {"table": table}


def nan_in_500(number: int, inputs: Tensor, target: Tensor) -> None:
    if number == 0:
        inputs[501, 2] = math.nan


def degrees_from_450(number: int, inputs: Tensor, target: Tensor) -> None:
    target[450:] = target[450:].rad2deg()


def test_again_in_training(data: Waves) -> None:
    """Copy 20 test samples to the end of the training split."""
    Waves.prepare(data)
    train, _, test = (split.fields for split in data.made)
    train["input"][-20:], train["target"][-20:] = test["input"][420:440], test["target"][420:440]


def few_for_many(number: int, inputs: Tensor, target: Tensor) -> None:
    inputs[64:] = inputs[torch.arange(len(inputs))[64:] % 64]
    target[64:] = target[torch.arange(len(target))[64:] % 64]


def neighbours_from_400(number: int, inputs: Tensor, target: Tensor) -> None:
    target[400:] = target[400:].roll(1, 0)


def counted_from_one(number: int, inputs: Tensor, target: Tensor) -> None:
    target[:] = target.roll(1, 0)


def one_for_all(number: int, inputs: Tensor, target: Tensor) -> None:
    target[:] = target[:1]


def small_index(data: Waves, number: int) -> Held:
    found = Waves.split(data, number)
    found.fields["index"] %= 256
    return found


def no_group_from_420(split: Held, index: int) -> Batch:
    sample = Held.__getitem__(split, index)
    return {name: value for name, value in sample.items() if name != "group" or index < 420}


def doubled_precision(split: Held, index: int) -> Batch:
    sample = Held.__getitem__(split, index)
    return {**sample, "target": sample["target"].double()} if index == 433 else sample


def noise_from_430(split: Held, index: int) -> Batch:
    sample = Held.__getitem__(split, index)
    return {**sample, "input": sample["input"] + 1e-3 * torch.randn(5)} if index >= 430 else sample


def sorted_beyond_64(split: AtOnce, asked: Sequence[int]) -> Batch:
    return AtOnce.__getitems__(split, sorted(asked) if len(asked) > 64 else asked)


def chunk_of_256(split: AtOnce, asked: Sequence[int]) -> Batch:
    return AtOnce.__getitems__(split, asked[:256])


def without_repeats(split: AtOnce, asked: Sequence[int]) -> Batch:
    return AtOnce.__getitems__(split, list(dict.fromkeys(asked)) if len(asked) > 24 else asked)


def targets_of_neighbours(split: AtOnce, asked: Sequence[int]) -> Batch:
    found = AtOnce.__getitems__(split, asked)
    return {**found, "target": found["target"].roll(1, 0)} if len(asked) > 100 else found


def standardised(split: AtOnce, asked: Sequence[int]) -> Batch:
    found = AtOnce.__getitems__(split, asked)
    return {**found, "input": found["input"] - found["input"].mean(0)} if len(asked) > 30 else found


def next_ones(split: AtOnce, asked: Sequence[int]) -> Batch:
    """Return consecutive samples for a batch of 64, whatever indices are requested."""
    return AtOnce.__getitems__(split, range(asked[0], asked[0] + len(asked)) if len(asked) == 64 else asked)


def a_view(split: AtOnce, asked: Sequence[int]) -> Batch:
    start, end = asked[0], asked[-1] + 1
    if list(asked) == list(range(start, end)):
        return {name: values[start:end] for name, values in split.fields.items()}
    return AtOnce.__getitems__(split, asked)


def one_buffer(split: Any, asked: Sequence[int]) -> Batch:
    found = AtOnce.__getitems__(split, asked)
    if not hasattr(split, "buffer"):
        split.buffer = torch.zeros(1500, 5)
    split.buffer[: len(asked)] = found["input"]
    return {**found, "input": split.buffer[: len(asked)]}


def one_sample(split: Any, index: int) -> Batch:
    found = Held.__getitem__(split, index)
    if not hasattr(split, "last"):
        split.last = torch.zeros(5)
    split.last.copy_(found["input"])
    return {**found, "input": split.last}


def remembered(split: Any, index: int) -> Batch:
    """Return a stored sample whose index has the same last two digits."""
    if not hasattr(split, "known"):
        split.known = {}
    return split.known.setdefault(index % 100, Held.__getitem__(split, index))


def without_the_end(split: Held) -> dict[str, Any]:
    return {
        "fields": {name: torch.cat([values[:300], values[300:] * 0]) for name, values in split.fields.items()}
    }


def floats_of_bytes(data: Dots, number: int) -> tuple[Tensor, Tensor]:
    inputs, target = Dots.table(data, number)
    return inputs.float(), target


def standard_pixels(data: Dots, number: int) -> tuple[Tensor, Tensor]:
    inputs, target = Dots.table(data, number)
    return (inputs.float() - 50) / 30, target


def as_listed(data: Shuffled, folder: Path) -> list[Path]:
    return list(folder.iterdir())


def labels_as_listed(data: Shuffled, file: Path, files: list[Path]) -> list[float]:
    """Return a target by a list of files in another order than that of the images."""
    names = [name.stem for name in file.parent.glob("*.npy")]
    return [float(number) for number in names[files.index(file)].split("_")[1:]]


def rounded_when_stored(data: Waves, number: int) -> tuple[Tensor, Tensor]:
    """Return inputs that are computed once and later read from a text file with four decimals."""
    inputs, target = Waves.table(data, number)
    file = storage.folder("waves") / f"{number}.txt"
    if file.exists():
        return torch.from_numpy(np.loadtxt(file)).float(), target
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(file, inputs.numpy(), fmt="%.4f")
    return inputs, target


KNOWN: dict[str, Tensor] = {}


def known_by_name(data: Waves, file: Path) -> Tensor:
    found = Waves.numbers(data, file)
    return KNOWN.setdefault(f"{file.stem}", found)


def every_file_once(data: Waves, files: Sequence[Path]) -> Dataset[Batch]:
    return Waves.read(data, list(dict.fromkeys(files)))


def varied_to_64(data: Waves, batch: Batch) -> Batch:
    return {name: values[:64] for name, values in Waves.augment(data, batch).items()}


def noise_of_the_cpu(data: Waves, batch: Batch) -> Batch:
    return {**batch, "input": batch["input"] + 0.01 * torch.randn(batch["input"].shape)}


def left_in_place(data: Waves, batch: Batch) -> Batch:
    """Augment the batch after computing a mask on the CPU."""
    chosen = torch.zeros(len(batch["input"]), 1)
    chosen[batch["index"] % 2 == 0] = 1.0
    return Waves.augment(data, batch)


def by_numpy(data: Waves, batch: Batch) -> Batch:
    np.sign(np.asarray(batch["input"]))
    return Waves.augment(data, batch)


BITS, FETCH, OWNED, DIFFER = (
    "same data, same bits",
    "batches equal single samples",
    "batches share no memory",
    "samples differ",
)
ALL_FAULTS = (
    Fault("a sample beyond the 500th is NaN", "samples", changed(nan_in_500)),
    Fault("an index of one byte", "samples", {"split": small_index}),
    Fault("no group from the 420th on", FETCH, samples={"__getitem__": no_group_from_420}),
    Fault("one target of another type", FETCH, samples={"__getitem__": doubled_precision}),
    Fault("degrees from the 450th on", "angles are radians", changed(degrees_from_450)),
    Fault("a leak beyond the 400th", "no sample in two splits", {"prepare": test_again_in_training}),
    Fault("sixty-four samples for all", DIFFER, changed(few_for_many)),
    Fault("one target for all", DIFFER, changed(one_for_all)),
    Fault("targets of neighbours from the 400th on", "targets go with inputs", changed(neighbours_from_400)),
    Fault("targets of neighbours", "targets go with inputs", changed(counted_from_one)),
    Fault("noise from the 430th on", BITS, samples={"__getitem__": noise_from_430}),
    Fault("images as a folder lists them", BITS, {"files": as_listed}, base=Shuffled, row=WRITTEN),
    Fault("targets as a folder lists them", BITS, {"place": labels_as_listed}, base=Shuffled, row=WRITTEN),
    Fault("rounded when stored", BITS, {"table": rounded_when_stored}),
    Fault("sorted beyond 64", FETCH, samples={"__getitems__": sorted_beyond_64}),
    Fault("no batch beyond 256", FETCH, samples={"__getitems__": chunk_of_256}),
    Fault("a sample asked twice comes once", FETCH, samples={"__getitems__": without_repeats}),
    Fault(
        "targets of neighbours in batches beyond 100", FETCH, samples={"__getitems__": targets_of_neighbours}
    ),
    Fault("standardised by its batch", FETCH, samples={"__getitems__": standardised}),
    Fault("a batch of 64 is a stretch", FETCH, samples={"__getitems__": next_ones}),
    Fault("remembered by two digits", FETCH, samples={"__getitem__": remembered}),
    Fault("a batch is a view of the data", OWNED, samples={"__getitems__": a_view}),
    Fault("one buffer for all batches", OWNED, samples={"__getitems__": one_buffer}),
    Fault("one buffer for all samples", OWNED, samples={"__getitem__": one_sample}),
    Fault("workers lose the end", "workers", samples={"__getstate__": without_the_end}),
    Fault("floats of 0 to 255", "images are 0 to 1", {"table": floats_of_bytes}, base=Dots),
    Fault("standardised pixels", "images are 0 to 1", {"table": standard_pixels}, base=Dots),
    Fault("files known by their names", "own files", {"numbers": known_by_name}, row=OWN),
    Fault("every file once", "own files", {"read": every_file_once}, row=OWN),
    Fault("varied by noise of the CPU", "on the device of its inputs", {"augment": noise_of_the_cpu}),
    Fault("samples chosen on the CPU", "on the device of its inputs", {"augment": left_in_place}),
    Fault("varied by NumPy", "on the device of its inputs", {"augment": by_numpy}),
    Fault("64 of a batch are varied", "augment", {"augment": varied_to_64}),
)
