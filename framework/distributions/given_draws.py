"""Random numbers of a model as arrays that are given to it, so that its predictions are a function of arrays."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

UNIFORM, NORMAL = "uniform", "normal"


@dataclass(frozen=True)
class Noise:
    """Random numbers that a model draws in one call.

    Attributes:
        kind: "uniform" in [0, 1), or "normal" with mean 0 and variance 1.
        shape: shape of the array.
        dtype: data type of the array.
    """

    kind: str
    shape: tuple[int, ...]
    dtype: torch.dtype

    def draw(self, generator: torch.Generator) -> Tensor:
        """Return an array of random numbers of this kind, shape and type."""
        create = torch.rand if self.kind == UNIFORM else torch.randn
        return create(self.shape, generator=generator, dtype=self.dtype)


class GivenDraws(TorchFunctionMode):
    """Context in which `torch.rand`, `torch.randn` and dropout layers use given arrays, in the order of the calls.

    Without given arrays, random numbers are drawn as usual. In both cases `noises` lists what was drawn. Empty draws
    are ignored: a density may draw an empty sample to learn its type.

    Args:
        arrays: the arrays; None in place of one array, or in place of the sequence, means that random numbers are
            drawn.
    """

    def __init__(self, arrays: Sequence[Tensor | None] | None = None) -> None:
        super().__init__()
        self.arrays = arrays
        self.noises: list[Noise] = []

    def __torch_function__(
        self,
        function: Callable[..., Any],
        types: Any,
        arguments: tuple[Any, ...] = (),
        keywords: dict[str, Any] | None = None,
    ) -> Any:
        """Return the result of a function of torch, with given arrays in place of random numbers."""
        keywords = keywords or {}
        if function is torch.rand or function is torch.randn:
            return self._next(function, arguments, keywords)
        if function is nn.functional.dropout:
            return self._drop_out(*arguments, **keywords)
        return function(*arguments, **keywords)

    def _next(
        self, function: Callable[..., Any], arguments: tuple[Any, ...], keywords: dict[str, Any]
    ) -> Tensor:
        size = keywords.get("size", arguments)
        size = size[0] if size and isinstance(size[0], Sequence) else size
        if any(isinstance(length, int) and length == 0 for length in size):
            return function(*arguments, **keywords)
        if self.arrays is not None and (tensor := self.arrays[len(self.noises)]) is not None:
            self.noises.append(Noise("", (), tensor.dtype))  # only counted, since a trace knows no sizes
            return tensor
        tensor = function(*arguments, **keywords)
        kind = UNIFORM if function is torch.rand else NORMAL
        self.noises.append(Noise(kind, tuple(tensor.shape), tensor.dtype))
        return tensor

    def _drop_out(
        self, values: Tensor, p: float = 0.5, training: bool = True, inplace: bool = False
    ) -> Tensor:
        if not training or p == 0:
            return values
        keep = (
            self._next(torch.rand, tuple(values.shape), {"dtype": values.dtype, "device": values.device}) >= p
        )
        return torch.where(keep, values / (1 - p), 0)


@contextmanager
def given_draws(arrays: Sequence[Tensor | None] | None = None) -> Iterator[list[Noise]]:
    """Use given arrays in place of random numbers inside the block, and yield the list of what was drawn."""
    global _active
    before, _active = _active, True
    try:
        with GivenDraws(arrays) as mode:
            yield mode.noises
    finally:
        _active = before


def draws_are_given() -> bool:
    """Return whether the caller is inside of a `given_draws` block.

    There, code that draws random numbers separately for parts of a batch must draw them for the whole batch at once.
    """
    return _active


_active = False
