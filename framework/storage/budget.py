"""Stops what builds or runs a model of a stranger's description before it allocates more than the file accounts for.

A checkpoint of a few kilobytes can describe a layer of 10⁹ weights. That the weights do not fit is found when they are
copied into the model, which must be built first. Here every operation of torch is looked at before it runs: what it
would allocate is computed from shapes alone, and an error ends the building while the memory is still free.
"""

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_iter, tree_map_only

from framework.errors import CheckpointError
from framework.storage import limits


class Budget(TorchDispatchMode):
    """While it is active, operations of torch allocate so much, and no more.

    Args:
        path: the checkpoint, for the message.
        most_bytes: of what is allocated and not freed.
        most_calls: operations of torch.

    Raises:
        CheckpointError: an operation would allocate more; it was not run.
    """

    def __init__(self, path: str, most_bytes: int, most_calls: int | float = math.inf) -> None:
        super().__init__()
        self.path, self.most_bytes, self.calls = path, most_bytes, most_calls
        self.held: list[tuple[StorageWeakRef, int]] = []

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
        if not _allocates(func) or not _may_be_large(args, given):
            return func(*args, **given)
        size = _result_bytes(func, args, given)
        if size > limits.SMALL_RESULT:
            self.held = [(storage, held) for storage, held in self.held if not storage.expired()]
            if size + sum(held for _, held in self.held) > self.most_bytes:
                raise self._refusal(f"more memory (at last a tensor of {size / 1e6:.4g} MB)")
        found = func(*args, **given)
        if size > limits.SMALL_RESULT:
            for one in tree_iter(found):
                if isinstance(one, Tensor) and one.layout is torch.strided:
                    storage = one.untyped_storage()
                    self.held.append((StorageWeakRef(storage), storage.nbytes()))
        return found

    def _refusal(self, what: str) -> CheckpointError:
        return CheckpointError(
            f"{self.path} describes a model that takes {what} than its weights and inputs account for. "
            "Training writes no such file: get it again from where it comes."
        )


def building(path: str, weights: Iterable[Tensor]) -> Budget:
    """What a model that has these weights may take while it is built and filled."""
    held = list(weights)
    return Budget(
        path,
        limits.BUILDING_BYTES + limits.BUILDING_TIMES * stored_bytes(held),
        limits.BUILDING_CALLS + limits.CALLS_PER_WEIGHT * len(held),
    )


def predicting(path: str, weights: Iterable[Tensor], inputs: Tensor) -> Budget:
    """What a model that has these weights may take for these inputs."""
    accounted = stored_bytes(weights) + inputs.numel() * max(inputs.element_size(), 4)
    rows = len(inputs) if inputs.dim() else 1
    most = limits.PREDICTING_BYTES + limits.PREDICTING_ROW * rows + limits.PREDICTING_TIMES * accounted
    return Budget(path, most)


def stored_bytes(tensors: Iterable[Tensor]) -> int:
    """Bytes of memory that tensors hold; what several share, or one repeats, counts once."""
    storages = {
        storage.data_ptr(): storage.nbytes()
        for storage in (one.untyped_storage() for one in tensors if one.layout is torch.strided)
    }
    return sum(storages.values())


def _allocates(func: Any) -> bool:
    """Whether results of an operation have memory of their own."""
    return any(result.alias_info is None for result in func._schema.returns)


def _may_be_large(args: tuple[Any, ...], given: dict[str, Any]) -> bool:
    """Whether shapes and numbers are such that results could be large: small ones are not worth the look."""
    size: int | float = 1
    for item in tree_iter((args, given)):
        if isinstance(item, Tensor):
            size *= max(item.numel(), 1)
        elif isinstance(item, int | float) and not isinstance(item, bool) and not -1 <= item <= 1:
            size *= abs(item)
        if size > limits.SMALL_RESULT:
            return True
    return False


def _result_bytes(func: Any, args: tuple[Any, ...], given: dict[str, Any]) -> int:
    """What an operation would allocate, computed of shapes; 0 where numbers decide it."""
    args, given = tree_map_only(Tensor, _shape_only, (args, dict(given)))
    args, given = tree_map_only(torch.Generator, lambda _: None, (args, given))
    if any(argument.name == "device" for argument in func._schema.arguments):
        given["device"] = torch.device("meta")
    given.pop("pin_memory", None)
    try:
        found = func(*args, **given)
    except (
        Exception
    ):  # such results are no larger than what comes in, and wrong arguments fail where they are used
        return 0
    return sum(one.numel() * one.element_size() for one in tree_iter(found) if isinstance(one, Tensor))


def _shape_only(tensor: Tensor) -> Tensor:
    return torch.empty_strided(tensor.shape, tensor.stride(), dtype=tensor.dtype, device="meta")
