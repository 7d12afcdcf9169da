"""Training on several ranks that gives the same result as in one process.

Random numbers and batch statistics are those of the whole batch.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, final

import torch
import torch.nn.functional as F
from torch import Tensor
from torch import distributed as dist
from torch.overrides import TorchFunctionMode

DROPOUTS = {
    F.dropout, F.alpha_dropout, F.dropout1d, F.dropout2d, F.dropout3d, F.feature_alpha_dropout,
}  # fmt: skip
"""Functions that drop elements at random."""
FACTORIES: set[Callable[..., Tensor]] = {torch.rand, torch.randn}
"""Functions that draw a new tensor of a given shape."""
LIKE: dict[Callable[..., Tensor], Callable[..., Tensor]] = {
    torch.rand_like: torch.rand, torch.randn_like: torch.randn,
}  # fmt: skip
"""Functions that draw a tensor shaped like another tensor, each with the function that draws one of a given shape."""
IN_PLACE = {
    Tensor.normal_, Tensor.uniform_, Tensor.bernoulli_, Tensor.exponential_, Tensor.log_normal_, Tensor.cauchy_,
    Tensor.geometric_, Tensor.random_,
}  # fmt: skip
"""Methods that fill a tensor with random numbers."""


@dataclass(frozen=True)
class Share:
    """A rank's part of a batch: the rows from `start` to `start + count` of `whole` rows."""

    start: int
    count: int
    whole: int


def rank_share(count: int, device: torch.device) -> Share:
    """Return the share of the whole batch that this rank's `count` rows form; every rank must call this function.

    `device` is the device of this rank, on which the ranks exchange their counts.
    """
    counts = [torch.zeros((), dtype=torch.int64, device=device) for _ in range(dist.get_world_size())]
    dist.all_gather(counts, torch.tensor(count, device=device))
    sizes = [int(count) for count in counts]
    return Share(sum(sizes[: dist.get_rank()]), count, sum(sizes))


def sum_over_ranks(value: Tensor) -> Tensor:
    """Return the sum of a tensor over all ranks, without a gradient; every rank must call this function."""
    total = value.detach().clone()
    dist.all_reduce(total)
    return total


def gather_rows(rows: list[int]) -> list[list[int]]:
    """Return the lists `rows` of all ranks, in the order of ranks; every rank must call this function."""
    lists: list[Any] = [None] * dist.get_world_size()
    dist.all_gather_object(lists, rows)
    return lists


class _Sum(torch.autograd.Function):
    """Sum of a tensor over ranks, with gradient.

    Each rank has its own gradient with respect to the sum. The gradient with respect to each rank's tensor is the sum
    of these gradients over the ranks.
    """

    @staticmethod
    def forward(context: Any, value: Tensor) -> Tensor:
        return sum_over_ranks(value)

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> Tensor:
        return sum_over_ranks(gradients[0])


@final
class WholeBatch(TorchFunctionMode):
    """Torch mode in which each rank draws random numbers for the whole batch and uses those of its own rows.

    All ranks use the same seed, so each row gets the random numbers that it would get in one process. Of the dimensions
    of a tensor, the first one that is as long as the rank's number of rows is assumed to be the batch. Random numbers
    of a shape without such a dimension are the same on all ranks. Batch norm computes its training statistics over the
    rows of all ranks.
    """

    def __init__(self, rows: Share) -> None:
        super().__init__()
        self.rows = rows

    def __torch_function__(
        self, func: Callable[..., Any], types: Iterable[type], args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        if func in DROPOUTS:
            return self._dropout(func, *args, **kwargs)
        if func is F.batch_norm:
            return self._batch_norm(*args, **kwargs)
        if func in FACTORIES:
            size = kwargs.pop("size", None) or (args[0] if args and not isinstance(args[0], int) else args)
            return self._draw_whole(size, lambda shape: func(shape, **kwargs))
        if func is torch.randint:
            bounds = [part for part in args if isinstance(part, int)]
            bounds += [kwargs.pop(key) for key in ("low", "high") if key in kwargs]
            size = kwargs.pop("size") if "size" in kwargs else args[-1]
            return self._draw_whole(size, lambda shape: func(*bounds, shape, **kwargs))
        if func in LIKE:
            like = {"dtype": args[0].dtype, "device": args[0].device, **kwargs}
            return self._draw_whole(args[0].shape, lambda shape: LIKE[func](shape, **like))
        if func in IN_PLACE:
            tensor, rest = args[0], args[1:]
            with torch.no_grad():
                return tensor.copy_(
                    self._draw_whole(
                        tensor.shape, lambda shape: func(tensor.new_empty(shape), *rest, **kwargs)
                    )
                )
        if func is torch.normal and any(isinstance(part, Tensor) for part in args):
            mean, std = (torch.as_tensor(part) for part in (*args, *kwargs.values()))
            mean, std = torch.broadcast_tensors(mean, std)
            return mean + std * self._draw_whole(mean.shape, lambda shape: mean.new_empty(shape).normal_())
        if func in (torch.bernoulli, Tensor.bernoulli) and not args[1:]:
            return self._bernoulli(args[0], **kwargs)
        return func(*args, **kwargs)

    def _axis(self, shape: Iterable[int]) -> int | None:
        """Return the index of the batch dimension in `shape`; None if it has none, or if this rank has all rows."""
        axes = [axis for axis, size in enumerate(shape) if size == self.rows.count]
        return axes[0] if axes and self.rows.count < self.rows.whole else None

    def _draw_whole(self, size: Iterable[int], draw: Callable[[list[int]], Tensor]) -> Tensor:
        """Call `draw` with the shape of the whole batch, and return this rank's rows of the result."""
        shape = list(size)
        axis = self._axis(shape)
        if axis is None:
            return draw(shape)
        shape[axis] = self.rows.whole
        return draw(shape).narrow(axis, self.rows.start, self.rows.count).contiguous()

    def _bernoulli(self, probability: Tensor, **keywords: Any) -> Tensor:
        """Draw Bernoulli values for the whole batch, and return those of this rank's rows.

        The probabilities of the other rows, which this rank does not know, are set to 0.5; their values are dropped.
        """

        def draw(shape: list[int]) -> Tensor:
            axis = self._axis(probability.shape)
            if axis is None:
                return torch.bernoulli(probability, **keywords)
            whole = probability.new_full(shape, 0.5)
            whole.narrow(axis, self.rows.start, self.rows.count).copy_(probability)
            return torch.bernoulli(whole, **keywords)

        return self._draw_whole(probability.shape, draw)

    def _dropout(
        self,
        func: Callable[..., Tensor],
        input: Tensor,
        p: float = 0.5,
        training: bool = True,
        inplace: bool = False,
    ) -> Tensor:
        """Apply dropout to the whole batch, with zeros for the other ranks' rows, and return this rank's rows."""
        axis = self._axis(input.shape)
        if not training or p == 0 or axis is None:
            return func(input, p, training, inplace)
        shape = list(input.shape)
        shape[axis] = self.rows.whole
        # The noise does not depend on the values, so the other ranks' rows may be zeros.
        whole = input.new_zeros(shape)
        whole = torch.cat(
            [
                whole.narrow(axis, 0, self.rows.start),
                input,
                whole.narrow(axis, 0, self.rows.whole - self.rows.start - self.rows.count),
            ],
            axis,
        )
        return func(whole, p, True).narrow(axis, self.rows.start, self.rows.count)

    def _batch_norm(
        self,
        input: Tensor,
        running_mean: Tensor | None,
        running_var: Tensor | None,
        weight: Tensor | None = None,
        bias: Tensor | None = None,
        training: bool = False,
        momentum: float = 0.1,
        eps: float = 1e-5,
    ) -> Tensor:
        """Normalise with mean and (biased) variance over all ranks (Ioffe & Szegedy 2015, Algorithm 1)."""
        if not training:
            return F.batch_norm(input, running_mean, running_var, weight, bias, False, momentum, eps)
        total: Callable[[Tensor], Tensor] = _Sum.apply  # type: ignore[assignment]
        across = [axis for axis in range(input.dim()) if axis != 1]
        count = self.rows.whole * input[0, 0].numel()
        like = [1, -1, *[1] * (input.dim() - 2)]
        mean = total(input.sum(across)) / count
        centred = input - mean.reshape(like)
        variance = total(centred.square().sum(across)) / count
        if running_mean is not None and running_var is not None:
            with torch.no_grad():
                running_mean.lerp_(mean.to(running_mean), momentum)
                running_var.lerp_((variance * count / max(1, count - 1)).to(running_var), momentum)
        scaled = centred * (variance + eps).rsqrt().reshape(like)
        if weight is not None:
            scaled = scaled * weight.reshape(like)
        return scaled if bias is None else scaled + bias.reshape(like)
