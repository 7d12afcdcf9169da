"""Compare the run time of deployed forms of six models on one core.

    python -m benchmarks.framework.deployed [NAME ...]

The forms are the PyTorch model, the frozen model, a session of ONNX Runtime, and the exported folder. The weights are
random. The script measures the named models, or all, and writes deployed.md beside this file; the rows of models that
are not named are kept.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # this also limits the threads of NumPy's matrix products

import importlib
import re
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from benchmarks.pages import machine, write_page
from benchmarks.timing import ROUNDS, Rounds, time_interleaved
from framework.configuration.assembly import build_predictor
from framework.configuration.description import Description
from framework.configuration.schema import resolve
from framework.data import Data, Preprocessing
from framework.deployment import export as exporting
from framework.deployment.frozen import freeze_predictor
from framework.deployment.onnx_programs import Session
from framework.errors import ConfigError
from framework.model import Predictor
from framework.target import Target

BATCHES = (1, 64)
MOST = 1.2
"""Largest permitted time of a form that the project ships, as a multiple of the fastest form."""
VIEWPOINT = Target("angle", ("azimuth", "elevation", "tilt"))
CLASSES = Target("class", tuple(f"class {number}" for number in range(40)))
TWO = Target("class", ("first", "second"))


@dataclass(frozen=True)
class Case:
    """A model.

    Attributes:
        title: description in the table.
        shape: shape of an input.
        target: target of the model.
        encoders: configuration of the encoders.
        head: configuration of the density head.
        uncertainty: configuration of the wrappers.
    """

    title: str
    shape: tuple[int, ...]
    target: Target
    encoders: list[dict[str, Any]]
    head: str
    uncertainty: tuple[dict[str, Any], ...] = ()


def mlp(*widths: int) -> dict[str, Any]:
    """Return the configuration of a network with these widths."""
    return {"name": "mlp", "widths": list(widths)}


CASES = {
    "table": Case("table, Gaussian", (5,), Target("real", ("y",)), [mlp(128, 128)], "gaussian"),
    "moons": Case("moons, classes", (2,), TWO, [mlp(128, 128)], "bernoulli"),
    "clouds": Case(
        "cloud of 2,048 points, basis point set, 40 classes", (2048, 3), CLASSES,
        [{"name": "bps", "points": 512}, mlp(400, 400)], "categorical",
    ),
    "mixture": Case("image, mixture of von Mises", (3, 64, 64), VIEWPOINT, [{"name": "biternion_vgg"}], "mixture"),
    "scvae": Case("image, sCVAE", (3, 64, 64), VIEWPOINT, [{"name": "biternion_vgg"}], "scvae"),
    "ensemble": Case(
        "moons, ensemble of ten", (2,), TWO, [mlp(128, 128)], "bernoulli", ({"name": "ensemble", "members": 10},)
    ),
}  # fmt: skip


class Arrays(Data):
    """Data whose users give arrays of the model's inputs."""

    bibtex, synthetic, varies = "", True, False
    prepare = splits = read = augment = fingerprint = preview = None  # type: ignore[assignment]

    def preprocessing(self) -> Preprocessing | None:
        """Return None: arrays are inputs already."""
        return None


def build(case: Case) -> Predictor:
    """Return a model with random weights."""
    config = {
        "encoder": [resolve("encoder", part) for part in case.encoders],
        "density_head": resolve("density_head", case.head),
        "uncertainty": [resolve("uncertainty", part) for part in case.uncertainty],
    }
    return build_predictor(config, case.target, case.shape, seed=0).eval()


def export(case: Case, model: Predictor, folder: Path) -> None:
    """Export a model."""
    Arrays.__abstractmethods__ = frozenset()  # type: ignore[attr-defined]

    def reader(description: Description) -> Data:
        data = Arrays()  # type: ignore[abstract]
        data.input_shape = description.input_shape
        return data

    exporting.reader = reader  # type: ignore[assignment]
    description = Description(
        {"data": {"name": "arrays"}}, case.target, case.shape, (), synthetic=True, method=case.title
    )
    exporting.export(model, description, folder)


def measure(case: Case) -> list[str]:
    """Return the table rows of a model; if it is not exported, the last one holds the reason."""
    model = build(case)
    frozen = freeze_predictor(model, case.shape)
    lines, refusal = [], ""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "exported"
        try:
            export(case, model, folder)
        except ConfigError as error:
            refusal = str(error)
        exported = None if refusal else load(folder)
        for count in BATCHES:
            generator = torch.Generator().manual_seed(count)
            if len(case.shape) == 3:
                inputs = torch.randint(0, 256, (count, *case.shape), generator=generator, dtype=torch.uint8)
            else:
                inputs = torch.randn(count, *case.shape, generator=generator)
            calls: dict[str, Callable[[], object]] = {
                "PyTorch model": lambda inputs=inputs: model(inputs),
                "frozen": lambda inputs=inputs: frozen.density(inputs),
            }
            if exported is not None:
                array, session = inputs.numpy(), Session(folder / "model.onnx")
                by_name = {"input": array} | exported._random(count, 0)
                calls |= {
                    "ONNX Runtime": lambda session=session, by_name=by_name: session.run(None, by_name),
                    "exported folder": lambda array=array, exported=exported: exported(array),
                }
            with torch.no_grad():
                times = time_interleaved(calls, rounds=ROUNDS, seconds=0.15)
            lines += rows(case.title, count, times)
    return [*lines, *([f"| {case.title} | any | exported folder | {refusal} | |"] if refusal else [])]


def load(folder: Path) -> Any:
    """Return an exported model, loaded by the code of its folder."""
    sys.path.insert(0, str(folder))
    try:
        exported = importlib.import_module("predict").load(folder)
    finally:
        sys.path.remove(str(folder))
    for module in [*exported.description["modules"], "predict"]:
        sys.modules.pop(module, None)
    return exported


def rows(title: str, count: int, times: dict[str, Rounds]) -> list[str]:
    """Return the table rows of a model for a batch size."""
    best = min(rounds.median for rounds in times.values())
    shipped = min(times[name].median for name in ("frozen", "exported folder") if name in times)
    lines = []
    for name, rounds in times.items():
        mark = f"{rounds.median / best:.2f}" + (" (fastest shipped)" if rounds.median == shipped else "")
        lines.append(f"| {title} | {count} | {name} | {rounds.text()} | {mark} |")
    return lines


def main() -> None:
    names = sys.argv[1:] or list(CASES)
    torch.set_num_threads(1)
    page = Path(__file__).with_suffix(".md")
    known = re.findall(r"^\| .*\|$", page.read_text(), re.MULTILINE)[1:] if page.exists() else []
    lines = []
    for name, case in CASES.items():
        old = [line for line in known if line.startswith(f"| {case.title} |")]
        lines += measure(case) if name in names else old
    text = (
        "# Deployed models: run time of four forms on one core\n\n"
        "This page measures how long a prediction of six models takes in the forms in which this project deploys "
        "them. It compares these forms with the PyTorch model and with ONNX Runtime alone. `frozen` is "
        "`framework.freeze(run).density`, which needs PyTorch. `exported folder` is the model of "
        "[`mode=export`](../../docs/export.md), which needs NumPy and ONNX Runtime alone. `ONNX Runtime` is a "
        "session of the same file, which returns the parameters of the density and checks no inputs; the other "
        "forms return a density.\n\n"
        f"`ms a call` is the processor time of a call with the whole batch: the median of {ROUNDS} interleaved rounds, "
        "with the smallest and the largest one in brackets. `of the best` is the time divided by the time of the "
        "fastest form. The weights are random.\n\n"
        "| model | batch size | form | ms a call | of the best |\n|---|---|---|---|---|\n"
        f"{chr(10).join(lines)}\n\n"
        f"The project requires that no form that it ships takes more than {MOST} times as long as the fastest form. "
        "For images, the exported folder meets this; the frozen model does not for one image, because PyTorch computes "
        "the density. For small networks, `ONNX Runtime` alone is the fastest form, but it neither checks its inputs "
        "nor returns a density. The exported folder does both with NumPy, which takes 0.01 to 0.3 ms more for one "
        "input. The frozen model does both with PyTorch, which takes longer, except for the classes of two moons. For "
        "basis points, the frozen model searches for the nearest points with compiled code, but an ONNX file can only "
        "multiply matrices.\n\n"
        f"{machine('torch', 'onnxruntime', 'numpy')} Command: `python -m benchmarks.framework.deployed`.\n"
    )
    write_page(__file__, text)


if __name__ == "__main__":
    main()
