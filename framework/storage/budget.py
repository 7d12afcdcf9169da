"""Limit on the memory that building or running a model from an untrusted checkpoint may allocate.

A checkpoint of a few kilobytes can describe a layer of 10⁹ weights. The stored weights then do not fit, but an error
is raised only when they are copied into the model, after the model has been built. `Budget` therefore inspects every
operation of torch before it runs, computes the size of the result from shapes alone, and raises an error before the
memory is allocated.

The sizes are computed by formulas in this module. torch can compute shapes on its device "meta", but some operations
then import torch's compiler, which takes 0.9 s.
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
        self.allocated: list[tuple[StorageWeakRef, int]] = []

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
        keywords = kwargs or {}
        self.calls -= 1
        if self.calls < 0:
            raise self._refusal("the model takes far more layers or steps than its weights explain")
        size = result_bytes(func, args, keywords)
        if size <= limits.SMALL_RESULT:
            return func(*args, **keywords)
        self.allocated = [(storage, nbytes) for storage, nbytes in self.allocated if not storage.expired()]
        if size + sum(nbytes for _, nbytes in self.allocated) > self.most_bytes:
            raise self._refusal(
                "the model takes far more memory than its weights and inputs explain (the refused tensor would "
                f"take {size / 1e6:.4g} MB)"
            )
        result = func(*args, **keywords)
        for tensor in tree_iter(result):
            if isinstance(tensor, Tensor) and tensor.layout is torch.strided:
                storage = tensor.untyped_storage()
                self.allocated.append((StorageWeakRef(storage), storage.nbytes()))
        return result

    def _refusal(self, excess: str) -> CheckpointError:
        return CheckpointError(
            f"{self.path}: {excess}. Training writes no such file. Copy the file again from its source."
        )


def building(path: str, weights: Iterable[Tensor]) -> Budget:
    """Return the budget for building the model of the checkpoint `path`, and copying its weights `weights` into it."""
    tensors = list(weights)
    return Budget(
        path,
        limits.BUILDING_BYTES + limits.BUILDING_TIMES * stored_bytes(tensors),
        limits.BUILDING_CALLS + limits.CALLS_PER_WEIGHT * len(tensors),
    )


def predicting(path: str, weights: Iterable[Tensor], inputs: Tensor) -> Budget:
    """Return the budget for one prediction from `inputs` by the model of the checkpoint `path` with these weights."""
    accounted = stored_bytes(weights) + inputs.numel() * max(inputs.element_size(), 4)
    rows = len(inputs) if inputs.dim() else 1
    most = limits.PREDICTING_BYTES + limits.PREDICTING_ROW * rows + limits.PREDICTING_TIMES * accounted
    return Budget(path, most)


def stored_bytes(tensors: Iterable[Tensor]) -> int:
    """Return the bytes of memory that tensors occupy; storage that several tensors share counts once."""
    storages = {
        storage.data_ptr(): storage.nbytes()
        for storage in (tensor.untyped_storage() for tensor in tensors if tensor.layout is torch.strided)
    }
    return sum(storages.values())


def result_bytes(func: Any, args: tuple[Any, ...], keywords: Mapping[str, Any]) -> int:
    """Return the bytes that the operation `func` of torch will allocate for its result.

    For an operation without a formula, this is the number of bytes of its arguments. The result of such an operation is
    not larger than its arguments, or its shape depends on the values of the arguments and is not known before.
    """
    operation = _operation(func)
    if not operation.allocates:
        return 0
    tensors = _tensors((*args, *keywords.values()))
    if operation.elementwise and "dtype" not in keywords and len({tensor.shape for tensor in tensors}) == 1:
        return tensors[0].numel() * max(tensor.element_size() for tensor in tensors)
    arguments = dict(zip(operation.arguments, args, strict=False)) | dict(keywords)
    width = max((tensor.element_size() for tensor in tensors), default=torch.get_default_dtype().itemsize)
    if isinstance(arguments.get("dtype"), torch.dtype):
        width = arguments["dtype"].itemsize
    try:
        if operation.formula is not None:
            return int(width * operation.formula(arguments))
        if operation.elementwise:
            return width * math.prod(np.broadcast_shapes(*(tensor.shape for tensor in tensors)))
        if "size" in arguments and operation.name not in _SAME_SIZE:
            return width * math.prod(map(int, arguments["size"]))
    except (ArithmeticError, IndexError, KeyError, RuntimeError, TypeError, ValueError):
        pass  # the arguments are wrong, and the operation itself raises the error
    return width * sum(tensor.numel() for tensor in tensors)


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
    """Return the tensors among the arguments of a torch operation, including those in lists and tuples."""
    tensors = []
    for value in values:
        if isinstance(value, Tensor):
            tensors.append(value)
        elif isinstance(value, list | tuple):
            tensors += [item for item in value if isinstance(item, Tensor)]
    return tensors


_SAME_SIZE = ("aten::_unsafe_view", "aten::_reshape_copy", "aten::view_copy", "aten::expand_copy")


def _product_size(arguments: Mapping[str, Any]) -> int:
    matrix_names = next(
        (names for names in (("mat1", "mat2"), ("batch1", "batch2")) if names[0] in arguments), None
    )
    first, second = (arguments[name] for name in matrix_names or ("self", "mat2"))
    return math.prod(first.shape[:-1]) * second.shape[-1]


def _convolution_size(arguments: Mapping[str, Any]) -> int:
    inputs, weight = arguments["input"], arguments["weight"]
    groups, transposed = arguments.get("groups", 1), arguments.get("transposed", False)
    sides = inputs.shape[2:]
    stride, padding, dilation, output_padding = (
        _per_side(arguments.get(name, default), len(sides))
        for name, default in (("stride", 1), ("padding", 0), ("dilation", 1), ("output_padding", 0))
    )
    elements = len(inputs) * (weight.shape[1] * groups if transposed else weight.shape[0])
    kernels = zip(sides, weight.shape[2:], stride, padding, dilation, output_padding, strict=True)
    for side, kernel, step, pad, dilated, end in kernels:
        extent = dilated * (kernel - 1) + 1
        elements *= (
            (side - 1) * step - 2 * pad + extent + end
            if transposed
            else (side + 2 * pad - extent) // step + 1
        )
    return elements


def _per_side(value: Any, count: int) -> list[int]:
    listed = list(value) if isinstance(value, list | tuple) else [value]
    return listed * count if len(listed) == 1 else listed


def _padded_size(arguments: Mapping[str, Any]) -> int:
    shape, pads = list(arguments["self"].shape), arguments["pad"]
    for side in range(len(pads) // 2):
        shape[-1 - side] += pads[2 * side] + pads[2 * side + 1]
    return math.prod(shape)


def _scaled_size(arguments: Mapping[str, Any]) -> int:
    inputs = arguments["self"] if "self" in arguments else arguments["input"]
    sides = arguments["output_size"]
    return math.prod(inputs.shape[: inputs.dim() - len(sides)]) * math.prod(sides)


def _indexed_size(arguments: Mapping[str, Any]) -> int:
    source, index = (
        arguments.get("self", arguments.get("weight")),
        arguments.get("index", arguments.get("indices")),
    )
    assert source is not None
    if isinstance(index, list | tuple):
        chosen = [item for item in index if item is not None]
        return math.prod(np.broadcast_shapes(*(item.shape for item in chosen))) * math.prod(
            side
            for side, item in zip(source.shape, [*index, *[None] * source.dim()], strict=False)
            if item is None
        )
    if "dim" in arguments:
        return source.numel() // max(source.shape[arguments["dim"]], 1) * index.numel()
    return index.numel() * math.prod(source.shape[1:])


_FORMULAS: dict[str, Callable[[Mapping[str, Any]], int | float]] = {
    **dict.fromkeys(("mm", "addmm", "bmm", "baddbmm"), _product_size),
    "convolution": _convolution_size,
    "constant_pad_nd": _padded_size,
    **dict.fromkeys(("reflection_pad1d", "reflection_pad2d", "reflection_pad3d"), _padded_size),
    **dict.fromkeys(("replication_pad1d", "replication_pad2d", "replication_pad3d"), _padded_size),
    **dict.fromkeys(("upsample_nearest1d", "upsample_nearest2d", "upsample_nearest3d"), _scaled_size),
    **dict.fromkeys(("upsample_linear1d", "upsample_bilinear2d", "upsample_trilinear3d"), _scaled_size),
    **dict.fromkeys(
        ("upsample_bicubic2d", "_upsample_bilinear2d_aa", "_upsample_bicubic2d_aa"), _scaled_size
    ),
    **dict.fromkeys(("_adaptive_avg_pool2d", "_adaptive_avg_pool3d", "adaptive_max_pool2d"), _scaled_size),
    **dict.fromkeys(("index", "index_select", "embedding"), _indexed_size),
    "gather": lambda arguments: arguments["index"].numel(),
    "take": lambda arguments: arguments["index"].numel(),
    "repeat": lambda arguments: arguments["self"].numel() * math.prod(arguments["repeats"]),
    "arange": lambda arguments: (arguments["end"] - arguments.get("start", 0)) / (arguments.get("step") or 1),
    "linspace": lambda arguments: arguments["steps"],
    "logspace": lambda arguments: arguments["steps"],
    "eye": lambda arguments: arguments["n"] * arguments.get("m", arguments["n"]),
    "randperm": lambda arguments: arguments["n"],
    "tril_indices": lambda arguments: 2 * arguments["row"] * arguments["col"],
    "triu_indices": lambda arguments: 2 * arguments["row"] * arguments["col"],
    "_euclidean_dist": lambda arguments: math.prod(arguments["x1"].shape[:-1]) * arguments["x2"].shape[-2],
    "_cdist_forward": lambda arguments: math.prod(arguments["x1"].shape[:-1]) * arguments["x2"].shape[-2],
    "im2col": lambda arguments: arguments["self"].numel() * math.prod(arguments["kernel_size"]),
    "diag_embed": lambda arguments: arguments["self"].numel() * arguments["self"].shape[-1],
    "histc": lambda arguments: arguments["bins"],
}
"""Formulas for the number of elements in the result of operations that can return more elements than their arguments.

The keys are the names of the operations in torch.
"""
