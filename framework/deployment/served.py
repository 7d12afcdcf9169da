"""A checkpoint of a run as an MLflow model.

`mlflow.pyfunc.load_model` and `mlflow models serve` load the checkpoint with this module. A request may come from
anyone, so text in it is always the content of a file in base64, never the name of a file on this machine.
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
from framework.storage.old_versions import PREDICTION_SETTINGS

CONTENT, NAME = "base64", "name"
"""Columns of a request with files: content of a file, and its name, which is needed if its suffix states the format."""

_log = logging.getLogger(__name__)


@final
class ServedModel:
    """Model that MLflow serves: it reads raw input and returns a table of predictions.

    The table has the numbers that `mode=predict` writes, and the modes of the densities.

    Args:
        predictor: the trained predictor, as `load_with_description` returns it.
        description: its description.
        data: data set that reads raw input for the model.
    """

    def __init__(self, predictor: Predictor, description: Description, data: Data) -> None:
        self.predictor, self.description, self.data = predictor, description, data

    def predict(self, inputs: Any, params: object = None) -> pd.DataFrame:
        """Return the table of `predict_table` for `inputs`; MLflow calls this method, and its `params` are ignored.

        Errors are converted to an MlflowException, the only error whose message MLflow's server sends to the client.
        Outside a server, unexpected errors are not converted.
        """
        ticket = TICKET.get()
        if ticket is not None:
            ticket.remarks = self.description.remarks
        try:
            return self.predict_table(inputs)
        except UserError as error:
            # The client must not see the path of the checkpoint on the server.
            sentence = shorten(str(error).replace(self.description.path, "the served model"), 1000)
            reason: Exception = error
        except Exception as error:
            if ticket is None:
                raise
            _log.exception("A request could not be answered.")
            sentence = "The model cannot predict for these inputs. Compare the request's rows with the training data."
            reason = error
        if ticket is not None:
            ticket.sentence = ticket.sentence or sentence
        from mlflow.exceptions import INVALID_PARAMETER_VALUE, MlflowException

        raise MlflowException(sentence, INVALID_PARAMETER_VALUE) from reason

    @torch.no_grad()
    def predict_table(self, inputs: Any) -> pd.DataFrame:
        """Return a table with one row per sample, including the columns of prediction sets (`set_columns`).

        A predicted image is a PNG file in base64. The entry "remarks" of the table's `attrs` has the remarks in the
        model's description (`Description.remarks`).

        Args:
            inputs: inputs that the model of `framework.load` accepts, but files only as `pathlib.Path`; or the contents
                of files, as a DataFrame with the column "base64" (and "name", whose suffix determines the format) or
                as texts in base64.

        Raises:
            DataError: `inputs` is none of these.
        """
        batch = self._read_request(inputs)
        require_few_numbers(len(batch["input"]), batch["input"].numel())
        ticket = TICKET.get()
        seed, samples = (
            self.description.settings.get(key, default) for key, default in PREDICTION_SETTINGS.items()
        )
        parts = []
        for number, rows in enumerate(torch.arange(len(batch["input"])).split(BLOCK)):
            if ticket is not None:
                ticket.require_time()
            block = {name: values[rows] for name, values in batch.items()}
            prediction = predict(self.predictor, block, samples, Draw(seed, number))
            prediction = prediction.in_frame(self.data.frame(block))
            target = self.description.target
            columns = table_columns(target, prediction)
            if target.kind == "image":
                pictures = [
                    base64.b64encode(encode_png(light)).decode() for light in prediction.image("color")
                ]
                parts.append(
                    pd.DataFrame(
                        {"png": pictures, **{key: column.numpy() for key, column in columns.items()}}
                    )
                )
                continue
            mode = prediction.density.mode
            if target.kind == "class":
                labels = {"class": [target.names[label] for label in mode.tolist()]}
            else:
                labels, columns = {}, {**columns, **named_columns(target, mode, "_mode")}
            numbers = {key: column.numpy() for key, column in columns.items()}
            parts.append(pd.DataFrame({**labels, **numbers, **set_columns(target, prediction)}))
        table = pd.concat(parts, ignore_index=True)
        table.attrs["remarks"] = list(self.description.remarks)
        return table

    def warm_up(self) -> None:
        """Predict for `sample_requests`, so that no later prediction waits for imports and compilation."""
        for sample in self.sample_requests():
            try:
                self.predict_table(sample)
            except Exception as error:  # the data set does not accept the sample
                _log.debug("A generated sample was refused: %s", shorten(error))

    def sample_requests(self) -> Iterator[Any]:
        """Yield inputs of generated requests: rows, and one file of each kind that the data set reads."""
        columns, shape = self.data.columns, self.data.input_shape
        if columns and len(shape) == 1:
            yield pd.DataFrame([[0.0] * len(columns)] * 2, columns=list(columns))
        for suffix in self.data.suffixes:
            content = sample_file(suffix, columns)
            if content is not None:
                yield pd.DataFrame({CONTENT: [base64.b64encode(content).decode()], NAME: [f"sample{suffix}"]})

    def _read_request(self, inputs: Any) -> Batch:
        """Return the batch that the model reads for the inputs of a request."""
        if (
            isinstance(inputs, pd.DataFrame)
            and CONTENT in inputs.columns
            and CONTENT not in self.data.columns
        ):
            if not inputs.columns.is_unique:
                raise DataError("A column name occurs twice. Use every name once.")
            names = inputs[NAME] if NAME in inputs.columns else [""] * len(inputs)
            return self._read_contents(list(inputs[CONTENT]), [str(name) for name in names])
        if isinstance(inputs, str) or (isinstance(inputs, list | np.ndarray) and _are_texts(inputs)):
            texts = [inputs] if isinstance(inputs, str) else list(inputs)
            return self._read_contents(texts, [""] * len(texts))
        if isinstance(inputs, pd.DataFrame | np.ndarray | torch.Tensor) and inputs.ndim:
            require_few_numbers(len(inputs), int(np.prod(inputs.shape)))
        if isinstance(inputs, list | tuple) and not inputs:
            raise DataError("Got no row, but at least one is required. Send a row.")
        return read_batch(self.predictor, self.data, inputs)

    def _read_contents(self, texts: Sequence[Any], names: Sequence[str]) -> Batch:
        """Return the batch that the model reads for files, whose contents in base64 are `texts`."""
        if not texts or (TICKET.get() is not None and len(texts) > MOST_FILES):
            raise DataError(
                f"Got {len(texts)} files, but 1 to {MOST_FILES} files are allowed in one request. Use several "
                "requests for more."
            )
        with TemporaryDirectory() as folder:
            files: list[Path] = []
            for row, (text, name) in enumerate(zip(texts, names, strict=True)):
                content = _decode(row, text)
                # The suffix determines the format, and the points that are sampled from a cloud depend on its name.
                files.append(Path(folder) / str(row) / (_file_name(name) or "file"))
                files[-1].parent.mkdir()
                files[-1].write_bytes(content)
            try:
                return self._read_files(files)
            except UserError as error:
                raise type(error)(_name_rows(str(error), Path(folder), names)) from error

    def _read_files(self, files: Sequence[Path]) -> Batch:
        """Return the batch of several files; raise an error as soon as they contain too many numbers for a request."""
        ticket = TICKET.get()
        parts: list[Batch] = []
        numbers = 0
        for file in files:
            if ticket is not None:
                ticket.require_time()
            parts.append(read_batch(self.predictor, self.data, [file]))
            numbers += parts[-1]["input"].numel()
            require_few_numbers(sum(len(part["input"]) for part in parts), numbers)
        if len({part["input"].shape[1:] for part in parts}) == 1:
            batch = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
            return {**batch, **({"index": torch.arange(len(batch["input"]))} if "index" in batch else {})}
        # Clouds of different sizes are read together, because the data set pads them.
        rows = sum(len(part["input"]) for part in parts)
        require_few_numbers(rows, rows * max(part["input"][0].numel() for part in parts))
        parts.clear()
        return read_batch(self.predictor, self.data, files)


def require_few_numbers(rows: int, numbers: int) -> None:
    """Raise an error if a request has too many rows or numbers; calls outside a server have no limit.

    Raises:
        DataError: there are too many rows, or too many numbers in them.
    """
    if TICKET.get() is None:
        return
    if not 0 < rows <= MOST_ROWS:
        raise DataError(
            f"Got {rows} rows, but 1 to {MOST_ROWS} rows are allowed in one request. Use several requests for more."
        )
    if numbers > MOST_INPUTS:
        raise DataError(
            f"Got {rows} rows with {numbers} numbers in total, but at most {MOST_INPUTS} numbers are allowed in one "
            "request. Send the rows in several requests."
        )


def sample_file(suffix: str, columns: Sequence[str]) -> bytes | None:
    """Return the content of a small sample file in the format of a suffix; None for an unknown suffix.

    `columns` are the column names of a table.
    """
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


def _decode(row: int, text: Any) -> bytes:
    """Decode a base64 text to bytes."""
    if isinstance(text, str) and len(text) > MOST_CONTENT // 3 * 4 + 4:
        raise DataError(
            f"row {row}: got a file of about {len(text) // 4 * 3} bytes, but at most {MOST_CONTENT} are allowed. "
            "Make the file smaller."
        )
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, TypeError, ValueError) as error:
        raise DataError(
            f"row {row}: the content of a file must be text in base64. Encode it so; in Python, you may "
            "instead pass the path of the file as pathlib.Path."
        ) from error


def _file_name(name: str) -> str:
    """Return the last characters of a file name, changed so that every file system allows the name."""
    name = re.sub(r"[^\w.-]|^\.+", "_", name)[-100:]
    while len(name.encode()) > 240:
        name = name[1:]
    return name


def _name_rows(message: str, folder: Path, names: Sequence[str]) -> str:
    """Return a message in which paths of temporary files are replaced by row numbers and the client's file names."""

    def name_row(match: re.Match[str]) -> str:
        number = match[1]
        if not number or int(number) >= len(names):
            return "the request"
        name = re.split(r"[/\\]", names[int(number)])[-1]
        return f"row {number}" + (f" ({quote(name)})" if name else "")

    message = re.sub(rf"{re.escape(str(folder))}(?:/(\d+)(?:/[\w.…-]*[\w…-])?)?", name_row, message)
    # A message may have been shortened within a path.
    return re.sub(rf"{re.escape(str(folder.parent))}[^\s'\"]*…", "…", message)


def _are_texts(inputs: Sequence[Any] | np.ndarray) -> bool:
    """Return whether `inputs` is a non-empty list or 1-D array of texts."""
    flat = isinstance(inputs, list) or (isinstance(inputs, np.ndarray) and inputs.ndim == 1)
    return flat and len(inputs) > 0 and all(isinstance(item, str) for item in inputs)


def _load_pyfunc(path: str) -> ServedModel:
    """Load the checkpoint at `path` as a model; MLflow calls this function. Errors are those of `framework.load`."""
    predictor, description = load_with_description(path)
    served = ServedModel(predictor, description, reader(description))
    for remark in description.remarks:
        _log.warning("%s", remark)
    served.warm_up()
    samples = (table.to_dict(orient="split", index=False) for table in served.sample_requests())
    bound_server([json.dumps({"dataframe_split": sample}).encode() for sample in samples])
    return served
