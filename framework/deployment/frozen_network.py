"""Reads the fully connected layers of a model from its graph, and computes them in NumPy and compiled functions.

`no_type_check` prevents the type checks that tests switch on from wrapping a kernel before it is compiled.
"""

import copy
import logging
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
from framework.model import Model
from framework.storage.kernels import compiler, kernel_cache

LEAVES = (nn.Linear, nn.BatchNorm1d, nn.ReLU, nn.Dropout, nn.Flatten, nn.Identity, nn.Sequential)
"""Kinds of layers that a network may hold; the export of another one takes long and cannot succeed."""
MOST_RAW = 2048  # largest number of raw parameters of a head that is tested for a softmax


@dataclass
class Layer:
    """Step of a fully connected layer: register `source` times `weight` (inputs, outputs) plus `bias`.

    `rectified` sets negative results to 0.
    """

    source: int
    weight: np.ndarray
    bias: np.ndarray
    rectified: bool = False

    def __call__(self, registers: Sequence[np.ndarray]) -> np.ndarray:
        """Return the result of the layer, (batch, outputs)."""
        numbers = registers[self.source]
        if len(numbers) == 1:
            found = np.empty((1, len(self.bias)), self.bias.dtype)
            connected(numbers[0], self.weight, self.bias, self.rectified, found[0])
            return found
        # Two or more samples share the reading of the weights (benchmarks/framework/frozen.md).
        with np.errstate(invalid="ignore", over="ignore"):  # the caller refuses numbers that are not finite
            found = numbers @ self.weight
            found += self.bias
        return np.maximum(found, 0, out=found) if self.rectified else found


class Joined(NamedTuple):
    """Step that concatenates registers."""

    sources: tuple[int, ...]

    def __call__(self, registers: Sequence[np.ndarray]) -> np.ndarray:
        """Return the registers side by side, (batch, sum of lengths)."""
        return np.concatenate([registers[source] for source in self.sources], 1)


@dataclass
class Network:
    """Steps from features (batch, length), register 0, to raw parameters; the result of each step is the next register.

    Attributes:
        result: register of the raw parameters.
        dtype: type of all numbers.
        classes: True if the result is logits of classes instead of the head's raw parameters.
    """

    steps: list[Layer | Joined]
    result: int
    dtype: np.dtype
    classes: bool = False

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """Return the raw parameters or logits for features."""
        registers = [features]
        for step in self.steps:
            registers.append(step(registers))
        return registers[self.result]

    def cast(self, dtype: np.dtype) -> None:
        """Convert weights and biases to the type in which the network computes."""
        self.dtype = dtype
        for step in self.steps:
            if isinstance(step, Layer):
                step.weight = np.ascontiguousarray(step.weight, dtype=dtype)
                step.bias = step.bias.astype(dtype)


def read(model: Model, shape: tuple[int, ...]) -> Network | None:
    """Return the network of a model's encoders and linear layer; None if the model is of another kind.

    The network includes the head if the head is a softmax.
    """
    leaves = [part for part in model.encoders.modules() if not list(part.children())]
    first = next(model.parameters(), None)
    if (
        not all(isinstance(part, LEAVES) for part in leaves)
        or first is None
        or isinstance(model.head, Fitted)
    ):
        return None
    whole = nn.Sequential(model.encoders, model.projection)
    generator = torch.Generator().manual_seed(0)
    probe = torch.randn(3, *shape, generator=generator, dtype=torch.float64).to(first)
    disabled = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with redirect_stderr(StringIO()):  # the exporter prints and logs pages about what it cannot do
            exported = torch.export.export(whole, (probe,), dynamic_shapes=({0: torch.export.Dim("batch")},))
        network = _Reader(exported).network()
        if not all(agree(network, whole, probe[:count]) for count in (1, 3)):
            return None
    except Exception:  # an encoder may hold anything, and the exporter raises a dozen kinds
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
def agree(network: "Network", whole: nn.Module, inputs: Tensor) -> bool:
    """Return whether network and module give the same raw parameters, up to rounding, which batch norm may amplify."""
    found, wanted = network(inputs.flatten(1).double().numpy()), whole(inputs).numpy()
    allowed = 1e4 * np.finfo(wanted.dtype).eps * max(1.0, float(np.abs(wanted).max()))
    return bool(np.abs(found - wanted).max() <= allowed)


class Unread(Exception):
    """Error for a graph that holds other parts than fully connected layers."""


class Signal(NamedTuple):
    """A node of the graph as scale * register + shift, element by element; both are None if they are 1 and 0."""

    register: int
    scale: np.ndarray | None = None
    shift: np.ndarray | None = None


class _Reader:
    """Converter of an exported graph into a network of float64."""

    def __init__(self, exported: torch.export.ExportedProgram) -> None:
        self.graph = exported.graph
        signature = exported.graph_signature
        held: Mapping[str, Any] = {**signature.inputs_to_parameters, **signature.inputs_to_buffers}
        self.numbers = {
            name: exported.state_dict[key].detach().double().numpy() for name, key in held.items()
        }
        self.inputs = signature.user_inputs
        self.steps: list[Layer | Joined] = []
        self.signals: dict[Node, Signal] = {}

    def network(self) -> Network:
        """Return the network.

        Raises:
            Unread: the graph holds other parts.
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
            raise Unread
        return Network(self.steps, result.register, np.dtype(np.float64))

    def _signal(self, node: Node, name: str) -> Signal:
        """Return the signal of a node, and add the step that computes it if there is one."""
        arguments: Any = node.args
        if name == "cat":
            return self._joined(arguments[0], arguments[1:])
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
                return self._connected(source, arguments)
            if name == "batch_norm" and not arguments[5]:
                return self._normalised(source, arguments)
            if name in ("relu", "relu_") and (layer := self._open(arguments[0])) and source.scale is None:
                layer.rectified = True
                return source
        raise Unread

    def _connected(self, source: Signal, arguments: Any) -> Signal:
        """Add a fully connected layer."""
        weight = self.numbers[arguments[1].name].T
        bias = self._number(arguments, 2, np.zeros(weight.shape[1]))
        if source.scale is not None:
            # (s x + t) W + b = x (s W) + (t W + b)
            weight, bias = source.scale[:, None] * weight, source.shift @ weight + bias
        self.steps.append(Layer(source.register, weight, bias))
        return Signal(len(self.steps))

    def _normalised(self, source: Signal, arguments: Any) -> Signal:
        """Fold batch norm, (x - mean) / √(variance + ε) * weight + bias, into a neighbouring layer.

        It is the layer before it if possible, or else the layer after it.
        """
        mean, variance = (self.numbers[arguments[index].name] for index in (3, 4))
        scale = self._number(arguments, 1, np.ones_like(mean)) / np.sqrt(variance + arguments[7])
        shift = self._number(arguments, 2, np.zeros_like(mean)) - mean * scale
        if source.scale is None and (layer := self._open(arguments[0])):
            layer.weight, layer.bias = layer.weight * scale, layer.bias * scale + shift
            return source
        if source.scale is None:
            return Signal(source.register, scale, shift)
        return Signal(source.register, source.scale * scale, source.shift * scale + shift)

    def _joined(self, nodes: Sequence[Node], axis: Sequence[int]) -> Signal:
        """Add a concatenation."""
        if any(node.meta["val"].dim() != 2 for node in nodes) or list(axis) not in ([1], [-1]):
            raise Unread
        signals = [self.signals[node] for node in nodes]
        self.steps.append(Joined(tuple(signal.register for signal in signals)))
        if all(signal.scale is None for signal in signals):
            return Signal(len(self.steps))
        widths = [int(node.meta["val"].shape[1]) for node in nodes]
        pairs = list(zip(signals, widths, strict=True))
        scale = [np.ones(width) if signal.scale is None else signal.scale for signal, width in pairs]
        shift = [np.zeros(width) if signal.shift is None else signal.shift for signal, width in pairs]
        return Signal(len(self.steps), np.concatenate(scale), np.concatenate(shift))

    def _open(self, node: Node) -> Layer | None:
        """Return the layer whose result a node is, if no other node reads this result; else None."""
        register = self.signals[node].register
        step = self.steps[register - 1] if register else None
        readers = [other for other, signal in self.signals.items() if signal.register == register]
        alone = all(len(other.users) == 1 for other in readers)
        return step if isinstance(step, Layer) and not step.rectified and alone else None

    def _number(self, arguments: Any, index: int, otherwise: np.ndarray) -> np.ndarray:
        """Return the parameter at `index` of a node's arguments, or `otherwise` if it is missing."""
        given = len(arguments) > index and arguments[index] is not None
        return self.numbers[arguments[index].name] if given else otherwise


@torch.no_grad()
def affine_logits(head: DensityHead) -> tuple[np.ndarray, np.ndarray] | None:
    """Return a matrix (size, class) and a constant (class,) of a head whose density is a softmax; None for other heads.

    The density is the softmax of raw @ matrix + constant. They are found from the head's density at 0, at each unit
    vector and at random raw parameters of several sizes, in float64. So no head has to declare them, and torch handles
    every head that is not affine at these points.
    """
    if head.size > MOST_RAW:
        return None
    asked = copy.deepcopy(head).double()
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(96, head.size, generator=generator, dtype=torch.float64)
    drawn *= torch.tensor([0.01, 1.0, 30.0], dtype=torch.float64).repeat(32).unsqueeze(1)
    raw = torch.cat([torch.zeros(1, head.size), torch.eye(head.size), drawn])
    with torch.random.fork_rng([]):
        density = asked(raw)
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
def connected(numbers, weight, bias, rectified, outputs):
    """Compute outputs = numbers @ weight + bias of one sample; the weights of inputs that are 0 are not read.

    After a ReLU about half of the inputs are 0, and reading the weights is the cost of a batch of one. Eight inputs are
    added at a time, so that the outputs are read and written an eighth as often.
    """
    length, width = weight.shape
    alive = np.empty(length, np.int64)
    count = 0
    for i in range(length):
        if numbers[i] != 0:  # NaN is not 0
            alive[count] = i
            count += 1
    for j in range(width):
        outputs[j] = bias[j]
    whole = count - count % 8
    for start in range(0, whole, 8):
        a, b, c, d = alive[start], alive[start + 1], alive[start + 2], alive[start + 3]
        e, f, g, h = alive[start + 4], alive[start + 5], alive[start + 6], alive[start + 7]
        p, q, r, s = numbers[a], numbers[b], numbers[c], numbers[d]
        t, u, v, w = numbers[e], numbers[f], numbers[g], numbers[h]
        for j in range(width):
            near = (p * weight[a, j] + q * weight[b, j]) + (r * weight[c, j] + s * weight[d, j])
            far = (t * weight[e, j] + u * weight[f, j]) + (v * weight[g, j] + w * weight[h, j])
            outputs[j] += near + far
    for start in range(whole, count):
        a = alive[start]
        p = numbers[a]
        for j in range(width):
            outputs[j] += p * weight[a, j]
    if rectified:
        for j in range(width):
            if outputs[j] < 0:
                outputs[j] = 0


@compiled
@no_type_check
def softmax(logits):
    """Replace each row of logits by its softmax; a row with a number that is not finite becomes NaN."""
    for row in range(logits.shape[0]):
        largest = logits[row, 0]
        for j in range(logits.shape[1]):
            largest = max(largest, logits[row, j])
        total = 0.0
        for j in range(logits.shape[1]):
            total += 0 * logits[row, j]  # 0 times infinity is NaN
            logits[row, j] = np.exp(logits[row, j] - largest)
            total += logits[row, j]
        for j in range(logits.shape[1]):
            logits[row, j] /= total
