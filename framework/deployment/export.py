"""Export of a trained model as a folder that runs with NumPy and ONNX Runtime alone.

The folder holds the network, from the user's arrays to the parameters of the density, as `model.onnx`; the family of
the density, its target and its calibration as `density.json`; and Python files that compute densities and predictions
(`framework/deployment/exported_folder`). The network is traced by torch.export. Its outputs are compared with those of
the original model on random and extreme inputs, and nothing is written if they differ.
"""

import copy
import importlib
import json
import math
import shutil
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from inspect import getsource
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from framework.configuration.description import Description
from framework.configuration.loading import reader
from framework.data import Preprocessing
from framework.datasets import input_ranges
from framework.density_head import Fitted
from framework.deployment import exported_folder
from framework.deployment.frozen import freeze_predictor
from framework.deployment.onnx_programs import PACKAGES, Session, quiet_export, write_onnx
from framework.distributions.exported import NUMPY, Exported, exported
from framework.distributions.given_draws import Noise, given_draws
from framework.distributions.numpy_densities import build
from framework.errors import ConfigError, DataError, NonFiniteParameters, UserError, shorten
from framework.model import Predictor
from framework.target import Target

FORMAT = 1
"""Version of the layout of density.json."""
PARITY = 1e-5
"""Largest difference between the exported and the original model's parameters that is accepted in any case.

It is a share of the largest number of the same parameter for the same input, or of 1 if this number is smaller.
"""
ROUNDING = 4.0
"""Largest accepted error of an exported parameter of the density, as a multiple of the original model's own error.

It decides where the difference is above PARITY. Both errors are measured against the original model in float64, and
are the largest over all inputs of a kind (`EXTREMES`). Two float32 programs of the same operations add their terms in
different orders, so that their rounding errors have the same distribution, but not the same values.
"""
DENSITY_PARITY = 1e-4
"""Largest difference between the exported and the original log-densities, as a share of max(1, |log-density|)."""
EXTRA = "pip install 'robust-visual-learning[export]'"
SCRIPTS = ("predict", "serve")
PACKAGE = exported_folder.__name__
"""Package with the scripts that are copied into an exported folder."""
EXTREMES = {"random": 1.0, "extreme": 1e4}
"""Factors on the usual standard deviation of the arrays on which the exported and the original model are compared."""
BATCH, FEWER = 16, 5
"""Number of inputs in a batch with which a model is tried, and in a second batch.

From the difference between both batches, `_noises` finds how many random numbers the model draws for each input.
"""
RANDOM = "It draws random numbers by other functions than torch.rand, torch.randn and dropout layers."
VARYING = "How many random numbers it draws depends on its inputs."
MOST_NOISE = 2**22
"""Largest number of random numbers for one input."""


@dataclass(frozen=True)
class Exporting:
    """A model that is being exported.

    Attributes:
        predictor: the model, on the CPU, in evaluation mode.
        description: description of the model.
        preprocessing: computation before the model's first layer, or None.
    """

    predictor: Predictor
    description: Description
    preprocessing: Preprocessing | None

    @cached_property
    def cloud(self) -> bool:
        """True if the inputs are point clouds that the model reads with rows of NaN as padding."""
        if len(self.description.input_shape) != 2 or self.description.columns[:3] not in (
            (),
            ("x", "y", "z"),
        ):
            return False
        try:
            form = self.form(self.arrays(2, 1.0, padded=True))
        except (DataError, ValueError, torch.linalg.LinAlgError):
            return False
        return all(bool(tensor.isfinite().all()) for _, tensor in form.tensors())

    @property
    def dtype(self) -> torch.dtype:
        """Data type of the arrays that the exported model reads."""
        if self.preprocessing is not None:
            return torch.float64
        # pixels are bytes
        return torch.uint8 if len(self.description.input_shape) == 3 else torch.float32

    def arrays(self, count: int, spread: float, seed: int = 0, padded: bool | None = None) -> Tensor:
        """Return random arrays that a user might give, (count, *input_shape).

        Args:
            count: number of arrays.
            spread: factor on the usual standard deviation of the arrays; above 1, images are black or white.
            seed: seed of the random numbers.
            padded: whether every second array ends with rows of NaN; None: only if the inputs are point clouds
                (`cloud`).
        """
        generator = torch.Generator().manual_seed(seed)
        shape = (count, *self.description.input_shape)
        if self.dtype == torch.uint8:
            if spread > 1:  # black and white images
                level = 255 * torch.arange(count).remainder(2)
                return level.reshape(-1, *(1,) * (len(shape) - 1)).expand(shape).to(torch.uint8).contiguous()
            return torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)
        noise = spread * torch.randn(shape, generator=generator, dtype=torch.float64)
        if self.cloud if padded is None else padded:
            noise[::2, (shape[1] + 1) // 2 :] = torch.nan  # rows of NaN are padding
        if self.preprocessing is not None:
            noise = self.preprocessing.location + self.preprocessing.scale * noise
            if self.preprocessing.missing is not None:
                noise[1::2, 0] = torch.nan  # missing numbers
        return noise.to(self.dtype)

    @torch.no_grad()
    def accepted_arrays(self, count: int, spread: float) -> Tensor:
        """Return `count` random arrays that the model accepts; `spread` is a factor on their usual standard deviation.

        An encoder may refuse random point clouds, because some of their points are not in the unit ball. Every point is
        then moved to one of the eight corners of a cube in this ball. Many points of such a cloud coincide.
        """
        arrays = self.arrays(count, spread, seed=count)
        if self.cloud:
            try:
                self.density(arrays)
            except UserError:
                return arrays.sign() / math.sqrt(3)
        return arrays

    def inputs(self, arrays: Tensor) -> Tensor:
        """Return the inputs that the original model reads for a user's arrays."""
        inputs = reader(self.description).inputs(arrays.numpy())
        own = next(self.predictor.parameters(), inputs)
        return inputs.to(inputs.dtype if inputs.dtype == torch.uint8 else own.dtype)

    def density(self, arrays: Tensor) -> torch.distributions.Distribution:
        """Return the densities of the original model for a user's arrays, as `framework.load` computes them."""
        return self.predictor(self.inputs(arrays))

    @torch.no_grad()
    def form(self, arrays: Tensor, noise: Sequence[Tensor | None] | None = None) -> Exported:
        """Return the original model's densities as tensors (`framework.distributions.exported`).

        Args:
            arrays: the user's arrays, (batch, *input_shape).
            noise: arrays that replace the random numbers of the model, in the order in which it draws them; None in
                place of an array, or of all, stands for random numbers.
        """
        with given_draws(noise):
            return exported(self.density(arrays))


class Traced(nn.Module):
    """Module from a user's arrays to the parameters of the density, which torch.export traces.

    Args:
        model: the model.
        used: for each array of random numbers that the model draws, whether `forward` gets it as an argument; the
            parameters of the density do not depend on the other arrays.
    """

    def __init__(self, model: Exporting, used: Sequence[bool]) -> None:
        super().__init__()
        self.predictor = model.predictor
        self.preprocessing = nn.Identity() if model.preprocessing is None else model.preprocessing.module
        floats = (parameter.dtype for parameter in model.predictor.parameters())
        self.kind = model.dtype if model.dtype == torch.uint8 else next(floats, torch.float32)
        self.used = used

    def forward(self, arrays: Tensor, noise: Sequence[Tensor] = ()) -> tuple[Tensor, ...]:
        """Return the parameters of the density, in the order of `Exported.tensors`.

        Args:
            arrays: the user's arrays, (batch, *input_shape).
            noise: arrays of random numbers, for those draws of the model that `used` marks.
        """
        parts = iter(noise)
        with given_draws([next(parts) if needed else None for needed in self.used]):
            form = exported(self.predictor(self.preprocessing(arrays).to(self.kind)))
        return tuple(tensor.clone() for _, tensor in form.tensors())


def export(predictor: Predictor, description: Description, into: Path) -> Mapping[str, Any]:
    """Write the exported form of a model to the folder `into`, and return the content of its density.json.

    Args:
        predictor: model in evaluation mode, as `load_with_description` returns it.
        description: its description.
        into: folder to write; a new folder or an empty one.

    Raises:
        ConfigError: a package is missing, the model cannot be exported, or the exported model differs from it.
    """
    require_packages()
    if into.is_dir() and any(into.iterdir()):
        raise ConfigError(f"{into} is not empty. Name a new folder, or empty this one.")
    bare = _without_hooks(predictor)
    model = Exporting(bare, description, reader(description).preprocessing())
    if any(isinstance(part, Fitted) for part in bare.modules()):
        raise _refusal(model, "Its density head is fitted in one step and is not a network.")
    try:
        with (
            torch.no_grad()
        ):  # with the hooks of loading, which bound the memory that a stored model may take
            predictor(model.inputs(model.arrays(BATCH, 1.0, padded=False)))
    except (DataError, NonFiniteParameters) as error:
        reason = "It does not accept the random inputs on which an exported model is compared with it"
        raise _refusal(model, f"{reason}: {shorten(error)}") from error
    form, noises = _form(model)
    layout, names = form.layout(), [name for name, _ in form.tensors()]
    modules = sorted(set(form.modules()))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        session, shape = _write_network(model, noises, names, folder / "model.onnx")
        parity = _compare(model, session, noises, form, names)
        code = _write_code(modules, folder)
        content = {
            "format": FORMAT,
            "model": description.method or type(predictor).__name__,
            "trained_on": description.config["data"]["name"],
            "synthetic": description.synthetic,
            "input": _input_entry(model, shape),
            "noise": [noise.entry() for noise in noises if noise.name],
            "target": target_entry(description.target),
            "density": layout,
            "outputs": names,
            "modules": code,
            "calibration": list(description.remarks),
            "remarks": sorted(set(form.remarks())),
            "parity": parity,
            "milliseconds": _latency(model, session, noises),
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
    missing = [name for name in PACKAGES if find_spec(name) is None]
    if missing:
        raise ConfigError(f"mode=export needs the package {missing[0]}, which is not installed. Run {EXTRA}.")


def _without_hooks(predictor: Predictor) -> Predictor:
    """Return a copy of a model without the hooks of loading, which bound memory and cannot be traced."""
    bare = copy.deepcopy(predictor).cpu().eval().requires_grad_(False)
    for module in bare.modules():
        module._forward_hooks.clear()
        module._forward_pre_hooks.clear()
    return bare


@dataclass(frozen=True)
class ModelNoise:
    """Random numbers that a model draws for a batch.

    Attributes:
        name: name of the exported model's input for these numbers; "" if the density does not depend on them.
        kind: "uniform" in [0, 1), or "normal" with mean 0 and variance 1.
        shape: length of each dimension; a text such as "50 * batch" stands for a multiple of the number of inputs.
        dtype: data type.
    """

    name: str
    kind: str
    shape: tuple[int | str, ...]
    dtype: torch.dtype

    def draw(self, count: int, seed: int) -> Tensor:
        """Return random numbers of this kind for `count` inputs."""
        shape = tuple(
            size if isinstance(size, int) else count * multiple_of_batch(size) for size in self.shape
        )
        return Noise(self.kind, shape, self.dtype).draw(torch.Generator().manual_seed(seed))

    def dynamic_shape(self, batch: Any) -> dict[int, Any]:
        """Return the dimensions that depend on the number of inputs, in the form of torch.export's `dynamic_shapes`.

        `batch` is torch.export's symbol for the number of inputs.
        """
        return {
            axis: multiple_of_batch(size) * batch
            for axis, size in enumerate(self.shape)
            if isinstance(size, str)
        }

    def entry(self) -> dict[str, Any]:
        """Return the fields of `ModelNoise` as plain values, as density.json contains them."""
        dtype = str(self.dtype).removeprefix("torch.")
        return {"name": self.name, "kind": self.kind, "shape": list(self.shape), "dtype": dtype}


def multiple_of_batch(size: str) -> int:
    """Return the factor in a length of `ModelNoise.shape` that is a text: 50 for "50 * batch"."""
    return int(size.partition(" ")[0])


@torch.no_grad()
def _form(model: Exporting) -> tuple[Exported, list[ModelNoise]]:
    """Return the parameters of the model's density for a batch of arrays, and the random numbers that it draws.

    Raises:
        ConfigError: the density cannot be exported, or two calls give different densities.
    """
    arrays = model.arrays(BATCH, 1.0)
    batch = reader(model.description).user_batch(arrays.numpy())
    if reader(model.description).frame(batch) is not None:
        raise _refusal(model, "Its targets are given in a frame that is computed from each input.")
    noises = _noises(model, arrays)
    numbers: list[Tensor | None] = [noise.draw(BATCH, number) for number, noise in enumerate(noises)]
    forms = []
    for seed in (0, 1):
        torch.manual_seed(seed)
        forms.append(model.form(arrays, numbers))
    if not _equal(*forms):
        raise _refusal(model, RANDOM)
    named = []
    for number, noise in enumerate(noises):
        others = [*numbers[:number], noise.draw(BATCH, 1000 + number), *numbers[number + 1 :]]
        unused = _equal(forms[0], model.form(arrays, others))
        named.append(replace(noise, name="" if unused else f"noise{number}"))
    return forms[0], named


def _noises(model: Exporting, arrays: Tensor) -> list[ModelNoise]:
    """Return a description of each array of random numbers that a model draws, in the order of the draws.

    The model is called with two batches of different sizes. A length that differs between them is a multiple of the
    batch size.

    Raises:
        ConfigError: the number of random numbers depends on the inputs in another way, or is above MOST_NOISE.
    """
    noises_by_batch = []
    for part in (arrays, arrays[:FEWER]):
        with torch.no_grad(), given_draws() as noises:
            exported(model.density(part))
        noises_by_batch.append(noises)
    if len(noises_by_batch[0]) != len(noises_by_batch[1]):
        raise _refusal(model, VARYING)
    result = []
    for many, few in zip(*noises_by_batch, strict=True):
        shape: list[int | str] = []
        for size, other in zip(many.shape, few.shape, strict=True):
            if size != other and (size * FEWER != other * BATCH or size % BATCH):
                raise _refusal(model, VARYING)
            shape.append(size if size == other else f"{size // BATCH} * batch")
        noise = ModelNoise("", many.kind, tuple(shape), many.dtype)
        if noise.draw(1, 0).numel() > MOST_NOISE:
            raise _refusal(model, f"It draws more than {MOST_NOISE:,} random numbers for one input.")
        result.append(noise)
    return result


def _equal(first: Exported, second: Exported) -> bool:
    pairs = zip(first.tensors(), second.tensors(), strict=True)
    return all(torch.equal(tensor, other) for (_, tensor), (_, other) in pairs)


def _refusal(model: Exporting, reason: str) -> ConfigError:
    name = model.description.method or type(model.predictor).__name__
    return ConfigError(
        f"The model {name} cannot be exported. {reason} Use framework.load or framework.freeze for it."
    )


def _write_network(
    model: Exporting, noises: Sequence[ModelNoise], names: list[str], file: Path
) -> tuple[Session, tuple[int | str, ...]]:
    """Trace the model, and write it as ONNX.

    Returns:
        A session of ONNX Runtime, and the shape of an input, in which the number of points of a cloud is a word.

    Raises:
        ConfigError: torch cannot trace a part of the model, or ONNX has no form for it.
    """
    traced = Traced(model, [bool(noise.name) for noise in noises]).eval()
    used = [noise for noise in noises if noise.name]
    arrays = model.arrays(2, 1.0)
    batch = torch.export.Dim("batch", min=1)
    dynamic: tuple[Any, ...] = ({0: batch, **({1: torch.export.Dim.AUTO} if model.cloud else {})},)
    arguments: tuple[Any, ...] = (arrays,)
    if used:
        arguments = (arrays, tuple(noise.draw(2, number) for number, noise in enumerate(used)))
        dynamic = (*dynamic, tuple(noise.dynamic_shape(batch) for noise in used))
    with quiet_export():
        try:
            program = torch.export.export(traced, arguments, dynamic_shapes=dynamic, strict=False)
            write_onnx(program, ["input", *(noise.name for noise in used)], names, str(file))
        except Exception as error:
            raise _refusal(model, _reason(error)) from error
        try:
            session = Session(file)
        except Exception as error:
            reason = shorten(str(error).rpartition("failed:")[2], 120)
            raise _refusal(model, f"ONNX Runtime cannot load it ({reason}).") from error
    first = next(iter(program.graph_signature.user_inputs))
    node = next(node for node in program.graph.nodes if node.name == first)
    value: Any = node.meta["val"]
    lengths: tuple[Any, ...] = tuple(value.shape[1:])
    return session, tuple(length if isinstance(length, int) else "points" for length in lengths)


def _reason(error: BaseException) -> str:
    """Return the reason for which a model cannot be traced, from the first error of a chain.

    It is the message of an error of this framework, or else names the innermost part of the model.
    """
    while error.__cause__ is not None:
        error = error.__cause__
    if isinstance(error, UserError):
        return str(error)
    parts = [frame.f_locals.get("self") for frame, _ in traceback.walk_tb(error.__traceback__)]
    own = [
        part
        for part in parts
        if isinstance(part, nn.Module) and not type(part).__module__.startswith("torch.")
    ]
    name = type(own[-1]).__name__ if own and not isinstance(own[-1], Traced) else "density"
    lines = [line.strip() for line in str(error).replace("\x1b[96m", "").replace("\x1b[0m", "").splitlines()]
    cause = next((line for line in lines if line), type(error).__name__)
    return f"Its part {name} is not a sequence of operations that torch.export can follow ({shorten(cause, 120)})."


@torch.no_grad()
def _compare(
    model: Exporting, session: Session, noises: Sequence[ModelNoise], form: Exported, names: list[str]
) -> dict[str, dict[str, float]]:
    """Return the largest differences between the exported and the original model.

    The keys are the kind of inputs (`EXTREMES`), and then "parameters" or "log_density". Log-densities of a family that
    replaces an estimate (`Exported.remark`) are not compared.

    Raises:
        ConfigError: a difference is above its limit.
    """
    families = {
        key: family
        for name in set(form.modules())
        for key, family in importlib.import_module(name).FAMILIES.items()
    }
    layout, estimated = form.layout(), any(form.remarks())
    report: dict[str, dict[str, float]] = {}
    for label, spread in EXTREMES.items():
        trials = [_try(model, session, noises, names, count, spread) for count in (1, BATCH)]
        parameters = {name: max(trial.difference(name) for trial in trials) for name in names}
        for name in names:
            if not parameters[name] <= PARITY:
                _require_small_error(model, name, trials, label)
        report[label] = {"parameters": max(parameters.values(), default=0.0)}
        if estimated:
            continue
        densities = max(_density_difference(trial, layout, families) for trial in trials)
        report[label]["log_density"] = densities
        # extreme densities have log-densities that float32 itself does not resolve
        if not (densities <= DENSITY_PARITY or spread > 1):
            raise _refusal(
                model,
                f"The log-densities that NumPy computes differ from its own by {densities:.1e} for {label} inputs, but "
                f"at most {DENSITY_PARITY:g} is allowed, as a share of max(1, |log-density|).",
            )
    return report


@dataclass(frozen=True)
class Trial:
    """A call of the exported and of the original model with the same arrays.

    Attributes:
        density: the densities of the original model.
        outputs: parameters of the density by name, from the exported model.
        own: parameters of the density by name, from the original model.
        double: function that returns the parameters from the original model in float64, or None if this model cannot
            compute in float64.
    """

    density: torch.distributions.Distribution
    outputs: Mapping[str, np.ndarray]
    own: Mapping[str, np.ndarray]
    double: Callable[[], Mapping[str, np.ndarray] | None]

    def difference(self, name: str) -> float:
        """Return the difference of a parameter between the exported and the original model (`_difference`)."""
        return _difference(self.outputs[name], self.own[name])


def _try(
    model: Exporting,
    session: Session,
    noises: Sequence[ModelNoise],
    names: list[str],
    count: int,
    spread: float,
) -> Trial:
    """Call the exported and the original model with `count` random arrays (`Exporting.accepted_arrays`)."""
    arrays = model.accepted_arrays(count, spread)
    numbers = [noise.draw(count, number) for number, noise in enumerate(noises)]
    outputs = dict(zip(names, session.run(names, feed(arrays, noises, numbers)), strict=True))
    with given_draws(numbers):
        density = model.density(arrays)
        own = {name: tensor.numpy() for name, tensor in exported(density).tensors()}
    return Trial(density, outputs, own, lambda: _in_float64(model, arrays, numbers))


def _require_small_error(model: Exporting, name: str, trials: Sequence[Trial], label: str) -> None:
    """Require that the error of an exported parameter is at most ROUNDING times the original model's own error.

    Args:
        model: the original model.
        name: name of the parameter.
        trials: calls of both models.
        label: kind of the inputs, for the message.

    Raises:
        ConfigError: the error is larger, or the model cannot compute in float64.
    """
    exact = [(trial.double() or {}).get(name) for trial in trials]
    difference = max(trial.difference(name) for trial in trials)
    clause = (
        f"The exported network differs from it by {difference:.1e} in the parameter {name} for {label} inputs"
    )
    shares = f"These are shares of the largest {name} of an input, or of 1."
    if any(values is None for values in exact):
        raise _refusal(
            model,
            f"{clause}, and at most {PARITY:g} is allowed for a model that cannot compute in float64. {shares}",
        )
    pairs = [(trial, values) for trial, values in zip(trials, exact, strict=True) if values is not None]
    error = max(_difference(trial.outputs[name], values) for trial, values in pairs)
    own_error = max(_difference(trial.own[name], values) for trial, values in pairs)
    if not error <= ROUNDING * own_error < math.inf:
        raise _refusal(
            model,
            f"{clause}. Compared with the model in float64, its error is {error:.1e}, but at most {ROUNDING:g} times "
            f"the model's own rounding error of {own_error:.1e} is allowed. {shares}",
        )


def _density_difference(trial: Trial, layout: Mapping[str, Any], families: Mapping[str, Any]) -> float:
    """Return the largest difference between the log-densities of NumPy and torch, as a share of max(1, |log-density|).

    Both are computed from the parameters of the original model: rounding in the last digit of a narrow density's mean
    changes log-densities a lot.
    """
    torch.manual_seed(0)
    values = trial.density.sample(torch.Size((7,)))
    expected = trial.density.log_prob(values).double().numpy()
    computed = build(layout, trial.own, families).log_prob(values.double().numpy())
    finite = np.isfinite(expected)
    away = np.abs(computed - expected)[finite] / np.maximum(1, np.abs(expected[finite]))
    return float(away.max(initial=0))


@torch.no_grad()
def _in_float64(model: Exporting, arrays: Tensor, numbers: Sequence[Tensor]) -> dict[str, np.ndarray] | None:
    """Return the parameters of the density from the model in float64; None if it cannot compute in float64.

    The model reads the same inputs as in float32: both the original and the exported model round the user's arrays to
    float32 before the first layer.

    Args:
        model: the original model.
        arrays: the user's arrays, (batch, *input_shape).
        numbers: the random numbers that the model uses.
    """
    inputs, double = model.inputs(arrays), copy.deepcopy(model.predictor).double()
    try:
        with given_draws([number.double() for number in numbers]):
            density = double(inputs.double() if inputs.is_floating_point() else inputs)
            return {name: tensor.numpy() for name, tensor in exported(density).tensors()}
    except (UserError, RuntimeError, ValueError, TypeError):
        return None


def feed(arrays: Tensor, noises: Sequence[ModelNoise], numbers: Sequence[Tensor]) -> dict[str, np.ndarray]:
    """Return the inputs of an exported model by name.

    Args:
        arrays: the user's arrays, (batch, *input_shape).
        noises: descriptions of the random numbers that the model draws.
        numbers: random numbers for each description, in the same order; those without a name are not fed.
    """
    used = {noise.name: tensor.numpy() for noise, tensor in zip(noises, numbers, strict=True) if noise.name}
    return {"input": arrays.numpy(), **used}


def _difference(computed: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest difference of two arrays, as a share of max(1, largest |number| of `expected` in the row).

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
    """Copy the scripts and the NumPy code of the densities, and return the names of the modules of densities."""
    names = {path: "densities" if path == NUMPY else path.rpartition(".")[2] for path in (NUMPY, *modules)}
    scripts = Path(str(exported_folder.__file__)).parent
    # the scripts are not imported here, because they need packages of the exported folder
    sources = {name: (scripts / f"{name}.py").read_text(encoding="utf-8") for name in SCRIPTS}
    sources |= {name: getsource(importlib.import_module(path)) for path, name in names.items()}
    sources["input_ranges"] = getsource(input_ranges)
    for name, source in sources.items():
        # in the exported folder, the files import each other by their bare names
        bare = source.replace(f"from {NUMPY} ", "from densities ").replace(f"from {PACKAGE}.", "from ")
        bare = bare.replace(f"from {input_ranges.__name__} ", "from input_ranges ")
        (folder / f"{name}.py").write_text(bare, encoding="utf-8")
    return list(names.values())


def _input_entry(model: Exporting, shape: Sequence[int | str]) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "shape": ["batch", *shape],
        "dtype": str(model.dtype).removeprefix("torch."),
    }
    if model.description.columns:
        entry["columns"] = list(model.description.columns)
    if model.preprocessing is not None and model.preprocessing.missing is not None:
        entry["missing"] = list(model.preprocessing.missing)
    if model.preprocessing is not None and model.preprocessing.ranges is not None:
        entry["low"], entry["high"] = model.preprocessing.ranges.tolist()
    return entry


def target_entry(target: Target) -> dict[str, Any]:
    """Return the target as plain values, with the unit of its numbers."""
    unit = {"angle": "radian", "real": "unit of the training data", "class": "label", "image": "sRGB, 0 to 1"}
    return {"kind": target.kind, "names": list(target.names), "unit": unit[target.kind]}


@torch.no_grad()
def _latency(model: Exporting, session: Session, noises: Sequence[ModelNoise]) -> dict[str, dict[str, float]]:
    """Return processor milliseconds of a batch, by batch size and form of the model, on one thread."""
    frozen = freeze_predictor(model.predictor, model.description.input_shape)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        times: dict[str, dict[str, float]] = {}
        for count in (1, 64):
            arrays = model.arrays(count, 1.0)
            inputs = model.inputs(arrays)
            inputs_by_name = feed(arrays, noises, [noise.draw(count, 0) for noise in noises])
            forms: dict[str, Callable[[], object]] = {
                "torch": lambda inputs=inputs: model.predictor(inputs),
                "frozen": lambda inputs=inputs: frozen.density(inputs),
                "onnxruntime": lambda inputs_by_name=inputs_by_name: session.run(None, inputs_by_name),
            }
            times[str(count)] = {name: round(_milliseconds(call), 4) for name, call in forms.items()}
        return times
    finally:
        torch.set_num_threads(threads)


def _milliseconds(call: Callable[[], object], seconds: float = 0.1) -> float:
    """Return the median processor time of a call, milliseconds, after a first call that may compile and load code."""
    call()
    times: list[float] = []
    while sum(times) < seconds and len(times) < 200:
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return 1e3 * median(times)
