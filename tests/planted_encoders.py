"""Encoders like those of other authors: correct ones, and ones with a planted fault that `mode=check` must find."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from framework.encoder import Encoder
from tests.planted_base import ChangedClass

IMAGE, VECTOR = (3, 12, 10), (7,)


class Dense(Encoder):
    """Two linear layers with dropout, for vectors."""

    bibtex = ""

    def __init__(self, input_shape: tuple[int, ...]) -> None:
        super().__init__()
        self.output_shape = (5,)
        self.first, self.second = nn.Linear(input_shape[0], 8), nn.Linear(8, 5)
        self.dropout = nn.Dropout(0.2)

    def hidden(self, inputs: Tensor) -> Tensor:
        return self.dropout(self.first(inputs).tanh())

    def forward(self, inputs: Tensor) -> Tensor:
        return self.second(self.hidden(inputs))


class Normed(Dense):
    """Linear layers with batch norm."""

    def __init__(self, input_shape: tuple[int, ...]) -> None:
        super().__init__(input_shape)
        self.norm = nn.BatchNorm1d(8)

    def hidden(self, inputs: Tensor) -> Tensor:
        return self.norm(self.first(inputs)).relu()


class Layered(Dense):
    """Linear layers with layer norm, so that several encoders can be evaluated in one pass."""

    vectorises = True

    def __init__(self, input_shape: tuple[int, ...]) -> None:
        super().__init__(input_shape)
        self.dropout = nn.Dropout(0.0)
        self.norm = nn.LayerNorm(8)

    def hidden(self, inputs: Tensor) -> Tensor:
        return self.norm(self.first(inputs)).relu()


class Conv(Encoder):
    """Two convolutions and a linear layer, for images."""

    bibtex = ""

    def __init__(self, input_shape: tuple[int, ...]) -> None:
        super().__init__()
        self.output_shape = (4,)
        self.first = nn.Conv2d(input_shape[0], 6, 3, padding=1)
        self.second = nn.Conv2d(6, 6, 3, stride=2)
        self.last = nn.Linear(6, 4)

    def pixels(self, inputs: Tensor) -> Tensor:
        return inputs.to(self.last.weight.dtype) / 255 if inputs.dtype == torch.uint8 else inputs

    def forward(self, inputs: Tensor) -> Tensor:
        maps = self.second(self.first(self.pixels(inputs) - 0.5).relu()).relu()
        return self.last(maps.flatten(2).mean(-1))


class Residual(Conv):
    """Convolutions with a residual branch whose factor is small before training."""

    def __init__(self, input_shape: tuple[int, ...]) -> None:
        super().__init__(input_shape)
        self.branch = nn.Linear(4, 4)
        self.gain = nn.Parameter(torch.full((4,), 1e-3))

    def forward(self, inputs: Tensor) -> Tensor:
        found = super().forward(inputs)
        return found + self.gain * self.branch(found).tanh()


class Frozen(Conv):
    """Convolutions that are never trained."""

    def __init__(self, input_shape: tuple[int, ...]) -> None:
        super().__init__(input_shape)
        self.requires_grad_(False)


class Squares(Encoder):
    """Features without parameters: the numbers and their squares."""

    bibtex = ""
    fixed = True

    def __init__(self, input_shape: tuple[int, ...]) -> None:
        super().__init__()
        self.output_shape = (2 * input_shape[0],)

    def forward(self, inputs: Tensor) -> Tensor:
        return torch.cat([inputs, inputs.clamp(-1e6, 1e6).square()], -1)


RIGHT: dict[str, tuple[type[Encoder], tuple[int, ...]]] = {
    "dense": (Dense, VECTOR),
    "batch norm": (Normed, VECTOR),
    "layer norm": (Layered, VECTOR),
    "convolutions": (Conv, IMAGE),
    "grey": (Conv, (1, 9, 14)),
    "a small residual": (Residual, IMAGE),
    "frozen convolutions": (Frozen, IMAGE),
    "squares": (Squares, VECTOR),
}
"""Correct encoders and the shapes of their inputs."""


@dataclass(frozen=True)
class Fault(ChangedClass):
    """An encoder with one planted fault."""

    base: type[Encoder] = Dense

    @property
    def shape(self) -> tuple[int, ...]:
        return VECTOR if issubclass(self.base, Dense | Squares) else IMAGE

    def build(self, shape: tuple[int, ...]) -> Encoder:
        return self.kind(shape)


class HalfSlope(torch.autograd.Function):
    """A matrix product whose gradient in the weights is a tenth too small."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor) -> Tensor:
        ctx.save_for_backward(inputs, weight)
        return inputs @ weight.T

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, Tensor]:  # pyright: ignore[reportIncompatibleMethodOverride]
        inputs, weight = ctx.saved_tensors
        return slope @ weight, 0.9 * slope.T @ inputs


def wrong_product(encoder: Any, inputs: Tensor) -> Tensor:
    found: Any = HalfSlope.apply(inputs, encoder.first.weight)
    return (found + encoder.first.bias).tanh()


def half_detached(encoder: Any, inputs: Tensor) -> Tensor:
    weight = torch.cat([encoder.first.weight[:4].detach(), encoder.first.weight[4:]])
    return functional.linear(inputs, weight, encoder.first.bias).tanh()


def detached_in_training(encoder: Any, inputs: Tensor) -> Tensor:
    found = encoder.first(inputs).tanh()
    return 0.5 * (found + found.detach()) if encoder.training else found


def doubled_bias(encoder: Any, shape: tuple[int, ...]) -> None:
    Dense.__init__(encoder, shape)
    encoder.second.bias.register_hook(lambda slope: 2 * slope)


def chunks_backwards(encoder: Any, inputs: Tensor) -> Tensor:
    """Return the features of long batches, computed in chunks and joined in the wrong order."""
    parts = [encoder.second(encoder.hidden(part)) for part in inputs.split(64)]
    return torch.cat(parts[::-1] if len(inputs) > 100 else parts)


def a_hundred_at_most(encoder: Any, inputs: Tensor) -> Tensor:
    found = Dense.forward(encoder, inputs)
    return torch.cat([found[:100], torch.zeros_like(found[100:])])


def by_large_batches(encoder: Any, inputs: Tensor) -> Tensor:
    return Dense.forward(encoder, inputs - inputs.mean(0) if len(inputs) > 8 else inputs)


def by_the_largest(encoder: Any, inputs: Tensor) -> Tensor:
    return Dense.forward(encoder, inputs / inputs.abs().amax() if inputs.numel() else inputs)


def row_numbers(encoder: Any, inputs: Tensor) -> Tensor:
    place = torch.arange(len(inputs), dtype=inputs.dtype)[:, None]
    return Dense.forward(encoder, inputs) + 0.01 * (place // 32).sin()


def always_dropping(encoder: Any, inputs: Tensor) -> Tensor:
    return functional.dropout(encoder.first(inputs).tanh(), 0.2)


def mean_that_is_not_stored(encoder: Any, inputs: Tensor) -> Tensor:
    if encoder.training and len(inputs):
        last = getattr(encoder, "mean", 0.0)
        encoder.mean = 0.9 * last + 0.1 * inputs.mean().item()
    return encoder.first(inputs - getattr(encoder, "mean", 0.0)).tanh()


def scale_of_the_first(encoder: Any, inputs: Tensor) -> Tensor:
    if not hasattr(encoder, "scale") and len(inputs) > 1:
        encoder.scale = inputs.std().item()
    return encoder.first(inputs / getattr(encoder, "scale", 1.0)).tanh()


def moments_of_tests(encoder: Any, inputs: Tensor) -> Tensor:
    found = encoder.first(inputs)
    if len(inputs):
        with torch.no_grad():
            encoder.norm.running_mean.lerp_(found.mean(0), 0.1)
    return encoder.norm(found).relu()


def known_shapes(encoder: Any, inputs: Tensor) -> Tensor:
    if encoder.training or torch.is_grad_enabled():
        return Dense.forward(encoder, inputs)
    known = encoder.__dict__.setdefault("known", {})
    key = tuple(inputs.shape), inputs.dtype
    return known.setdefault(key, Dense.forward(encoder, inputs))


def in_place(encoder: Any, inputs: Tensor) -> Tensor:
    if inputs.requires_grad:
        return Dense.forward(encoder, inputs * 0.5)
    return Dense.forward(encoder, inputs.mul_(0.5))


def bytes_by_their_size(encoder: Any, inputs: Tensor) -> Tensor:
    inputs = inputs.to(encoder.last.weight.dtype)
    return inputs / 255 if inputs.numel() and inputs.max() > 1 else inputs


def one_channel(encoder: Any, inputs: Tensor) -> Tensor:
    return Conv.pixels(encoder, inputs)[:, :1].expand(-1, 3, -1, -1)


def left_half(encoder: Any, inputs: Tensor) -> Tensor:
    return Conv.pixels(encoder, inputs)[..., : inputs.shape[-1] // 2]


def in_a_list(encoder: Any, shape: tuple[int, ...]) -> None:
    Dense.__init__(encoder, shape)
    encoder.layers = [nn.Linear(5, 5)]


def listed(encoder: Any, inputs: Tensor) -> Tensor:
    return encoder.layers[0].to(inputs.dtype)(Dense.forward(encoder, inputs))


def drawn(encoder: Any, shape: tuple[int, ...]) -> None:
    Squares.__init__(encoder, shape)
    encoder.register_buffer("basis", torch.randn(shape[0], shape[0]))


def projected(encoder: Any, inputs: Tensor) -> Tensor:
    return Squares.forward(encoder, inputs @ encoder.basis)


def branching(encoder: Any, inputs: Tensor) -> Tensor:
    found = encoder.first(inputs)
    return found.relu() if found.sum() > -1e9 else found


APART, WEIGHTS, BITS, ROUND = (
    "batch rows are independent",
    "gradient in weights",
    "same seed, same bits",
    "state-dict round trip",
)
COUNTS, CLAIMS = "every part of an image is read", "fixed and vectorises are true"
ALL_FAULTS = (
    Fault("chunks of long batches backwards", APART, changes={"forward": chunks_backwards}),
    Fault("a hundred rows at most", APART, changes={"forward": a_hundred_at_most}),
    Fault("the mean of batches beyond 8", APART, changes={"forward": by_large_batches}),
    Fault("the largest number of a batch", APART, changes={"forward": by_the_largest}),
    Fault("the number of a row", APART, changes={"forward": row_numbers}),
    Fault("a weight's gradient a tenth too small", WEIGHTS, changes={"hidden": wrong_product}),
    Fault("half of the weights detached", WEIGHTS, changes={"hidden": half_detached}),
    Fault("half of the gradient in training", WEIGHTS, changes={"hidden": detached_in_training}),
    Fault("a bias's gradient doubled", WEIGHTS, changes={"__init__": doubled_bias}),
    Fault("dropout in evaluation", BITS, changes={"hidden": always_dropping}),
    Fault("the scale of the first batch", BITS, changes={"hidden": scale_of_the_first}),
    Fault("moments that move in evaluation", BITS, Normed, {"hidden": moments_of_tests}),
    Fault("features known by their shape", APART, changes={"forward": known_shapes}),
    Fault("a running mean that is not stored", ROUND, changes={"hidden": mean_that_is_not_stored}),
    Fault("a layer in a list", ROUND, changes={"__init__": in_a_list, "forward": listed}),
    Fault("inputs halved in place", "inputs are left as they are", changes={"forward": in_place}),
    Fault("bytes told by their size", "bytes are read as 0 to 1", Conv, {"pixels": bytes_by_their_size}),
    Fault("the first channel alone", COUNTS, Conv, {"pixels": one_channel}),
    Fault("the left half alone", COUNTS, Conv, {"pixels": left_half}),
    Fault("fixed, but drawn", CLAIMS, Squares, {"__init__": drawn, "forward": projected}),
    Fault("fixed, but learned", CLAIMS, Dense, {"fixed": True}),
    Fault("one pass that branches", CLAIMS, Layered, {"hidden": branching}),
)
