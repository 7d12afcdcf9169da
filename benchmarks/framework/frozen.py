"""Compare the run time of frozen models and of PyTorch models on one core.

    python -m benchmarks.framework.frozen

The model is the thesis's classifier of basis point sets (512-400-400-40, batch norm, dropout), alone and with its
encoder on clouds of 2048 points. In each round, the PyTorch model without gradient, other forms for deployment and the
frozen model run one after the other in one process. The weights are random. They affect the run time only through the
zeros that ReLU leaves, which are about half of the numbers, as after training. Run the script on one core
(`taskset -c 0`). It writes frozen.md beside this file.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # this also limits the threads of NumPy's matrix products

import contextlib
import io
import logging
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable
from functools import cache

import numpy as np
import onnxruntime  # pyright: ignore[reportMissingImports]
import torch

from benchmarks.pages import machine, publish
from framework.configuration.assembly import build_predictor
from framework.configuration.schema import resolve
from framework.deployment.frozen import freeze_predictor
from framework.model import FrozenFrontEnd, Model, Predictor
from framework.target import Target

ROUNDS = 5
MOST = 1.2
"""Largest permitted time of the frozen form, as a multiple of the fastest other form."""
CLASSES = Target("class", tuple(f"class {number}" for number in range(40)))
MLP = {"name": "mlp", "widths": [400, 400], "batch_norm": True, "dropout": 0.5}
BPS = {"name": "bps", "points": 512}
Calls = dict[str, Callable[[], object]]


def predictor(encoders: list[dict], shape: tuple[int, ...]) -> Model | FrozenFrontEnd:
    """Return a model with random weights and with moments of batch norm from one random batch."""
    config = {
        "encoder": [resolve("encoder", part) for part in encoders],
        "density_head": resolve("density_head", "categorical"),
        "uncertainty": [],
    }
    model = build_predictor(config, CLASSES, shape, seed=0)
    with torch.no_grad():
        model.train()(torch.rand(64, *shape))
    model.eval()
    assert isinstance(model, Model | FrozenFrontEnd)
    return model


def seconds(call: Callable[[], object], repeats: int) -> float:
    """Return the shortest processor time of one call, seconds."""
    least = float("inf")
    for _ in range(repeats):
        start = time.process_time_ns()
        call()
        least = min(least, time.process_time_ns() - start)
    return least / 1e9


def rows(title: str, calls: Calls, count: int) -> list[str]:
    """Return table rows with the median time of each call over the rounds, its range, and two ratios.

    The first ratio is the time of the first call divided by that of the row. The second one is the time of the row
    divided by that of the fastest form other than `frozen`.
    """
    repeats = max(12, 400 // count)
    durations: dict[str, list[float]] = {name: [] for name in calls}
    with torch.inference_mode():
        for _ in range(ROUNDS):
            for name, call in calls.items():
                call()  # brings the model's weights back into the caches of the processor
                durations[name].append(seconds(call, repeats))
    medians = {name: statistics.median(values) for name, values in durations.items()}
    first = next(iter(medians.values()))
    best = min(median for name, median in medians.items() if name != "frozen")
    return [
        f"| {title} | {count} | {name} | {1e3 * median:.4f} ({1e3 * min(durations[name]):.4f} to "
        f"{1e3 * max(durations[name]):.4f}) | {1e3 * median / count:.4f} | {first / median:.2f} | {median / best:.2f} |"
        for name, median in medians.items()
    ]


def as_torch(model: Model) -> torch.nn.Module:
    """Return the network of a classifier with its softmax."""
    return torch.nn.Sequential(model.encoders, model.projection, torch.nn.Softmax(-1)).eval()


@cache
def onnx_session() -> onnxruntime.InferenceSession:
    """Return the classifier as a session of ONNX Runtime on one core, for batches of any size."""
    model = predictor([MLP], (512,))
    assert isinstance(model, Model)
    logging.disable(logging.CRITICAL)  # the exporter reports each library that is not installed
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        file = f"{folder}/network.onnx"
        batch = ({0: torch.export.Dim("batch")},)
        # exported with two samples, because the exporter takes a batch of one as a constant
        torch.onnx.export(
            as_torch(model), (torch.rand(2, 512),), file, dynamo=True, dynamic_shapes=batch, verbose=False
        )
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        session = onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
    logging.disable(logging.NOTSET)
    return session


def classifier_rows(count: int) -> list[str]:
    """Return the table rows of the classifier alone, for a batch size."""
    model = predictor([MLP], (512,))
    form = freeze_predictor(model, (512,))
    assert isinstance(model, Model)
    network = as_torch(model)
    inputs = torch.rand(count, 512)
    array = inputs.numpy()
    check(form(array), model, inputs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch.jit is deprecated
        script = torch.jit.optimize_for_inference(torch.jit.freeze(torch.jit.trace(network, inputs)))
    exported = torch.export.export(network, (inputs,)).module()
    session = onnx_session()
    name = session.get_inputs()[0].name
    check(np.asarray(session.run(None, {name: array})[0]), model, inputs)
    calls: Calls = {
        "PyTorch model": lambda: model(inputs).probs,
        "torch.export": lambda: exported(inputs),
        "torch.jit.freeze": lambda: script(inputs),
        "onnxruntime": lambda: session.run(None, {name: array}),
        "frozen": lambda: form(array),
    }
    return rows("classify", calls, count)


def cloud_rows(count: int) -> list[str]:
    """Return the table rows of the classifier with its encoder, for a batch size."""
    model = predictor([BPS, MLP], (2048, 3))
    assert isinstance(model, FrozenFrontEnd)
    form = freeze_predictor(model)
    inputs = torch.randn(count, 2048, 3)
    inputs = inputs / inputs.norm(dim=-1, keepdim=True)
    check(form(inputs), model, inputs)
    calls: Calls = {
        "PyTorch model": lambda: model(inputs).probs,
        "frozen": lambda: form(inputs),
        "encoder of the PyTorch model alone": lambda: model.features(inputs),
    }
    return rows("encode and classify", calls, count)


def check(probabilities: np.ndarray, model: Predictor, inputs: torch.Tensor) -> None:
    """Exit with a message if the frozen probabilities differ from those of the predictor."""
    error = np.abs(probabilities - model(inputs).probs.detach().numpy()).max()
    if error > 1e-6:
        raise SystemExit(
            f"The frozen probabilities differ from those of the model by {error}; at most 1e-6 is allowed."
        )


def main() -> None:
    torch.set_num_threads(1)
    start = time.process_time()
    freeze_predictor(predictor([MLP], (512,)), (512,))
    freezing = time.process_time() - start
    lines = [line for count in (1, 2, 4, 8, 16, 32, 64, 128, 256) for line in classifier_rows(count)]
    lines += [line for count in (1, 256) for line in cloud_rows(count)]
    text = (
        "# Frozen models: run time on one core\n\n"
        "This page compares the run time of a classifier in several forms: as a PyTorch model and in forms that are "
        "meant for deployment. `frozen` is the form that this project deploys (`framework.freeze`): compiled code "
        "computes one sample, and ONNX Runtime computes two samples or more. The benchmark shows how much time "
        "`frozen` saves on one core.\n\n"
        "The classifier is a multilayer perceptron with 512 inputs, two hidden layers of 400 units, batch norm, "
        "dropout and 40 classes. In the rows `classify` its input is 512 features. In the rows `encode and classify` "
        "its input is a point cloud of 2048 points, and an encoder computes the 512 features with a basis point set. "
        "The benchmark checks that the frozen probabilities differ from those of the PyTorch model by at most "
        "1e-6.\n\n"
        "In the table, `ms a call` is the processor time of one call with the whole batch. It is the median of "
        f"{ROUNDS} rounds, with the smallest and the largest one in brackets, and each round contributes its shortest "
        "call. In a round the forms of the classifier run one after the other. `ms a sample` is this time divided by "
        "the batch size. `speed ratio` says how many times as fast the form is as the PyTorch model in the first row "
        "with the same task and batch size. `of the best` is the time divided by the time of the fastest form "
        f"other than `frozen`. In the rows `classify`, the project requires that this ratio is at most {MOST} for "
        "`frozen`.\n\n"
        "| task | batch size | form | ms a call | ms a sample | speed ratio | of the best |\n"
        "|---|---|---|---|---|---|---|\n"
        + "\n".join(lines)
        + f"\n\nFreezing the classifier with `framework.freeze` takes {freezing:.1f} s of processor time. This time "
        "includes the import of PyTorch's exporter and the reading of compiled functions from their cache.\n\n"
        f"{machine('torch', 'onnxruntime', 'numpy', 'numba')} Command: `python -m benchmarks.framework.frozen`.\n"
    )
    publish(__file__, text)


if __name__ == "__main__":
    main()
