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
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from framework.distributions.numpy_densities import Density, build


class Model:
    """An exported model: a network in model.onnx, and the family of its densities in density.json.

    Args:
        folder: folder that `mode=export` wrote.
        threads: number of processor threads of a prediction.

    Attributes:
        description: content of density.json.
    """

    def __init__(self, folder: str | Path, threads: int = 1) -> None:
        folder = Path(folder)
        self.description: dict[str, Any] = json.loads((folder / "density.json").read_text(encoding="utf-8"))
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(
            str(folder / "model.onnx"), options, providers=["CPUExecutionProvider"]
        )
        self._families: dict[str, Any] = {}
        for name in self.description["modules"]:
            self._families.update(importlib.import_module(name).FAMILIES)
        self._outputs: list[str] = self.description["outputs"]
        self._shape: list[int | str] = self.description["input"]["shape"]
        self._dtype = np.dtype(self.description["input"]["dtype"])

    def __call__(self, inputs: Any) -> Density:
        """Return the densities for a batch of inputs.

        Raises:
            ValueError: the inputs have another shape than density.json says, or a number is not finite.
        """
        return build(self.description["density"], self.parameters(inputs), self._families)

    def parameters(self, inputs: Any) -> dict[str, NDArray[Any]]:
        """Return the parameters of the densities by name; arguments and errors are those of a call."""
        array = np.asarray(inputs)
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
        with np.errstate(over="ignore"):
            array = np.ascontiguousarray(array, dtype=self._dtype)
        _require_finite(array, "inputs")
        values: list[Any] = list(self._session.run(self._outputs, {"input": array}))
        for value in values:
            _require_finite(value, "distribution parameters")
        return dict(zip(self._outputs, values, strict=True))

    def table(self, inputs: Any, interval: float | None = None) -> Iterator[dict[str, Any]]:
        """Yield a row for each input: point prediction, entropy, ends of the central interval, and prediction set.

        Args:
            inputs: inputs that a call of the model takes.
            interval: probability of the interval; None leaves its ends out. Classes have none.
        """
        density = self(inputs)
        target = self.description["target"]
        names: list[str] = target["names"]
        entropy = density.entropy()
        ends = density.interval(interval) if interval is not None and len(density.event) == 1 else None
        if not density.event:
            shares = np.exp(
                np.stack([density.log_prob(np.full(density.batch, label)) for label in range(len(names))], -1)
            )
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
            if sets is not None:
                cells["set"] = json.dumps(
                    [names[label] for label in sets[row]]
                    if not density.event
                    else [[unit * float(low), unit * float(high)] for low, high in sets[row]],
                    ensure_ascii=False,
                )
            cells["entropy_nats"] = float(entropy.value[row])
            if entropy.error[row]:
                cells["entropy_error_nats"] = float(entropy.error[row])
            yield cells


def load(folder: str | Path = Path(__file__).parent, threads: int = 1) -> Model:
    """Return the exported model in `folder`; by default the folder of this file."""
    return Model(folder, threads)


def read_csv(file: Path, columns: list[str]) -> NDArray[np.float64]:
    """Return the named columns of a CSV file with a header, (row, column).

    Raises:
        ValueError: a column is missing, or a cell is no number.
    """
    with file.open(encoding="utf-8-sig", newline="") as stream:
        reader = csv.DictReader(stream)
        missing = [name for name in columns if name not in (reader.fieldnames or ())]
        if missing:
            raise ValueError(
                f"{file} has no column {missing[0]!r}. The model reads the columns {', '.join(columns)}."
            )
        rows = []
        for line in reader:
            try:
                rows.append([float(line[name]) for name in columns])
            except (TypeError, ValueError):
                raise ValueError(
                    f"{file}, line {reader.line_num}: a cell is no number. Correct the line."
                ) from None
    return np.array(rows, dtype=np.float64).reshape(-1, len(columns))


def _require_finite(array: NDArray[Any], what: str) -> None:
    """Raise an error that names the first row with a number that is not finite."""
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        row = int((~np.isfinite(array.reshape(len(array), -1)).all(1)).argmax())
        raise ValueError(f"The {what} of row {row} are not finite. Correct the input.")


def main(arguments: Mapping[str, Any] | None = None) -> None:
    """Print the predictions for a file as CSV."""
    parser = argparse.ArgumentParser(description="Print the predictions of an exported model as CSV.")
    parser.add_argument("inputs", type=Path, help="a .npy file, or for a table a CSV file with a header")
    parser.add_argument("--interval", type=float, help="probability of a central interval, such as 0.9")
    options = parser.parse_args() if arguments is None else argparse.Namespace(**arguments)
    model = load()
    try:
        columns = model.description["input"].get("columns") or []
        if options.inputs.suffix == ".csv" and columns:
            inputs: Any = read_csv(options.inputs, columns)
        else:
            inputs = np.load(options.inputs, allow_pickle=False)
        rows = list(model.table(inputs, options.interval))
    except (OSError, ValueError) as error:
        sys.exit(str(error))
    if rows:
        writer = csv.DictWriter(sys.stdout, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def command() -> None:
    """Run `main` as a command, which may be piped into a reader that ends early, such as `head`."""
    try:
        main()
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    command()
