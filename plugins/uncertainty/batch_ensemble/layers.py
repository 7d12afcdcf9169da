"""Layers whose weights differ between members by a matrix of rank one (Wen et al. 2020, eq. 1-5)."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from framework.errors import ConfigError

LAYERS = (nn.Linear, nn.Conv1d, nn.Conv2d, nn.Conv3d)


class RankOne(nn.Module):
    """Layer with the weights W ∘ (s_m r_mᵀ) for member m, computed as (W (x ∘ r_m)) ∘ s_m plus the member's bias.

    Factors are stored as their difference from 1, so that weight decay draws them to 1 and members to each other.
    Outside of a block `with several_members(...)`, the layer is that of the first member.

    Args:
        layer: the layer, whose weights are shared; its bias becomes the initial bias of every member.
        members: number of members.
        spread: standard deviation of the initial factors around 1.

    Attributes:
        used: number of members that are computed. The inputs have one row for each sample and member: all members of
            the first sample, then all members of the second sample, and so on.
        rows: number of rows that the inputs must have; None for any.
    """

    def __init__(self, layer: nn.Module, members: int, spread: float) -> None:
        super().__init__()
        assert isinstance(layer, LAYERS)
        self.layer = layer
        outputs, inputs = layer.weight.shape[0], layer.weight.shape[1] * getattr(layer, "groups", 1)
        weight = layer.weight.detach()
        self.input_factors = nn.Parameter(spread * torch.randn(members, inputs).to(weight))
        self.output_factors = nn.Parameter(spread * torch.randn(members, outputs).to(weight))
        self.biases: nn.Parameter | None = None
        if layer.bias is not None:
            self.biases = nn.Parameter(layer.bias.detach().repeat(members, 1))
            layer.register_parameter("bias", None)
        self.used = 1
        self.rows: int | None = None

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the wrapped layer, such as its weight, whose dtype some encoders read."""
        try:
            return super().__getattr__(name)
        except AttributeError:
            return getattr(super().__getattr__("layer"), name)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the outputs of the members in use, each computed from its own rows of the inputs."""
        if not torch.compiler.is_exporting() and self.rows not in (None, len(inputs)):
            raise ConfigError(
                f"uncertainty batch_ensemble needs encoders whose layers keep one row for each input, but a layer got "
                f"{len(inputs)} rows for {self.rows} inputs of all members. Choose another encoder, or "
                "uncertainty=[ensemble]."
            )
        outputs = self.layer(self._times(inputs, self.input_factors))
        outputs = self._times(outputs, self.output_factors)
        if self.biases is None:
            return outputs
        parts = outputs.unflatten(0, (-1, self.used))
        return (parts + self._of_members(self.biases, parts)).flatten(0, 1)

    def _times(self, values: Tensor, factors: Tensor) -> Tensor:
        parts = values.unflatten(0, (-1, self.used))
        return torch.addcmul(parts, parts, self._of_members(factors, parts)).flatten(0, 1)

    def _of_members(self, numbers: Tensor, parts: Tensor) -> Tensor:
        """Return the rows of `numbers` of the members in use, in a shape that broadcasts with `parts`.

        `numbers` are (member, channel), and `parts` are (sample, member, ...).
        """
        axis = parts.dim() - 1 if isinstance(self.layer, nn.Linear) else 2
        shape = [1] * (parts.dim() - 1)
        shape[0], shape[axis - 1] = self.used, numbers.shape[1]
        return numbers[: self.used].view(shape)


def replace_layers(module: nn.Module, members: int, spread: float) -> int:
    """Replace all layers of the classes LAYERS inside a module by `RankOne` layers; return the number of these layers.

    The module is changed in place. `members` is the number of members, and `spread` the standard deviation of the
    initial factors around 1.
    """
    count = 0
    for name, child in list(module.named_children()):
        if isinstance(child, LAYERS):
            setattr(module, name, RankOne(child, members, spread))
            count += 1
        else:
            count += replace_layers(child, members, spread)
    return count


@contextmanager
def several_members(layers: list[RankOne], used: int, samples: int) -> Iterator[None]:
    """Let the layers compute `used` members for each of `samples` samples inside the block."""
    for layer in layers:
        layer.used, layer.rows = used, samples * used
    try:
        yield
    finally:
        for layer in layers:
            layer.used, layer.rows = 1, None


def repeat_rows(field: Any, count: int) -> Any:
    """Return a batch's field with each row repeated `count` times in succession."""
    return field.repeat_interleave(count, 0)
