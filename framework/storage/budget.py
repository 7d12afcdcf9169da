"""Limit on the memory that building or running a model from an untrusted checkpoint may allocate.

A checkpoint of a few kilobytes can describe a layer of 10⁹ weights. A mismatch of the weights is found only when they
are copied into the model, and by then the model has been built. The limit therefore inspects every operation of torch
before it runs. It computes the size of the result from shapes alone, and raises an error while the memory is still
free.

The sizes are computed by formulas in this module. torch can compute shapes on its device "meta", but for some
operations that imports its compiler, which takes 0.9 s.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_iter

from framework.errors import CheckpointError
from framework.storage import limits


class Budget(TorchDispatchMode):
    """Context in which the operations of torch may allocate a limited number of bytes.

    Args:
        path: Path of the checkpoint, for the error message.
        most_bytes: Largest number of bytes that may be allocated and not yet freed.
        most_calls: Largest number of operations of torch.

    Raises:
        CheckpointError: An operation would exceed one of the limits; it was not run.
    """

    def __init__(self, path: str, most_bytes: int, most_calls: int | float = math.inf) -> None:
        super().__init__()
        self.path, self.most_bytes, self.calls = path, most_bytes, most_calls
        self.held: list[tuple[StorageWeakRef, int]] = []

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # otherwise torch imports its compiler (0.9 s), although nothing is compiled

    def __torch_dispatch__(
        self,
        func: Any,
        types: Iterable[type],
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        given = kwargs or {}
        self.calls -= 1
        if self.calls < 0:
            raise self._refusal("far more layers or steps")
        size = result_bytes(func, args, given)
        if size <= limits.SMALL_RESULT:
            return func(*args, **given)
        self.held = [(storage, held) for storage, held in self.held if not storage.expired()]
        if size + sum(held for _, held in self.held) > self.most_bytes:
            raise self._refusal(f"far more memory (at last a tensor of {size / 1e6:.4g} MB)")
        found = func(*args, **given)
        for one in tree_iter(found):
            if isinstance(one, Tensor) and one.layout is torch.strided:
                storage = one.untyped_storage()
                self.held.append((StorageWeakRef(storage), storage.nbytes()))
        return found

    def _refusal(self, what: str) -> CheckpointError:
        return CheckpointError(
            f"{self.path} describes a model that takes {what} than its weights and inputs account for. Training "
            "writes no such file: get it again from where it comes."
        )


def building(path: str, weights: Iterable[Tensor]) -> Budget:
    """Return the budget of a model with these weights while it is built and its weights are copied into it."""
    held = list(weights)
    return Budget(
        path,
        limits.BUILDING_BYTES + limits.BUILDING_TIMES * stored_bytes(held),
        limits.BUILDING_CALLS + limits.CALLS_PER_WEIGHT * len(held),
    )


def predicting(path: str, weights: Iterable[Tensor], inputs: Tensor) -> Budget:
    """Return the budget of a model with these weights while it predicts from these inputs."""
    accounted = stored_bytes(weights) + inputs.numel() * max(inputs.element_size(), 4)
    rows = len(inputs) if inputs.dim() else 1
    most = limits.PREDICTING_BYTES + limits.PREDICTING_ROW * rows + limits.PREDICTING_TIMES * accounted
    return Budget(path, most)


def stored_bytes(tensors: Iterable[Tensor]) -> int:
    """Return the bytes of memory that tensors hold; storage that several tensors share or repeat counts once."""
    storages = {
        storage.data_ptr(): storage.nbytes()
        for storage in (one.untyped_storage() for one in tensors if one.layout is torch.strided)
    }
    return sum(storages.values())


def result_bytes(func: Any, args: tuple[Any, ...], given: Mapping[str, Any]) -> int:
    """Return the bytes that an operation will allocate for its result.

    An operation without a formula counts as many bytes as its arguments. Its result is no larger than they are, or the
    shape of the result depends on the values of the arguments.
    """
    operation = _operation(func)
    if not operation.allocates:
        return 0
    tensors = _tensors((*args, *given.values()))
    if operation.elementwise and "dtype" not in given and len({one.shape for one in tensors}) == 1:
        return tensors[0].numel() * max(one.element_size() for one in tensors)
    called = dict(zip(operation.arguments, args, strict=False)) | dict(given)
    width = max((one.element_size() for one in tensors), default=torch.get_default_dtype().itemsize)
    if isinstance(called.get("dtype"), torch.dtype):
        width = called["dtype"].itemsize
    try:
        if operation.formula is not None:
            return int(width * operation.formula(called))
        if operation.elementwise:
            return width * math.prod(np.broadcast_shapes(*(one.shape for one in tensors)))
        if "size" in called and operation.name not in _SAME_SIZE:
            return width * math.prod(map(int, called["size"]))
    except (ArithmeticError, IndexError, KeyError, RuntimeError, TypeError, ValueError):
        pass  # the arguments are wrong, and the operation itself raises the error
    return width * sum(one.numel() for one in tensors)


class _Operation(NamedTuple):
    """Properties of an operation of torch that `result_bytes` reads."""

    name: str
    arguments: tuple[str, ...]
    allocates: bool
    elementwise: bool
    formula: Callable[[Mapping[str, Any]], int | float] | None


@cache
def _operation(func: Any) -> _Operation:
    """Return the properties of an operation, cached because every operation of every prediction is inspected."""
    schema = func._schema
    formula = _FORMULAS.get(schema.name.removeprefix("aten::"))
    return _Operation(
        schema.name,
        tuple(argument.name for argument in schema.arguments),
        any(result.alias_info is None for result in schema.returns),
        formula is None and torch.Tag.pointwise in func.tags,
        formula,
    )


def _tensors(values: Iterable[Any]) -> list[Tensor]:
    """Return the tensors among the arguments and in lists among them; arguments of torch operations nest no deeper."""
    found = []
    for value in values:
        if isinstance(value, Tensor):
            found.append(value)
        elif isinstance(value, list | tuple):
            found += [one for one in value if isinstance(one, Tensor)]
    return found


_SAME_SIZE = ("aten::_unsafe_view", "aten::_reshape_copy", "aten::view_copy", "aten::expand_copy")


def _matrices(called: Mapping[str, Any]) -> int:
    added = next((names for names in (("mat1", "mat2"), ("batch1", "batch2")) if names[0] in called), None)
    first, second = (called[name] for name in added or ("self", "mat2"))
    return math.prod(first.shape[:-1]) * second.shape[-1]


def _convolution(called: Mapping[str, Any]) -> int:
    inputs, weight = called["input"], called["weight"]
    groups, turned = called.get("groups", 1), called.get("transposed", False)
    sides = inputs.shape[2:]
    stride, padding, dilation, more = (
        _each(called.get(name, usual), len(sides))
        for name, usual in (("stride", 1), ("padding", 0), ("dilation", 1), ("output_padding", 0))
    )
    found = len(inputs) * (weight.shape[1] * groups if turned else weight.shape[0])
    kernels = zip(sides, weight.shape[2:], stride, padding, dilation, more, strict=True)
    for side, kernel, step, pad, spread, end in kernels:
        reach = spread * (kernel - 1) + 1
        found *= (side - 1) * step - 2 * pad + reach + end if turned else (side + 2 * pad - reach) // step + 1
    return found


def _each(value: Any, count: int) -> list[int]:
    listed = list(value) if isinstance(value, list | tuple) else [value]
    return listed * count if len(listed) == 1 else listed


def _padded(called: Mapping[str, Any]) -> int:
    shape, pads = list(called["self"].shape), called["pad"]
    for side in range(len(pads) // 2):
        shape[-1 - side] += pads[2 * side] + pads[2 * side + 1]
    return math.prod(shape)


def _scaled(called: Mapping[str, Any]) -> int:
    inputs = called["self"] if "self" in called else called["input"]
    sides = called["output_size"]
    return math.prod(inputs.shape[: inputs.dim() - len(sides)]) * math.prod(sides)


def _picked(called: Mapping[str, Any]) -> int:
    held, index = called.get("self", called.get("weight")), called.get("index", called.get("indices"))
    assert held is not None
    if isinstance(index, list | tuple):
        chosen = [one for one in index if one is not None]
        return math.prod(np.broadcast_shapes(*(one.shape for one in chosen))) * math.prod(
            side for side, one in zip(held.shape, [*index, *[None] * held.dim()], strict=False) if one is None
        )
    if "dim" in called:
        return held.numel() // max(held.shape[called["dim"]], 1) * index.numel()
    return index.numel() * math.prod(held.shape[1:])


_FORMULAS: dict[str, Callable[[Mapping[str, Any]], int | float]] = {
    **dict.fromkeys(("mm", "addmm", "bmm", "baddbmm"), _matrices),
    "convolution": _convolution,
    "constant_pad_nd": _padded,
    **dict.fromkeys(("reflection_pad1d", "reflection_pad2d", "reflection_pad3d"), _padded),
    **dict.fromkeys(("replication_pad1d", "replication_pad2d", "replication_pad3d"), _padded),
    **dict.fromkeys(("upsample_nearest1d", "upsample_nearest2d", "upsample_nearest3d"), _scaled),
    **dict.fromkeys(("upsample_linear1d", "upsample_bilinear2d", "upsample_trilinear3d"), _scaled),
    **dict.fromkeys(("upsample_bicubic2d", "_upsample_bilinear2d_aa", "_upsample_bicubic2d_aa"), _scaled),
    **dict.fromkeys(("_adaptive_avg_pool2d", "_adaptive_avg_pool3d", "adaptive_max_pool2d"), _scaled),
    **dict.fromkeys(("index", "index_select", "embedding"), _picked),
    "gather": lambda called: called["index"].numel(),
    "take": lambda called: called["index"].numel(),
    "repeat": lambda called: called["self"].numel() * math.prod(called["repeats"]),
    "arange": lambda called: (called["end"] - called.get("start", 0)) / (called.get("step") or 1),
    "linspace": lambda called: called["steps"],
    "logspace": lambda called: called["steps"],
    "eye": lambda called: called["n"] * called.get("m", called["n"]),
    "randperm": lambda called: called["n"],
    "tril_indices": lambda called: 2 * called["row"] * called["col"],
    "triu_indices": lambda called: 2 * called["row"] * called["col"],
    "_euclidean_dist": lambda called: math.prod(called["x1"].shape[:-1]) * called["x2"].shape[-2],
    "_cdist_forward": lambda called: math.prod(called["x1"].shape[:-1]) * called["x2"].shape[-2],
    "im2col": lambda called: called["self"].numel() * math.prod(called["kernel_size"]),
    "diag_embed": lambda called: called["self"].numel() * called["self"].shape[-1],
    "histc": lambda called: called["bins"],
}
"""Formulas for the number of elements in the result of operations that can return more than their arguments hold.

The keys are the names of the operations in torch.
"""
