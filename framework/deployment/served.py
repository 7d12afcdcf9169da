"""A checkpoint of a run as a model of MLflow.

`mlflow.pyfunc.load_model` and `mlflow models serve` load it by this module. A request may come from anyone. Text in it
is always the content of a file in base64, never the name of a file on this machine.
"""

import base64
import binascii
import json
import logging
import re
from collections.abc import Iterator, Sequence
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, final

import numpy as np
import pandas as pd
import torch
from PIL import Image

from framework.configuration.description import Description
from framework.configuration.loading import load_with_description, read_batch, reader
from framework.data import Batch, Data
from framework.datasets.png import encode_png
from framework.deployment.request_bodies import MOST_CONTENT, MOST_FILES, MOST_INPUTS, MOST_ROWS
from framework.deployment.request_bounds import TICKET, bound_server
from framework.distributions.noise import Draw
from framework.errors import DataError, UserError, quote, shorten
from framework.evaluation.prediction_sets import set_columns
from framework.evaluation.splits import BLOCK, predict
from framework.model import Predictor
from framework.prediction import named_columns, table_columns

CONTENT, NAME = "base64", "name"
"""Columns of a request with files: the files' bytes, and their names, if the kind of file depends on the name."""

_log = logging.getLogger(__name__)


@final
class Served:
    """Function from raw input to a table of predictions: the numbers of `mode=predict`, and the modes."""

    def __init__(self, predictor: Predictor, description: Description, data: Data) -> None:
        self.predictor, self.description, self.data = predictor, description, data

    def predict(self, given: Any, params: object = None) -> pd.DataFrame:
        """Return the same as `answer`; MLflow calls it.

        An error becomes an MlflowException, because MLflow's server sends a client only the sentence of such an error.
        """
        ticket = TICKET.get()
        if ticket is not None:
            ticket.remarks = self.description.remarks
        try:
            return self.answer(given)
        except UserError as error:
            # The client must not see the path of the checkpoint on the server.
            sentence = shorten(str(error).replace(self.description.path, "the served model"), 1000)
            reason: Exception = error
        except Exception as error:
            if ticket is None:
                raise
            _log.exception("A request could not be answered.")
            sentence = "The model cannot predict for what the request holds. Compare its rows with the training data."
            reason = error
        if ticket is not None:
            ticket.sentence = ticket.sentence or sentence
        from mlflow.exceptions import INVALID_PARAMETER_VALUE, MlflowException

        raise MlflowException(sentence, INVALID_PARAMETER_VALUE) from reason

    @torch.no_grad()
    def answer(self, given: Any) -> pd.DataFrame:
        """Return a table with one row per sample, and with the set that the model predicts (`set_columns`).

        An image is a PNG in base64. The remarks that `mode=predict` prints about the sets are in `attrs["remarks"]` of
        the table.

        Args:
            given: inputs as the model of `framework.load` takes them, but files only as `pathlib.Path`; or the content
                of files: a DataFrame with the column "base64" (and "name", whose suffix tells the kind of file), or
                texts in base64.

        Raises:
            DataError: `given` is none of these.
        """
        asked = self._asked(given)
        require_few(len(asked["input"]), asked["input"].numel())
        ticket = TICKET.get()
        seed, samples = (self.description.settings.get(key, other) for key, other in _DEFAULTS.items())
        parts = []
        for number, rows in enumerate(torch.arange(len(asked["input"])).split(BLOCK)):
            if ticket is not None:
                ticket.require_time()
            block = {name: values[rows] for name, values in asked.items()}
            prediction = predict(self.predictor, block, samples, Draw(seed, number))
            prediction = prediction.in_frame(self.data.frame(block))
            target = self.description.target
            found = table_columns(target, prediction)
            if target.kind == "image":
                pictures = [
                    base64.b64encode(encode_png(light)).decode() for light in prediction.image("color")
                ]
                parts.append(
                    pd.DataFrame({"png": pictures, **{key: one.numpy() for key, one in found.items()}})
                )
                continue
            mode = prediction.density.mode
            if target.kind == "class":
                labels = {"class": [target.names[label] for label in mode.tolist()]}
            else:
                labels, found = {}, {**found, **named_columns(target, mode, "_mode")}
            numbers = {key: column.numpy() for key, column in found.items()}
            parts.append(pd.DataFrame({**labels, **numbers, **set_columns(target, prediction)}))
        table = pd.concat(parts, ignore_index=True)
        table.attrs["remarks"] = list(self.description.remarks)
        return table

    def warm_up(self) -> None:
        """Predict once for generated samples, so that no later prediction waits for imports and compilation."""
        for sample in self.made_up():
            try:
                self.answer(sample)
            except Exception as error:  # this data set does not take the sample
                _log.debug("A made-up sample was refused: %s", shorten(error))

    def made_up(self) -> Iterator[Any]:
        """Yield samples as a request may hold them: rows, or files of each kind that the data set reads."""
        columns, shape = self.data.columns, self.data.input_shape
        if columns and len(shape) == 1:
            yield pd.DataFrame([[0.0] * len(columns)] * 2, columns=list(columns))
        for suffix in self.data.suffixes:
            content = made_up_file(suffix, columns)
            if content is not None:
                yield pd.DataFrame({CONTENT: [base64.b64encode(content).decode()], NAME: [f"sample{suffix}"]})

    def _asked(self, given: Any) -> Batch:
        """Return the batch of a request."""
        if isinstance(given, pd.DataFrame) and CONTENT in given.columns and CONTENT not in self.data.columns:
            if not given.columns.is_unique:
                raise DataError("A column comes twice. Give each once.")
            names = given[NAME] if NAME in given.columns else [""] * len(given)
            return self._of_contents(list(given[CONTENT]), [str(name) for name in names])
        if isinstance(given, str) or (isinstance(given, list | np.ndarray) and _texts(given)):
            texts = [given] if isinstance(given, str) else list(given)
            return self._of_contents(texts, [""] * len(texts))
        if isinstance(given, pd.DataFrame | np.ndarray | torch.Tensor) and given.ndim:
            require_few(len(given), int(np.prod(given.shape)))
        if isinstance(given, list | tuple) and not given:
            raise DataError("Nothing came; wanted a row at least.")
        return read_batch(self.predictor, self.data, given)

    def _of_contents(self, texts: Sequence[Any], names: Sequence[str]) -> Batch:
        """Return the batch of files given as texts in base64."""
        if not texts or (TICKET.get() is not None and len(texts) > MOST_FILES):
            raise DataError(
                f"{len(texts)} files came; wanted 1 to {MOST_FILES} in one request. Send them in several requests."
            )
        with TemporaryDirectory() as folder:
            files: list[Path] = []
            for row, (text, name) in enumerate(zip(texts, names, strict=True)):
                content = _decoded(row, text)
                # The suffix tells the kind of file, and the points that are drawn from a cloud depend on its name.
                files.append(Path(folder) / str(row) / (_file_name(name) or "file"))
                files[-1].parent.mkdir()
                files[-1].write_bytes(content)
            try:
                return self._of_files(files)
            except UserError as error:
                raise type(error)(_of_rows(str(error), Path(folder), names)) from error

    def _of_files(self, files: Sequence[Path]) -> Batch:
        """Read files one by one, so that together they expand to no more than one request may hold."""
        ticket = TICKET.get()
        parts: list[Batch] = []
        numbers = 0
        for file in files:
            if ticket is not None:
                ticket.require_time()
            parts.append(read_batch(self.predictor, self.data, [file]))
            numbers += parts[-1]["input"].numel()
            require_few(sum(len(part["input"]) for part in parts), numbers)
        if len({part["input"].shape[1:] for part in parts}) == 1:
            found = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
            return {**found, **({"index": torch.arange(len(found["input"]))} if "index" in found else {})}
        # The data set pads clouds of different sizes.
        rows = sum(len(part["input"]) for part in parts)
        require_few(rows, rows * max(part["input"][0].numel() for part in parts))
        parts.clear()
        return read_batch(self.predictor, self.data, files)


def require_few(rows: int, numbers: int) -> None:
    """Refuse a request that needs more memory and time than one request may; calls outside a server have no limit.

    Raises:
        DataError: there are too many rows, or numbers in them.
    """
    if TICKET.get() is None:
        return
    if not 0 < rows <= MOST_ROWS:
        raise DataError(f"{rows} rows came; wanted 1 to {MOST_ROWS} at once. Send them in several requests.")
    if numbers > MOST_INPUTS:
        raise DataError(
            f"{rows} rows of {numbers} numbers in all came; wanted at most {MOST_INPUTS} numbers at once. Send them "
            "in several requests."
        )


def made_up_file(suffix: str, columns: Sequence[str]) -> bytes | None:
    """Return the content of a small file of a kind, by its suffix; None if the kind is not known here."""
    if suffix == ".csv":
        return "\n".join([",".join(columns), *[",".join("0" for _ in columns)] * 2, ""]).encode()
    if suffix in (".png", ".jpg", ".jpeg"):
        content = BytesIO()
        ramp = np.arange(3 * 64 * 64).astype(np.uint8).reshape(64, 64, 3)
        Image.fromarray(ramp).save(content, "PNG" if suffix == ".png" else "JPEG")
        return content.getvalue()
    side = 16
    row, column = np.divmod(np.arange(side**2), side)
    points = [f"{a} {b} {a * b % 7}" for a, b in zip(row.tolist(), column.tolist(), strict=True)]
    first = [side * a + b for a in range(side - 1) for b in range(side - 1)]
    faces = [
        f"3 {a} {b} {c}" for f in first for a, b, c in ((f, f + side, f + 1), (f + side, f + side + 1, f + 1))
    ]
    if suffix == ".xyz":
        return "\n".join([*points, ""]).encode()
    if suffix == ".off":
        return "\n".join(["OFF", f"{len(points)} {len(faces)} 0", *points, *faces, ""]).encode()
    if suffix == ".ply":
        colors = ("red", "green", "blue")
        head = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
        head += [f"property float {axis}" for axis in "xyz"] + [f"property uchar {color}" for color in colors]
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
        return "\n".join([*head, *(f"{point} 90 120 150" for point in points), *faces, ""]).encode()
    return None


def _decoded(row: int, text: Any) -> bytes:
    """Return the bytes of a text in base64."""
    if isinstance(text, str) and len(text) > MOST_CONTENT // 3 * 4 + 4:
        raise DataError(
            f"row {row}: a file of about {len(text) // 4 * 3} bytes came; wanted at most {MOST_CONTENT}. "
            "Make it smaller."
        )
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, TypeError, ValueError) as error:
        raise DataError(
            f"row {row}: wanted the content of a file, base64. A file of your own is a pathlib.Path."
        ) from error


def _file_name(name: str) -> str:
    """Return the end of a name, with letters that every file system allows, and no longer than a file system allows."""
    name = re.sub(r"[^\w.-]|^\.+", "_", name)[-100:]
    while len(name.encode()) > 240:
        name = name[1:]
    return name


def _of_rows(said: str, folder: Path, names: Sequence[str]) -> str:
    """Return a message about temporary files, with row numbers and the client's names in place of their paths."""

    def row(found: re.Match[str]) -> str:
        number = found[1]
        if not number or int(number) >= len(names):
            return "the request"
        name = re.split(r"[/\\]", names[int(number)])[-1]
        return f"row {number}" + (f" ({quote(name)})" if name else "")

    said = re.sub(rf"{re.escape(str(folder))}(?:/(\d+)(?:/[\w.…-]*[\w…-])?)?", row, said)
    # A message may have been shortened within a path.
    return re.sub(rf"{re.escape(str(folder.parent))}[^\s'\"]*…", "…", said)


_DEFAULTS = {"seed": 0, "samples": 1000}
"""Settings of checkpoints of version 0.1, which do not hold the settings of their run's predictions."""


def _texts(given: Sequence[Any] | np.ndarray) -> bool:
    """Return whether `given` is a list of texts."""
    flat = isinstance(given, list) or (isinstance(given, np.ndarray) and given.ndim == 1)
    return flat and len(given) > 0 and all(isinstance(item, str) for item in given)


def _load_pyfunc(path: str) -> Served:
    """Return the model that MLflow loads from the path of its checkpoint; errors are those of `framework.load`."""
    predictor, description = load_with_description(path)
    served = Served(predictor, description, reader(description))
    for remark in description.remarks:
        _log.warning("%s", remark)
    served.warm_up()
    samples = (one.to_dict(orient="split", index=False) for one in served.made_up())
    bound_server([json.dumps({"dataframe_split": sample}).encode() for sample in samples])
    return served
