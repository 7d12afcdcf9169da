"""A run's checkpoint as a model of MLflow: `mlflow.pyfunc.load_model` and `mlflow models serve` load it by this module.

A request comes from anywhere: text in it is the content of a file, base64, and never the name of one on this machine.
"""

import base64
import binascii
import re
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, final

import numpy as np
import pandas as pd
import torch

from framework.configuration.description import Description
from framework.configuration.loading import asked_of, load_with_description, reader
from framework.data import Batch, Data
from framework.datasets.png import png
from framework.distributions.noise import Draw
from framework.errors import DataError, UserError
from framework.evaluation.splits import BLOCK, predicted
from framework.model import Predictor
from framework.prediction import answers, named

CONTENT, NAME = "base64", "name"
"""Columns of a request with files: their bytes, and (if their kind hangs on that) their names."""


@final
class Served:
    """Raw input in, a table of predictions out: the numbers of `mode=predict`, and the modes."""

    def __init__(self, predictor: Predictor, description: Description, data: Data) -> None:
        self.predictor, self.description, self.data = predictor, description, data

    def predict(self, given: Any, params: object = None) -> pd.DataFrame:
        """As `answer`; MLflow calls it, and its server tells a client the sentence of an MlflowException alone."""
        try:
            return self.answer(given)
        except UserError as error:
            from mlflow.exceptions import INVALID_PARAMETER_VALUE, MlflowException

            raise MlflowException(str(error), INVALID_PARAMETER_VALUE) from error

    @torch.no_grad()
    def answer(self, given: Any) -> pd.DataFrame:
        """A row a sample; an image is a PNG in base64.

        Args:
            given: what `framework.load`'s model takes, but files only as `pathlib.Path`; or the content of files: a
                DataFrame with the column "base64" (and "name", whose ending tells the kind), or texts in base64.

        Raises:
            DataError: it is none of these.
        """
        asked = self._asked(given)
        seed, samples = (self.description.settings.get(key, other) for key, other in _DEFAULTS.items())
        parts = []
        for number, rows in enumerate(torch.arange(len(asked["input"])).split(BLOCK)):
            block = {name: values[rows] for name, values in asked.items()}
            prediction = predicted(self.predictor, block, samples, Draw(seed, number))
            prediction = prediction.in_frame(self.data.frame(block))
            target = self.description.target
            found = answers(target, prediction)
            if target.kind == "image":
                pictures = [base64.b64encode(png(light)).decode() for light in prediction.image("color")]
                parts.append(
                    pd.DataFrame({"png": pictures, **{key: one.numpy() for key, one in found.items()}})
                )
                continue
            mode = prediction.density.mode
            if target.kind == "class":
                labels = {"class": [target.names[label] for label in mode.tolist()]}
            else:
                labels, found = {}, {**found, **named(target, mode, "_mode")}
            parts.append(pd.DataFrame({**labels, **{key: column.numpy() for key, column in found.items()}}))
        return pd.concat(parts, ignore_index=True)

    def _asked(self, given: Any) -> Batch:
        if isinstance(given, pd.DataFrame) and CONTENT in given.columns and CONTENT not in self.data.columns:
            names = given[NAME] if NAME in given.columns else [""] * len(given)
            return self._of_contents(list(given[CONTENT]), [str(name) for name in names])
        if isinstance(given, str) or (isinstance(given, list | np.ndarray) and _texts(given)):
            texts = [given] if isinstance(given, str) else list(given)
            return self._of_contents(texts, [""] * len(texts))
        return asked_of(self.predictor, self.data, given)

    def _of_contents(self, texts: Sequence[Any], names: Sequence[str]) -> Batch:
        with TemporaryDirectory() as folder:
            files = []
            for row, (text, name) in enumerate(zip(texts, names, strict=True)):
                try:
                    content = base64.b64decode(text, validate=True)
                except (binascii.Error, TypeError, ValueError) as error:
                    raise DataError(
                        f"row {row}: wanted the content of a file, base64. A file of your own is a pathlib.Path."
                    ) from error
                # the ending tells the kind of file, and what is drawn of a cloud depends on its name
                files.append(Path(folder) / str(row) / (re.sub(r"[^\w.-]|^\.+", "_", name)[-100:] or "file"))
                files[-1].parent.mkdir()
                files[-1].write_bytes(content)
            return asked_of(self.predictor, self.data, files)


_DEFAULTS = {"seed": 0, "samples": 1000}
"""Of checkpoints of version 0.1, which do not say with what their run predicted."""


def _texts(given: Sequence[Any] | np.ndarray) -> bool:
    return len(given) > 0 and all(isinstance(item, str) for item in given)


def _load_pyfunc(path: str) -> Served:
    """What MLflow calls with the path of the checkpoint; errors as `framework.load`."""
    predictor, description = load_with_description(path)
    return Served(predictor, description, reader(description))
