"""Fully connected layers, read from the graph of a model and computed by a compiled function or by torch.

The tests enable type checks that wrap every function; `no_type_check` excludes functions that must be compiled.
"""

import copy
import logging
import math
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple, no_type_check

import numpy as np
import torch
from torch import Tensor, nn
from torch.fx import Node

from framework.density_head import DensityHead, Fitted
from framework.deployment.onnx_programs import Session, can_run_onnx
from framework.model import Model
from framework.storage.kernels import compiler, kernel_cache

LEAVES = (nn.Linear, nn.BatchNorm1d, nn.ReLU, nn.Dropout, nn.Flatten, nn.Identity, nn.Sequential)
"""Layers that a `Network` may have.

A model with other layers is not traced by torch.export, because the trace would take long and then fail.
"""
FEW = 8  # largest batch for which the compiled softmax is faster than torch's
MOST_RAW = 2048  # largest number of raw parameters of a head that is tested for a softmax


@dataclass
class Layer:
    """Step of a `Network` that computes a fully connected layer: registers[source] @ weight + bias.

    `weight` has the shape (inputs, outputs). If `rectified` is True, negative outputs are set to 0. `tensors` are
    weight and bias as tensors, which `Network.cast` sets.
    """

    source: int
    weight: np.ndarray
    bias: np.ndarray
    rectified: bool = False
    tensors: tuple[Tensor, Tensor] | None = None

    def of_one(self, registers: Sequence[np.ndarray]) -> np.ndarray:
        """Return the outputs of the layer for one sample, (1, outputs)."""
        outputs = np.empty((1, len(self.bias)), self.bias.dtype)
        compute_layer(registers[self.source][0], self.weight, self.bias, self.rectified, outputs[0])
        return outputs

    def of_batch(self, registers: Sequence[Tensor]) -> Tensor:
        """Return the outputs of the layer for a batch, (batch, outputs)."""
        weight, bias = self.tensors or (torch.from_numpy(self.weight), torch.from_numpy(self.bias))
        outputs = torch.addmm(bias, registers[self.source], weight)
        return outputs.relu_() if self.rectified else outputs


class Concatenation(NamedTuple):
    """Step of a `Network` that concatenates the registers `sources` along the second dimension."""

    sources: tuple[int, ...]

    def of_one(self, registers: Sequence[np.ndarray]) -> np.ndarray:
        """Return the concatenated registers of one sample, (1, sum of lengths)."""
        return np.concatenate([registers[source] for source in self.sources], 1)

    def of_batch(self, registers: Sequence[Tensor]) -> Tensor:
        """Return the concatenated registers of a batch, (batch, sum of lengths)."""
        return torch.cat([registers[source] for source in self.sources], 1)


@dataclass
class Network:
    """Sequence of steps that computes raw parameters from features.

    The intermediate results are called registers and numbered. Register 0 has the features, (batch, length). Each step
    reads registers of earlier numbers, and its output is the next register.

    For one sample the layers are compiled functions. Two or more samples are computed by ONNX Runtime or, if it is not
    installed, by torch. Both are then faster, because they read the weights only once for all samples of the batch
    (benchmarks/framework/frozen.md).

    Attributes:
        steps: the steps, in order.
        result: number of the register with the raw parameters.
        dtype: data type of all numbers.
        classes: True if the register `result` has class logits instead of raw parameters.
        session: ONNX Runtime's session for two or more samples; None if torch computes them, and before the first call.
        cast_to_type: True after `cast` has converted weights and biases to `dtype`.
    """

    steps: list[Layer | Concatenation]
    result: int
    dtype: np.dtype
    classes: bool = False
    session: Session | None = None
    cast_to_type: bool = False

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """Return the raw parameters, or the class logits, for features."""
        if len(features) == 1:
            arrays = [features]
            for step in self.steps:
                arrays.append(step.of_one(arrays))
            return arrays[self.result]
        if len(features) > 1 and (session := self._session_of_batches()) is not None:
            return session.run(None, {"features": features})[0]
        with torch.inference_mode():
            # torch requires writable memory
            tensors = [torch.from_numpy(features if features.flags.writeable else features.copy())]
            for step in self.steps:
                tensors.append(step.of_batch(tensors))
            return tensors[self.result].numpy()

    def _session_of_batches(self) -> Session | None:
        """Return the session of ONNX Runtime that computes batches; None if it is not installed."""
        if self.session is None and self.cast_to_type and self.steps and can_run_onnx():
            self.session = Session(self._onnx(), torch.get_num_threads())
        return self.session

    def _onnx(self) -> bytes:
        """Return the network as the content of an ONNX file."""
        from onnx import TensorProto, helper, numpy_helper

        kind = TensorProto.DOUBLE if self.dtype == np.float64 else TensorProto.FLOAT
        names, nodes, numbers = ["features"], [], []
        for number, step in enumerate(self.steps, 1):
            name = f"register{number}"
            if isinstance(step, Concatenation):
                sources = [names[source] for source in step.sources]
                nodes.append(helper.make_node("Concat", sources, [name], axis=1))
            else:
                parts = {f"weight{number}": step.weight, f"bias{number}": step.bias}
                numbers += [numpy_helper.from_array(array, key) for key, array in parts.items()]
                affine = f"affine{number}" if step.rectified else name
                nodes.append(helper.make_node("Gemm", [names[step.source], *parts], [affine]))
                if step.rectified:
                    nodes.append(helper.make_node("Relu", [affine], [name]))
            names.append(name)
        inputs = [helper.make_tensor_value_info("features", kind, ["batch", None])]
        outputs = [helper.make_tensor_value_info(names[self.result], kind, ["batch", None])]
        graph = helper.make_graph(nodes, "network", inputs, outputs, numbers)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
        content: bytes = model.SerializeToString()
        return content

    def cast(self, dtype: np.dtype) -> None:
        """Convert weights and biases to the type in which the network computes."""
        self.dtype, self.cast_to_type = dtype, True
        for step in self.steps:
            if isinstance(step, Layer):
                # clones of torch begin at cache lines, which the products read faster
                tensors = [
                    torch.from_numpy(np.array(part, dtype, order="C")).clone()
                    for part in (step.weight, step.bias)
                ]
                step.weight, step.bias = (tensor.numpy() for tensor in tensors)
                step.tensors = tensors[0], tensors[1]


def read_network(model: Model, shape: tuple[int, ...]) -> Network | None:
    """Read a model's encoders and last linear layer as a `Network`; return None if this is not possible.

    It is possible for encoders of fully connected layers, batch norm, dropout and ReLU (`LEAVES`). If the density of
    the head is a softmax of an affine function of the raw parameters, the network includes this function.

    Args:
        model: model in evaluation mode.
        shape: shape of one input.
    """
    leaves = [part for part in model.encoders.modules() if not list(part.children())]
    first = next(model.parameters(), None)
    if (
        not all(isinstance(part, LEAVES) for part in leaves)
        or first is None
        or isinstance(model.head, Fitted)
    ):
        return None
    module = nn.Sequential(model.encoders, model.projection)
    generator = torch.Generator().manual_seed(0)
    probe = torch.randn(3, *shape, generator=generator, dtype=torch.float64).to(first)
    disabled = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with redirect_stderr(
            StringIO()
        ):  # the exporter prints and logs many messages about unsupported operations
            exported = torch.export.export(module, (probe,), dynamic_shapes=({0: torch.export.Dim("batch")},))
        network = _Reader(exported).network()
        if not all(agrees(network, module, probe[:count]) for count in (1, 3)):
            return None
    except Exception:  # the exporter raises many kinds of errors, depending on the encoder
        return None
    finally:
        logging.disable(disabled)
    last = network.steps[network.result - 1] if network.result else None
    logits = affine_logits(model.head)
    if logits is not None and isinstance(last, Layer) and not last.rectified:
        matrix, constant = logits
        last.weight, last.bias = last.weight @ matrix, last.bias @ matrix + constant
        network.classes = True
    network.cast(probe.numpy().dtype)
    return network


@torch.no_grad()
def agrees(network: "Network", module: nn.Module, inputs: Tensor) -> bool:
    """Return whether network and module give the same raw parameters for `inputs`, up to rounding errors.

    Batch norm may amplify rounding errors, so 10⁴ times the machine precision is allowed.
    """
    actual, expected = network(inputs.flatten(1).double().numpy()), module(inputs).numpy()
    allowed = 1e4 * np.finfo(expected.dtype).eps * max(1.0, float(np.abs(expected).max()))
    return bool(np.abs(actual - expected).max() <= allowed)


class UnreadableGraph(Exception):
    """Error for a graph with operations other than fully connected layers."""


class Signal(NamedTuple):
    """Value of a node of a model's graph: scale * (content of register number `register`) + shift, element by element.

    A scale of None stands for 1, and a shift of None for 0.
    """

    register: int
    scale: np.ndarray | None = None
    shift: np.ndarray | None = None


class _Reader:
    """Converter of a model's exported graph (torch.export) into a `Network` of float64."""

    def __init__(self, exported: torch.export.ExportedProgram) -> None:
        self.graph = exported.graph
        signature = exported.graph_signature
        keys_by_name: Mapping[str, Any] = {**signature.inputs_to_parameters, **signature.inputs_to_buffers}
        self.numbers = {
            name: exported.state_dict[key].detach().double().numpy() for name, key in keys_by_name.items()
        }
        self.inputs = signature.user_inputs
        self.steps: list[Layer | Concatenation] = []
        self.signals: dict[Node, Signal] = {}

    def network(self) -> Network:
        """Return the network of the graph.

        Raises:
            UnreadableGraph: the graph has operations other than those of fully connected layers.
        """
        result = None
        for node in self.graph.nodes:
            if node.op == "placeholder":
                if node.name in self.inputs:
                    self.signals[node] = Signal(0)
            elif node.op == "output":
                result = self.signals[node.args[0][0]]
            elif str(node.target) != "aten._assert_tensor_metadata.default":
                self.signals[node] = self._signal(node, str(node.target).removeprefix("aten.").split(".")[0])
        if result is None or result.scale is not None:
            raise UnreadableGraph
        return Network(self.steps, result.register, np.dtype(np.float64))

    def _signal(self, node: Node, name: str) -> Signal:
        """Return the value of a node, whose operation is `name`; add a step to the network if the node needs one."""
        arguments: Any = node.args
        if name == "cat":
            return self._concatenate(arguments[0], arguments[1:])
        source = self.signals[arguments[0]]
        flat = node.meta["val"].dim() == 2
        if name in ("flatten", "view", "reshape", "contiguous", "clone", "detach", "alias") and flat:
            return source
        if name == "to" and node.meta["val"].dtype == arguments[0].meta["val"].dtype:
            return source
        if name == "dropout" and not arguments[2]:
            return source
        if arguments[0].meta["val"].dim() == 2:
            if name == "linear":
                return self._add_layer(source, arguments)
            if name == "batch_norm" and not arguments[5]:
                return self._fold_batch_norm(source, arguments)
            if (
                name in ("relu", "relu_")
                and (layer := self._exclusive_layer(arguments[0]))
                and source.scale is None
            ):
                layer.rectified = True
                return source
        raise UnreadableGraph

    def _add_layer(self, source: Signal, arguments: Any) -> Signal:
        """Add a step for a fully connected layer, and return the value of its node."""
        weight = self.numbers[arguments[1].name].T
        bias = self._parameter(arguments, 2, np.zeros(weight.shape[1]))
        if source.scale is not None:
            # (s x + t) W + b = x (s W) + (t W + b)
            weight, bias = source.scale[:, None] * weight, source.shift @ weight + bias
        self.steps.append(Layer(source.register, weight, bias))
        return Signal(len(self.steps))

    def _fold_batch_norm(self, source: Signal, arguments: Any) -> Signal:
        """Fold batch norm, (x - mean) / √(variance + ε) * weight + bias, into a neighbouring layer.

        Batch norm is folded into the layer before it if no other node reads that layer, and otherwise into the layer
        after it.
        """
        mean, variance = (self.numbers[arguments[index].name] for index in (3, 4))
        scale = self._parameter(arguments, 1, np.ones_like(mean)) / np.sqrt(variance + arguments[7])
        shift = self._parameter(arguments, 2, np.zeros_like(mean)) - mean * scale
        if source.scale is None and (layer := self._exclusive_layer(arguments[0])):
            layer.weight, layer.bias = layer.weight * scale, layer.bias * scale + shift
            return source
        if source.scale is None:
            return Signal(source.register, scale, shift)
        return Signal(source.register, source.scale * scale, source.shift * scale + shift)

    def _concatenate(self, nodes: Sequence[Node], axis: Sequence[int]) -> Signal:
        """Add a step for a concatenation, and return the value of its node."""
        if any(node.meta["val"].dim() != 2 for node in nodes) or list(axis) not in ([1], [-1]):
            raise UnreadableGraph
        signals = [self.signals[node] for node in nodes]
        self.steps.append(Concatenation(tuple(signal.register for signal in signals)))
        if all(signal.scale is None for signal in signals):
            return Signal(len(self.steps))
        widths = [int(node.meta["val"].shape[1]) for node in nodes]
        pairs = list(zip(signals, widths, strict=True))
        scale = [np.ones(width) if signal.scale is None else signal.scale for signal, width in pairs]
        shift = [np.zeros(width) if signal.shift is None else signal.shift for signal, width in pairs]
        return Signal(len(self.steps), np.concatenate(scale), np.concatenate(shift))

    def _exclusive_layer(self, node: Node) -> Layer | None:
        """Return the layer that computes a node if no other node reads the layer's output; None otherwise."""
        register = self.signals[node].register
        step = self.steps[register - 1] if register else None
        nodes = [other for other, signal in self.signals.items() if signal.register == register]
        exclusive = all(len(other.users) == 1 for other in nodes)
        return step if isinstance(step, Layer) and not step.rectified and exclusive else None

    def _parameter(self, arguments: Any, index: int, otherwise: np.ndarray) -> np.ndarray:
        """Return the weight tensor that an operation of the graph has as its argument number `index`.

        If the operation has no such argument, `otherwise` is returned.
        """
        present = len(arguments) > index and arguments[index] is not None
        return self.numbers[arguments[index].name] if present else otherwise


@torch.no_grad()
def affine_logits(head: DensityHead) -> tuple[np.ndarray, np.ndarray] | None:
    """Return matrix (size, class) and constant (class,) of a head whose density is softmax(raw @ matrix + constant).

    Matrix and constant are computed in float64 from the head's densities for the raw parameters 0 and each unit vector,
    and checked with random raw parameters of several magnitudes. So no head has to declare them. The function returns
    None for any other head, whose density torch computes.
    """
    if head.size > MOST_RAW:
        return None
    double_head = copy.deepcopy(head).double()
    generator = torch.Generator().manual_seed(0)
    probes = torch.randn(96, head.size, generator=generator, dtype=torch.float64)
    probes *= torch.tensor([0.01, 1.0, 30.0], dtype=torch.float64).repeat(32).unsqueeze(1)
    raw = torch.cat([torch.zeros(1, head.size), torch.eye(head.size), probes])
    with torch.random.fork_rng([]):
        density = double_head(raw)
        if not density.has_enumerate_support or tuple(density.event_shape):
            return None
        log_prob = density.log_prob(density.enumerate_support()).T
    odds = (log_prob - log_prob[:, :1]).numpy()
    constant, matrix = odds[0], odds[1 : 1 + head.size] - odds[0]
    error = np.abs(raw.numpy() @ matrix + constant - odds).max()
    return (matrix, constant) if error <= 1e-11 * max(1.0, np.abs(odds).max()) else None


compiled = compiler(kernel_cache("frozen_network", [Path(__file__)]))


@compiled
@no_type_check
def compute_layer(numbers, weight, bias, rectified, outputs):
    """Compute outputs = numbers @ weight + bias for one sample, without reading the weights of inputs that are 0.

    For one sample, reading the weights takes most of the time, and after a ReLU about half of the inputs are 0. Eight
    inputs are processed at a time, so that the outputs are read and written eight times less often.

    Args:
        numbers: inputs of the layer, (inputs,).
        weight: weights, (inputs, outputs).
        bias: constants, (outputs,).
        rectified: true if negative outputs are set to 0.
        outputs: filled with the outputs, (outputs,).
    """
    length, width = weight.shape
    nonzero = np.empty(length, np.int64)
    count = 0
    for i in range(length):
        if numbers[i] != 0:  # NaN is not 0
            nonzero[count] = i
            count += 1
    for j in range(width):
        outputs[j] = bias[j]
    full = count - count % 8
    for start in range(0, full, 8):
        a, b, c, d = nonzero[start], nonzero[start + 1], nonzero[start + 2], nonzero[start + 3]
        e, f, g, h = nonzero[start + 4], nonzero[start + 5], nonzero[start + 6], nonzero[start + 7]
        p, q, r, s = numbers[a], numbers[b], numbers[c], numbers[d]
        t, u, v, w = numbers[e], numbers[f], numbers[g], numbers[h]
        for j in range(width):
            near = (p * weight[a, j] + q * weight[b, j]) + (r * weight[c, j] + s * weight[d, j])
            far = (t * weight[e, j] + u * weight[f, j]) + (v * weight[g, j] + w * weight[h, j])
            outputs[j] += near + far
    for start in range(full, count):
        a = nonzero[start]
        p = numbers[a]
        for j in range(width):
            outputs[j] += p * weight[a, j]
    if rectified:
        for j in range(width):
            if outputs[j] < 0:
                outputs[j] = 0


def to_probabilities(logits: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the softmax of each row of `logits`, which is overwritten, and whether all logits are finite.

    A row with a number that is not finite becomes NaN.
    """
    if len(logits) <= FEW:
        return logits, softmax(logits)
    tensor = torch.from_numpy(logits)
    probabilities = torch.softmax(tensor, 1)
    if math.isfinite(tensor.sum()):  # a finite sum has only finite summands
        return probabilities.numpy(), True
    finite = tensor.isfinite().all(1)
    probabilities[~finite] = math.nan
    return probabilities.numpy(), bool(finite.all())


@compiled
@no_type_check
def softmax(logits):
    """Replace each row of `logits`, in place, by its softmax; a row with a number that is not finite becomes NaN.

    Return whether all logits are finite.
    """
    all_finite = True
    for row in range(logits.shape[0]):
        largest = logits[row, 0]
        for j in range(logits.shape[1]):
            largest = max(largest, logits[row, j])
        total = 0.0
        for j in range(logits.shape[1]):
            total += 0 * logits[row, j]  # 0 times infinity is NaN
            logits[row, j] = np.exp(logits[row, j] - largest)
            total += logits[row, j]
        all_finite = all_finite and total == total  # NaN is not equal to itself
        for j in range(logits.shape[1]):
            logits[row, j] /= total
    return all_finite
