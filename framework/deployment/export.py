"""Export of a trained model as a folder that runs with NumPy and ONNX Runtime alone.

The folder holds the network, from the user's arrays to the parameters of the density, as `model.onnx`; the family of
the density, its target and its calibration as `density.json`; and Python files that compute densities and predictions
(`framework/deployment/exported_folder`). The network is traced by torch.export. What it computes is compared with the
original model on random and extreme inputs, and nothing is written if they differ.
"""

import copy
import importlib
import json
import logging
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from importlib.util import find_spec
from inspect import getsource
from io import StringIO
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.fx import GraphModule

from framework.configuration.description import Description
from framework.configuration.loading import reader
from framework.data import Preprocessing
from framework.deployment import exported_folder
from framework.deployment.frozen import freeze_predictor
from framework.distributions.exported import NUMPY, Exported, exported
from framework.distributions.numpy_densities import build
from framework.errors import ConfigError, shorten
from framework.model import Predictor
from framework.target import Target

FORMAT = 1
"""Version of the layout of density.json."""
PARITY = 1e-5
"""Largest difference of a parameter of the density from the original model's, as a share of the parameter's largest."""
DENSITY_PARITY = 1e-4
"""Largest difference of log-densities from the original model's, as a share of max(1, |log-density|)."""
EXTRA = "pip install 'robust-visual-learning[export]'"
SCRIPTS = ("predict", "serve")
PACKAGE = exported_folder.__name__
"""Package of the scripts."""
EXTREMES = {"random": 1.0, "extreme": 1e4}
"""Factors of the spread of the arrays on which the exported model is compared with the original one."""
BATCH = 16
RANDOM = "It draws random numbers, so the same input has another density each time."


@dataclass(frozen=True)
class Exporting:
    """A model that is being exported.

    Attributes:
        predictor: the model, on the CPU, in evaluation mode.
        description: its description.
        preprocessing: computation before its first layer, or None.
    """

    predictor: Predictor
    description: Description
    preprocessing: Preprocessing | None

    @property
    def dtype(self) -> torch.dtype:
        """Data type of the arrays that the exported model reads."""
        if self.preprocessing is not None:
            return torch.float64
        # pixels are bytes
        return torch.uint8 if len(self.description.input_shape) == 3 else torch.float32

    def arrays(self, count: int, spread: float, seed: int = 0) -> Tensor:
        """Return random arrays that a user might give, (count, *input_shape)."""
        generator = torch.Generator().manual_seed(seed)
        shape = (count, *self.description.input_shape)
        if self.dtype == torch.uint8:
            if spread > 1:  # black and white images
                level = 255 * torch.arange(count).remainder(2)
                return level.reshape(-1, *(1,) * (len(shape) - 1)).expand(shape).to(torch.uint8).contiguous()
            return torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)
        noise = spread * torch.randn(shape, generator=generator, dtype=torch.float64)
        if self.preprocessing is not None:
            noise = self.preprocessing.location + self.preprocessing.scale * noise
        return noise.to(self.dtype)

    def inputs(self, arrays: Tensor) -> Tensor:
        """Return the inputs that the original model reads for a user's arrays."""
        inputs = reader(self.description).inputs(arrays.numpy())
        own = next(self.predictor.parameters(), inputs)
        return inputs.to(inputs.dtype if inputs.dtype == torch.uint8 else own.dtype)

    def density(self, arrays: Tensor) -> torch.distributions.Distribution:
        """Return the densities of the original model for a user's arrays, as `framework.load` computes them."""
        return self.predictor(self.inputs(arrays))


class Traced(nn.Module):
    """Module from a user's arrays to the parameters of the density, which torch.export traces."""

    def __init__(self, model: Exporting) -> None:
        super().__init__()
        self.predictor = model.predictor
        self.preprocessing = nn.Identity() if model.preprocessing is None else model.preprocessing.module
        floats = (parameter.dtype for parameter in model.predictor.parameters())
        self.kind = model.dtype if model.dtype == torch.uint8 else next(floats, torch.float32)

    def forward(self, arrays: Tensor) -> tuple[Tensor, ...]:
        """Return the parameters of the density, in the order of `Exported.tensors`."""
        density = self.predictor(self.preprocessing(arrays).to(self.kind))
        return tuple(tensor.clone() for _, tensor in exported(density).tensors())


def export(predictor: Predictor, description: Description, into: Path) -> Mapping[str, Any]:
    """Write the exported form of a model to the folder `into`, and return the content of its density.json.

    Args:
        predictor: model in evaluation mode, as `load_with_description` returns it.
        description: its description.
        into: folder to write; it must not exist or be empty.

    Raises:
        ConfigError: a package is missing, the model cannot be exported, or the exported model differs from it.
    """
    require_packages()
    if into.is_dir() and any(into.iterdir()):
        raise ConfigError(f"{into} is not empty. Name a new folder, or empty this one.")
    bare = _without_hooks(predictor)
    model = Exporting(bare, description, reader(description).preprocessing())
    with torch.no_grad():  # with the hooks of loading, which bound the memory that a stored model may take
        predictor(model.inputs(model.arrays(BATCH, 1.0)))
    form = _form(model)
    layout, names = form.layout(), [name for name, _ in form.tensors()]
    modules = sorted(set(form.modules()))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _write_network(model, names, folder / "model.onnx")
        session = open_session(folder / "model.onnx")
        parity = _compare(model, session, layout, names, modules)
        code = _write_code(modules, folder)
        content = {
            "format": FORMAT,
            "model": description.method or type(predictor).__name__,
            "trained_on": description.config["data"]["name"],
            "synthetic": description.synthetic,
            "input": _input_entry(model),
            "target": target_entry(description.target),
            "density": layout,
            "outputs": names,
            "modules": code,
            "calibration": list(description.remarks),
            "parity": parity,
            "milliseconds": _latency(model, session),
        }
        (folder / "density.json").write_text(
            json.dumps(content, indent=1, ensure_ascii=False), encoding="utf-8"
        )
        into.mkdir(parents=True, exist_ok=True)
        for file in sorted(folder.iterdir()):
            shutil.copyfile(file, into / file.name)
    return content


def require_packages() -> None:
    """Refuse to export if a package is missing.

    Raises:
        ConfigError: onnx, onnxscript or onnxruntime is not installed.
    """
    missing = [name for name in ("onnx", "onnxscript", "onnxruntime") if find_spec(name) is None]
    if missing:
        raise ConfigError(f"mode=export needs the package {missing[0]}, which is not installed. Run {EXTRA}.")


def _without_hooks(predictor: Predictor) -> Predictor:
    """Return a copy of a model without the hooks of loading, which bound memory and cannot be traced."""
    bare = copy.deepcopy(predictor).cpu().eval().requires_grad_(False)
    for module in bare.modules():
        module._forward_hooks.clear()
        module._forward_pre_hooks.clear()
    return bare


@torch.no_grad()
def _form(model: Exporting) -> Exported:
    """Return the parameters of the model's density for a batch of arrays.

    Raises:
        ConfigError: the density cannot be exported, or two calls give different densities.
    """
    arrays = model.arrays(BATCH, 1.0)
    batch = reader(model.description).user_batch(arrays.numpy())
    if reader(model.description).frame(batch) is not None:
        raise _refusal(model, "Its targets are given in a frame that is computed from each input.")
    draws: list[list[Tensor]] = []
    form = None
    for seed in (0, 1):
        torch.manual_seed(seed)
        form = exported(model.density(arrays))
        draws.append([tensor for _, tensor in form.tensors()])
    if not all(torch.equal(first, second) for first, second in zip(*draws, strict=True)):
        raise _refusal(model, RANDOM)
    assert form is not None
    return form


def _refusal(model: Exporting, reason: str) -> ConfigError:
    name = model.description.method or type(model.predictor).__name__
    return ConfigError(
        f"The model {name} cannot be exported. {reason} Use framework.load or framework.freeze for it."
    )


def _write_network(model: Exporting, names: list[str], file: Path) -> None:
    """Trace the model and write it as ONNX.

    Raises:
        ConfigError: torch cannot trace a part of the model, or ONNX has no form for it.
    """
    traced = Traced(model).eval()
    arrays = model.arrays(2, 1.0)
    batch = {0: torch.export.Dim("batch", min=1)}
    printed = StringIO()
    with warnings.catch_warnings(), redirect_stdout(printed), redirect_stderr(printed), torch.no_grad():
        warnings.simplefilter("ignore")
        previous = logging.root.manager.disable
        logging.disable(logging.ERROR)
        try:
            program = torch.export.export(traced, (arrays,), dynamic_shapes=(batch,), strict=False)
            # a density may draw an empty sample to learn its type; ONNX has no form for such draws
            _remove_unused(program.graph_module)
            written = torch.onnx.export(
                program, input_names=["input"], output_names=names, verbose=False, optimize=True
            )
            assert written is not None
            written.save(str(file))
        except Exception as error:
            raise _refusal(
                model, f"torch.export cannot follow its computation ({shorten(_cause(error), 200)})."
            ) from error
        finally:
            logging.disable(previous)


def _remove_unused(traced: GraphModule) -> None:
    """Remove operations whose results are not used, also draws of random numbers."""
    for node in reversed(list(traced.graph.nodes)):
        if node.op in ("call_function", "get_attr") and not node.users and "assert" not in str(node.target):
            traced.graph.erase_node(node)
    traced.delete_all_unused_submodules()


def _cause(error: BaseException) -> str:
    """Return the message of the first error in a chain, on one line and without colours."""
    while error.__cause__ is not None:
        error = error.__cause__
    lines = [line.strip() for line in str(error).replace("\x1b[96m", "").replace("\x1b[0m", "").splitlines()]
    return next((line for line in lines if line), type(error).__name__)


def open_session(file: Path) -> Any:
    """Return a session of ONNX Runtime on one thread."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])


@torch.no_grad()
def _compare(
    model: Exporting, session: Any, layout: Mapping[str, Any], names: list[str], modules: list[str]
) -> dict[str, dict[str, float]]:
    """Return the largest differences between the exported and the original model.

    Raises:
        ConfigError: a difference is above its limit.
    """
    families = {
        key: family for name in modules for key, family in importlib.import_module(name).FAMILIES.items()
    }
    report: dict[str, dict[str, float]] = {}
    for label, spread in EXTREMES.items():
        parameters = densities = 0.0
        for count in (1, BATCH):
            arrays = model.arrays(count, spread, seed=count)
            density = model.density(arrays)
            outputs = dict(zip(names, session.run(names, {"input": arrays.numpy()}), strict=True))
            own = {name: tensor.numpy() for name, tensor in exported(density).tensors()}
            parameters = max([parameters, *(_difference(outputs[name], own[name]) for name in names)])
            torch.manual_seed(0)
            values = density.sample(torch.Size((7,)))
            expected = density.log_prob(values).double().numpy()
            # of the same parameters: rounding in the last digit of a narrow density's mean changes log-densities a lot
            computed = build(layout, own, families).log_prob(values.double().numpy())
            finite = np.isfinite(expected)
            away = np.abs(computed - expected)[finite] / np.maximum(1, np.abs(expected[finite]))
            densities = max(densities, float(away.max(initial=0)))
        report[label] = {"parameters": parameters, "log_density": densities}
        # extreme densities have log-densities that float32 itself does not resolve
        if not (parameters <= PARITY and (densities <= DENSITY_PARITY or spread > 1)):
            raise _refusal(
                model,
                f"The exported network differs from it by {parameters:.1e} ({PARITY:g} is allowed) in the parameters "
                f"and by {densities:.1e} ({DENSITY_PARITY:g}) in log-densities, for {label} inputs.",
            )
    return report


def _difference(computed: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest difference of two arrays, relative to the largest number in its row.

    The result is infinite if the shapes differ, or if only one of the arrays has NaN at some position.
    """
    if computed.shape != expected.shape or (np.isnan(computed) != np.isnan(expected)).any():
        return float("inf")
    if not expected.size:
        return 0.0
    flat, other = (part.astype(np.float64).reshape(len(part), -1) for part in (computed, expected))
    largest = np.maximum(1.0, np.nanmax(np.abs(other), axis=1, keepdims=True))
    with np.errstate(invalid="ignore"):
        away = np.where(flat == other, 0.0, np.abs(flat - other) / largest)
    return float(np.nanmax(away))


def _write_code(modules: list[str], folder: Path) -> list[str]:
    """Copy the scripts and the NumPy code of the families, and return the names of the modules with families."""
    names = {path: "densities" if path == NUMPY else path.rpartition(".")[2] for path in (NUMPY, *modules)}
    scripts = Path(str(exported_folder.__file__)).parent
    # the scripts are not imported here, because they need packages of the exported folder
    sources = {name: (scripts / f"{name}.py").read_text(encoding="utf-8") for name in SCRIPTS}
    sources |= {name: getsource(importlib.import_module(path)) for path, name in names.items()}
    for name, source in sources.items():
        # in the exported folder, the files import each other by their bare names
        bare = source.replace(f"from {NUMPY} ", "from densities ").replace(f"from {PACKAGE}.", "from ")
        (folder / f"{name}.py").write_text(bare, encoding="utf-8")
    return list(names.values())


def _input_entry(model: Exporting) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "shape": ["batch", *model.description.input_shape],
        "dtype": str(model.dtype).removeprefix("torch."),
    }
    if model.description.columns:
        entry["columns"] = list(model.description.columns)
    return entry


def target_entry(target: Target) -> dict[str, Any]:
    """Return the target as plain values, with the unit of its numbers."""
    unit = {"angle": "radian", "real": "unit of the training data", "class": "label", "image": "sRGB, 0 to 1"}
    return {"kind": target.kind, "names": list(target.names), "unit": unit[target.kind]}


@torch.no_grad()
def _latency(model: Exporting, session: Any) -> dict[str, dict[str, float]]:
    """Return processor milliseconds of a batch, by batch size and form of the model, on one thread."""
    frozen = freeze_predictor(model.predictor, model.description.input_shape)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        times: dict[str, dict[str, float]] = {}
        for count in (1, 64):
            arrays = model.arrays(count, 1.0)
            inputs = model.inputs(arrays)
            array = arrays.numpy()
            forms: dict[str, Callable[[], object]] = {
                "torch": lambda inputs=inputs: model.predictor(inputs),
                "frozen": lambda inputs=inputs: frozen.density(inputs),
                "onnxruntime": lambda array=array: session.run(None, {"input": array}),
            }
            times[str(count)] = {name: round(_milliseconds(call), 4) for name, call in forms.items()}
        return times
    finally:
        torch.set_num_threads(threads)


def _milliseconds(call: Callable[[], object], seconds: float = 0.1) -> float:
    """Return the median processor time of a call, milliseconds."""
    call()
    times: list[float] = []
    while sum(times) < seconds and len(times) < 200:
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return 1e3 * median(times)
