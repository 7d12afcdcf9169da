"""Predictions of an exported model, with NumPy and ONNX Runtime alone.

In Python, `load` returns the model of a folder, and `model(inputs)` the densities of a batch:

    from predict import load

    model = load("/path/to/this/folder")
    density = model(rows)              # inputs as density.json describes them, batch dimension first
    density.mode(), density.median(), density.entropy(), density.interval(0.9)

From a terminal, `python predict.py inputs.npy` or `python predict.py rows.csv` prints one line of CSV for each input.
"""

import argparse
import csv
import importlib
import json
import math
import os
import re
import sys
import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from framework.datasets.input_ranges import describe_far, is_far
from framework.distributions.numpy_densities import Density, arc_hull, build, hull

MOST_POINTS = 2**13
"""Largest number of points that the network reads at once; more points do not fit into the caches."""
CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
"""Pattern of characters that control a terminal, or change the direction of a text."""
FORMULA = re.compile(
    "(^|[;,\t\r\n])((?:[^\\S\t\r\n]|[\ufeff\u200b-\u200f\u2060])*+)([=+\\-@＝＋－＠])(?=[^;,\t\r\n]*[(|!])"
)
"""Pattern of a formula that calls a function or a program, at the start of a cell for any separator of cells."""


class Model:
    """An exported model: a network in model.onnx, and the family of its densities in density.json.

    Args:
        folder: folder that `mode=export` wrote.
        threads: number of processor threads of a prediction.

    Attributes:
        description: content of density.json.
        ranges: smallest and largest number of each column of a table in the training rows, or None.
    """

    def __init__(self, folder: str | Path, threads: int = 1) -> None:
        folder = Path(folder)
        self.description: dict[str, Any] = json.loads((folder / "density.json").read_text(encoding="utf-8"))
        modules = self.description["modules"]
        # density.json may come from another person, and importing a module runs its code
        beside = {path.stem for path in Path(__file__).parent.glob("*.py")}
        if foreign := [name for name in modules if name not in beside]:
            raise ValueError(
                f"{folder} names the module {foreign[0]!r}, which is not beside {__file__}. Use the predict.py of the "
                "folder itself, if you trust its files."
            )
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(
            str(folder / "model.onnx"), options, providers=["CPUExecutionProvider"]
        )
        self._families: dict[str, Any] = {}
        for name in modules:
            self._families.update(importlib.import_module(name).FAMILIES)
        self._outputs: list[str] = self.description["outputs"]
        self._shape: list[int | str] = self.description["input"]["shape"]
        self._cloud = "points" in self._shape
        self._noise: list[dict[str, Any]] = self.description.get("noise", [])
        self._random_of_seed: dict[int, list[NDArray[Any]]] = {}
        self._dtype = np.dtype(self.description["input"]["dtype"])
        self._fills = "missing" in self.description["input"]
        bounds = [self.description["input"].get(name) for name in ("low", "high")]
        self.ranges: list[NDArray[Any]] | None = (
            None if None in bounds else [np.asarray(bound, np.float64) for bound in bounds]
        )

    def __call__(self, inputs: Any, seed: int = 0) -> Density:
        """Return the densities for a batch of inputs.

        Args:
            inputs: an array as density.json describes it, batch dimension first; point clouds also as a list of arrays
                of different lengths. Rows of NaN at the end of a cloud are padding.
            seed: seed of the random numbers of a model that draws some. These numbers are the same for all inputs, so
                that a prediction does not depend on the other inputs.

        Raises:
            ValueError: the inputs have another shape than density.json says, or a number is not finite.
        """
        return build(self.description["density"], self.parameters(inputs, seed), self._families)

    def parameters(self, inputs: Any, seed: int = 0) -> dict[str, NDArray[Any]]:
        """Return the parameters of the densities by name; arguments and errors are those of a call of the model."""
        array = self._array(inputs)
        at_once = max(1, MOST_POINTS // max(1, array.shape[1])) if self._cloud else max(1, len(array))
        parts = [array[start : start + at_once] for start in range(0, len(array), at_once)] or [array]
        runs = [
            self._session.run(self._outputs, {"input": part} | self._random(len(part), seed))
            for part in parts
        ]
        values: list[Any] = (
            list(runs[0])
            if len(runs) == 1
            else [np.concatenate(outputs) for outputs in zip(*runs, strict=True)]
        )
        for value in values:
            _require_finite(value, "distribution parameters")
        return dict(zip(self._outputs, values, strict=True))

    def far(self, inputs: Any) -> NDArray[np.bool_]:
        """Return which numbers of a table lie far outside the training rows, so that a prediction is not reliable.

        A number is far outside if it lies beyond the range of its column in the training rows by more than the width
        of this range. A missing number is not far outside.

        Args:
            inputs: inputs that a call of the model takes.

        Returns:
            Array (row, column).

        Raises:
            ValueError: density.json holds no ranges, because the model reads no table or was exported by an older
                version; or a call of the model would refuse the inputs.
        """
        if self.ranges is None:
            raise ValueError(
                "density.json holds no ranges of the training rows. Only models of tables have them; export a model "
                "again that an older version exported."
            )
        return is_far(self._array(inputs), *self.ranges)

    def _array(self, inputs: Any) -> NDArray[Any]:
        """Return inputs as an array of the type and shape that the network reads, checked."""
        array = padded(inputs) if self._cloud else np.asarray(inputs)
        if self._fills and array.dtype.kind == "O":
            array = _as_floats(array)  # None is a missing number
        if array.dtype.kind not in "buif":
            raise ValueError(
                f"Got inputs of type {array.dtype}, but numbers are required. Give an array of numbers."
            )
        wanted = ", ".join(map(str, self._shape))
        fits = array.ndim == len(self._shape) and all(
            isinstance(want, str) or size == want
            for size, want in zip(array.shape, self._shape, strict=False)
        )
        if not fits:
            raise ValueError(
                f"Got inputs of shape {array.shape}, but the model reads inputs of shape ({wanted})."
            )
        if self._dtype == np.uint8 and array.dtype != np.uint8:
            _require_bytes(array)
        with np.errstate(over="ignore"):
            array = np.ascontiguousarray(array, dtype=self._dtype)
        if self._cloud:
            _require_clouds(array)
        else:
            _require_finite(np.where(np.isnan(array), 0, array) if self._fills else array, "inputs")
        return array

    def _random(self, count: int, seed: int) -> dict[str, NDArray[Any]]:
        """Return the random numbers that the network reads for `count` inputs, by name."""
        if not self._noise:
            return {}
        if seed not in self._random_of_seed:
            generator = np.random.default_rng(seed)
            self._random_of_seed = {seed: [_draw(entry, generator) for entry in self._noise]}
        repeats = [
            tuple(count if isinstance(size, str) else 1 for size in entry["shape"]) for entry in self._noise
        ]
        return {
            entry["name"]: np.tile(numbers, repeat)
            for entry, numbers, repeat in zip(self._noise, self._random_of_seed[seed], repeats, strict=True)
        }

    def table(self, inputs: Any, interval: float | None = None) -> Iterator[dict[str, Any]]:
        """Yield a row for each input: point prediction, entropy, and the ends of the interval or the prediction set.

        The columns are named as those of `mode=predict`. A model with prediction sets has no other intervals: a row
        then holds the set of the input, its size, and for one number the lowest and the highest end of the set. An end
        may be infinite; the ends of an empty set are NaN.

        Args:
            inputs: inputs that a call of the model takes.
            interval: probability of the central interval; None leaves its ends out. For a model with prediction sets,
                only the stated probability of the sets is accepted.

        Raises:
            ValueError: an interval is requested, but the model predicts classes or images, which have none, or
                prediction sets that do not give an interval of this probability.
        """
        density = self(inputs)
        target = self.description["target"]
        names: list[str] = target["names"]
        entropy = density.entropy()
        if interval is not None:
            _require_interval(density, interval)
        ends = None if interval is None or density.has_sets else density.interval(interval)
        if not density.event:
            shares = density.probabilities
        point = density.mode() if not density.event else density.median()
        sets = density.parts() if math.prod(density.event) == 1 else None
        unit = math.degrees(1) if target["kind"] == "angle" else 1.0
        mark = "_deg" if target["kind"] == "angle" else ""
        for row in range(len(point)):
            cells: dict[str, Any] = {}
            if not density.event:
                cells["class"] = names[int(point[row])]
                cells |= {f"p_{name}": float(share) for name, share in zip(names, shares[row], strict=True)}
            elif len(density.event) == 1:
                for column, name in enumerate(names):
                    cells[name + mark] = unit * float(point[row, column])
                    if ends is not None:
                        cells[f"{name}_low{mark}"] = unit * float(ends.low[row, column])
                        cells[f"{name}_high{mark}"] = unit * float(ends.high[row, column])
            if sets is not None and not density.event:
                labels = [names[label] for label in sets[row]]
                cells |= {"set": json.dumps(labels, ensure_ascii=False), "set_size": float(len(labels))}
            elif sets is not None:
                pairs = [(unit * float(low), unit * float(high)) for low, high in sets[row]]
                low, high = arc_hull(pairs) if density.circular else hull(pairs)
                cells |= {f"{names[0]}_low{mark}": low, f"{names[0]}_high{mark}": high}
                cells[f"{names[0]}_set{mark}"] = json.dumps(pairs)
                cells[f"set_size{mark}"] = sum(end - start for start, end in pairs)
            cells["entropy_nats"] = float(entropy.value[row])
            if entropy.error[row]:
                cells["entropy_error_nats"] = float(entropy.error[row])
            yield cells


def _require_interval(density: Density, interval: float) -> None:
    """Raise an error if the model gives no intervals, or has prediction sets that do not give the requested one."""
    if len(density.event) != 1:
        kind = "images" if density.event else "classes"
        raise ValueError(
            f"Got the interval {interval:g}, but the model predicts {kind}, which have no central interval. Leave "
            "the interval out."
        )
    if not density.has_sets:
        return
    stated = density.stated_probability
    if stated is None or density.event != (1,):
        raise ValueError(
            f"Got the interval {interval:g}, but the model predicts sets, which do not have the ends of such an "
            "interval. Leave the interval out."
        )
    if not math.isclose(stated, interval, abs_tol=1e-9):
        raise ValueError(
            f"Got the interval {interval:g}, but the model predicts sets that contain the target with probability "
            f"{stated:g}; intervals of another probability have no such guarantee. Give the interval {stated:g}, or "
            "leave it out; the columns of the sets are always printed."
        )


def load(folder: str | Path = Path(__file__).parent, threads: int = 1) -> Model:
    """Return the exported model in `folder`; by default the folder of this file.

    Args:
        folder: folder that `mode=export` wrote.
        threads: number of processor threads of a prediction.
    """
    return Model(folder, threads)


def read_array(file: Path, shape: list[Any]) -> NDArray[Any]:
    """Return the array in a .npy file; `shape` is the shape of the model's inputs, for the message.

    Raises:
        ValueError: the file is not a .npy file of numbers.
    """
    try:
        with file.open("rb") as stream:
            array = np.load(stream, allow_pickle=False)
    except (ValueError, EOFError, zipfile.BadZipFile):
        array = None
    if not isinstance(array, np.ndarray):
        sizes = ", ".join(map(str, shape))
        raise ValueError(
            f"{file} is not an array that numpy.save wrote. Save an array of the shape ({sizes}) with numpy.save. CSV "
            "files are read only for a model of a table."
        )
    return array


def _as_floats(array: NDArray[Any]) -> NDArray[Any]:
    """Return an array of objects as numbers, NaN for None; unchanged if an object is no number."""
    try:
        return array.astype(np.float64)
    except (TypeError, ValueError):
        return array


def read_csv(file: Path, columns: list[str], missing: Sequence[str] = ()) -> NDArray[np.float64]:
    """Return the named columns of a CSV file with a header, (row, column).

    A column `name=word` that the file does not have is 1 where the column `name` holds the word, and 0 elsewhere. A
    word that belongs to none of these columns is reported on the error stream. The column `name=` is 1 where a number
    of the column `name` is missing.

    Args:
        file: the file.
        columns: names of the columns.
        missing: words, in small letters, that mark a missing number, which is NaN in the array; () if none may be
            missing.

    Raises:
        ValueError: a column is missing, or a cell is not a number.
    """

    def value(cell: str | None, name: str, word: str | None) -> float:
        if cell is None:
            raise ValueError(f"the line has no cell in the column {name!r}. Correct the line.")
        cell = cell.strip()
        is_hole = cell.lower() in missing
        if word is not None:
            return float(cell == word if word else is_hole)
        try:
            return math.nan if is_hole else float(cell)
        except ValueError:
            raise ValueError(
                f"the column {name!r} holds {cell[:40]!r}, which is not a number. Write numbers with a decimal point, "
                "without separators of thousands."
            ) from None

    with file.open(encoding="utf-8-sig", newline="") as stream:
        reader = csv.DictReader(stream)
        header = reader.fieldnames or ()
        sources = [_source_of(name, header) for name in columns]
        if None in sources:
            if len(header) == 1 and re.search(r"[;\t|]", header[0]):
                raise ValueError(
                    f"{file} has one column, {header[0][:80]!r}. Separate the columns by commas, and write numbers "
                    "with a decimal point."
                )
            raise ValueError(
                f"{file} has no column {columns[sources.index(None)]!r}. The model reads the columns "
                f"{', '.join(columns)}. A column such as colour=red is read from a column of words, colour."
            )
        words: dict[str, set[str]] = {}
        for name, word in filter(None, sources):
            if word:
                words.setdefault(name, set()).add(word)
        rows, unknown = [], Counter[tuple[str, str]]()
        for line in reader:
            try:
                rows.append([value(line[name], name, word) for name, word in filter(None, sources)])
                unknown.update(
                    (name, cell) for name in words if (cell := line[name].strip()) not in words[name]
                )
            except ValueError as error:
                raise ValueError(f"{file}, line {reader.line_num}: {error}") from None
    for (name, cell), count in unknown.items():
        sys.stderr.write(
            f"{file}: the model does not know the word {cell!r} of the column {name!r} ({count} rows); it is read as "
            "none of the known words.\n"
        )
    return np.array(rows, dtype=np.float64).reshape(-1, len(columns))


def _source_of(name: str, header: Sequence[str]) -> tuple[str, str | None] | None:
    """Return the column of a file from which the column `name` is read, and the word that counts as 1, if any.

    The result is None if the file has no such column.
    """
    if name in header:
        return name, None
    column, sign, word = name.partition("=")
    return (column, word) if sign and column in header else None


def padded(clouds: Any) -> NDArray[Any]:
    """Return point clouds as one array (batch, points, column); smaller clouds end with rows of NaN.

    Raises:
        ValueError: the clouds have different numbers of columns, or are not arrays of numbers.
    """
    if isinstance(clouds, np.ndarray):
        return clouds
    try:
        arrays = [np.asarray(cloud, dtype=np.float64) for cloud in clouds]
    except (TypeError, ValueError, OverflowError):
        raise ValueError("A cloud is not an array of numbers (point, column). Correct the input.") from None
    if not arrays or any(array.ndim != 2 or array.shape[1:] != arrays[0].shape[1:] for array in arrays):
        raise ValueError("Clouds must be arrays of numbers (point, column), all with the same columns.")
    shape = (len(arrays), max(len(array) for array in arrays), arrays[0].shape[1])
    result = np.full(shape, np.nan)
    for row, array in zip(result, arrays, strict=True):
        row[: len(array)] = array
    return result


def _draw(entry: Mapping[str, Any], generator: np.random.Generator) -> NDArray[Any]:
    """Return the random numbers for one input."""
    shape = [size if isinstance(size, int) else int(size.partition(" ")[0]) for size in entry["shape"]]
    dtype = np.dtype(entry["dtype"])
    if entry["kind"] == "uniform":
        # rounding to float32 may give 1, which is not a number of the interval
        return np.minimum(generator.random(shape).astype(dtype), np.nextafter(dtype.type(1), dtype.type(0)))
    return generator.standard_normal(shape).astype(dtype)


def _require_clouds(array: NDArray[Any]) -> None:
    """Raise an error that names the first cloud without points, or with a number that is not finite."""
    with np.errstate(over="ignore"):
        if np.isfinite(array.sum()) and array.shape[1]:
            return
    padding: Any = np.isnan(array).all(-1)
    count = array.shape[1] - np.argmin(padding[:, ::-1], axis=1) if array.shape[1] else 0
    empty = padding.all(1)
    if empty.any():
        raise ValueError(f"Cloud {int(empty.argmax())} has no point. Leave it out.")
    bad: Any = ~np.isfinite(array).all(-1) & (np.arange(array.shape[1]) < np.reshape(count, (-1, 1)))
    if bad.any():
        row = int(np.argmax(bad.any(axis=1)))
        raise ValueError(
            f"Point {int(np.argmax(bad[row]))} of cloud {row} is not finite; rows of NaN are allowed at the end of a "
            "cloud only. Correct the input."
        )


def _require_bytes(array: NDArray[Any]) -> None:
    """Raise an error if numbers of an image are not integers from 0 to 255."""
    with np.errstate(invalid="ignore"):
        if not ((array >= 0) & (array <= 255) & (array == np.floor(array))).all():
            raise ValueError("The pixels of images must be integers from 0 to 255.")


def _require_finite(array: NDArray[Any], name: str) -> None:
    """Raise an error if a number of the array `name` is not finite; the message names the first such row."""
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        row = int((~np.isfinite(array.reshape(len(array), -1)).all(1)).argmax())
        raise ValueError(f"The {name} of row {row} are not finite. Correct the input.")


def main(arguments: Mapping[str, Any] | None = None) -> None:
    """Print the predictions for a file as CSV."""
    parser = argparse.ArgumentParser(description="Print the predictions of an exported model as CSV.")
    parser.add_argument("inputs", type=Path, help="a .npy file, or for a table a CSV file with a header")
    parser.add_argument("--interval", type=float, help="probability of an interval, such as 0.9")
    options = parser.parse_args() if arguments is None else argparse.Namespace(**arguments)
    model = load()
    try:
        columns = model.description["input"].get("columns") or []
        if options.inputs.suffix.lower() == ".csv" and columns:
            inputs = read_csv(options.inputs, columns, model.description["input"].get("missing", ()))
        else:
            inputs = read_array(options.inputs, model.description["input"]["shape"])
        rows = list(model.table(inputs, options.interval))
        if model.ranges is not None:
            names = [plain_text(repr(name)) for name in columns or range(inputs.shape[1])]
            if sentence := describe_far(names, np.asarray(inputs), *model.ranges):
                sys.stderr.write(f"{options.inputs}: {sentence}.\n")
    except (OSError, ValueError) as error:
        sys.exit(str(error))
    if rows:
        writer = csv.DictWriter(sys.stdout, list(rows[0]), lineterminator="\n")
        writer.writerow({name: plain_text(name) for name in writer.fieldnames})
        writer.writerows({name: plain_text(cell) for name, cell in row.items()} for row in rows)


def plain_text(cell: Any) -> Any:
    """Return a text that steers no terminal, and in which a spreadsheet finds no formula; return numbers unchanged.

    The names of classes and columns may come from another person. An apostrophe before a formula makes it plain text.
    """
    if not isinstance(cell, str):
        return cell
    text = CONTROL.sub(lambda letter: repr(letter[0])[1:-1], cell)
    return FORMULA.sub(r"\1\2'\3", text)


def command() -> None:
    """Run `main` as a command, which may be piped into a reader that ends early, such as `head`."""
    try:
        main()
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    command()
