"""Check on the CPU that code would not mix tensors on the CPU with tensors on a GPU.

`OneDevice` runs code whose input tensors carry the label "on the device", as if they were on a GPU. Tensors created
without `device=` get the label "on the CPU". A result inherits the label of the tensors from which it is computed. A
call with tensors of both labels is recorded if CUDA would raise an error. No tensor is moved, and no value changes.
"""

import dis
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from types import CodeType, FrameType
from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torch.utils.weak import WeakTensorKeyDictionary

from framework.testing.finding import SEED, TooSlow, Worst, seed, short_place

DEVICE = torch.device("cpu", 0)
"""Device that `tensor.device` returns for a tensor with the label "on the device", as if it were on a GPU.

Torch computes on the CPU with it, but it differs from `torch.device("cpu")`, which other tensors return.
"""
FACTORIES = frozenset(
    ("zeros", "ones", "empty", "full", "arange", "range", "linspace", "logspace", "eye", "rand", "randn", "randint",
     "randperm", "from_numpy", "frombuffer", "tril_indices", "triu_indices", "hann_window", "hamming_window",
     "blackman_window", "bartlett_window", "kaiser_window", "fft_fftfreq", "fft_rfftfreq", "empty_strided",
     "scalar_tensor", "sparse_coo_tensor")
)  # fmt: skip
"""Functions whose result is on the CPU unless `device=` is given."""
CONVERSIONS = frozenset(("tensor", "as_tensor", "asarray"))
"""Functions whose result is on the device of their argument if that is a tensor; otherwise as for FACTORIES."""
LIKE_THE_FIRST = frozenset(
    ("expand_as", "view_as", "reshape_as", "copy_", "set_", "resize_as_", "__deepcopy__", "is_same_size", "align_as",
     "_make_subclass", "backward", "register_hook", "new_tensor", "new_zeros", "new_ones",
     "new_full", "new_empty", "new_empty_strided", "zeros_like", "ones_like", "empty_like", "full_like", "rand_like",
     "randn_like", "randint_like")
)  # fmt: skip
"""Functions whose result is on the device of their first argument, whatever the devices of the other arguments are."""
ELEMENTWISE_RESULTS = frozenset(("broadcast_tensors", "atleast_1d", "atleast_2d", "atleast_3d"))
"""Functions that return one tensor for each argument, on the device of that argument."""
STRICT = frozenset(
    ("cat", "concat", "concatenate", "stack", "hstack", "vstack", "dstack", "column_stack", "row_stack", "block_diag",
     "searchsorted", "bucketize", "gather", "scatter", "scatter_", "scatter_add", "scatter_add_", "scatter_reduce",
     "scatter_reduce_", "index_select", "index_add", "index_add_", "index_copy", "index_copy_", "take",
     "take_along_dim", "equal", "allclose", "isclose", "outer", "kron", "tensordot", "einsum", "isin")
)  # fmt: skip
"""Functions that refuse tensors on two devices, even if the tensors on the CPU have no dimensions."""
_LIBRARIES = frozenset(("torch", "torchmetrics", "jaxtyping", "beartype", "numpy", "scipy"))
Calls = Iterator[tuple[str, Callable[[], Any]]]
"""Names of calls to check, each with a function that performs the call."""
_on_device: Any = WeakTensorKeyDictionary()
"""Tensor → true if its label is "on the device", false if it is "on the CPU"; tensors without a label are absent."""
_created_at: Any = WeakTensorKeyDictionary()
"""Tensor on the CPU → file and line at which it, or a tensor from which it is computed, was created there."""


class OneDevice(TorchFunctionMode):
    """Context manager that records calls that would mix tensors on a GPU with tensors on the CPU.

    Tensors with the label "on the device" are treated as if they were on a GPU.

    Attributes:
        faults: Descriptions of the calls, with file and line and the tensors; no description occurs twice.
    """

    def __init__(self) -> None:
        super().__init__()
        self.faults: list[str] = []

    def label_device(self, value: Any) -> Any:
        """Give the label "on the device" to every tensor in a value or its nested containers; return the value."""
        for tensor in tensors_in(value):
            _on_device[tensor] = True
        return value

    def label_module(self, module: nn.Module) -> None:
        """Label the tensors that `module.to(device)` would move: parameters, buffers and the states of metrics.

        Tensors in other attributes stay on the CPU, as do global constants of the package that defines the module.
        """
        _label_constants({"framework", type(module).__module__.partition(".")[0]})
        for part in module.modules():
            self.label_device([*part._parameters.values(), *part._buffers.values()])
            states = getattr(part, "_defaults", None)
            if isinstance(states, dict):  # state of a torchmetrics.Metric
                self.label_device([states, [getattr(part, name) for name in states]])
                part._device = DEVICE  # type: ignore[assignment]

    def label_cpu(self, value: Any) -> None:
        """Give all tensors in a value the label "on the CPU", such as an attribute that `Module.to` does not move."""
        for tensor in tensors_in(value):
            _on_device[tensor] = False

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        name = getattr(func, "__name__", "")
        if name == "__get__":
            return self._read_attribute(func, args)
        result = func(*args, **kwargs)
        if name == "__set__":
            return result
        if name == "__iter__":
            result = list(result)
        if name in FACTORIES:
            return self._label_new(result, kwargs.get("device"))
        if name in CONVERSIONS and not (args and isinstance(args[0], Tensor)):
            return self._label_new(result, kwargs.get("device"))
        if name in ("to", "type_as", "cpu", *CONVERSIONS):
            return self._label_moved(name, result, args, kwargs)
        received = list(tensors_in((args, kwargs)))
        if name.startswith(("new_",)) or name.endswith("_like") or name == "full_like":
            return self._label_like(result, received[0], kwargs.get("device"))
        if name in ("numpy", "__array__"):
            if received and _on_device.get(received[0]):
                self._record_fault(name, "it converts a tensor on the device to NumPy")
            return result
        if name in LIKE_THE_FIRST:
            return self._inherit(result, received[:1])
        if name in ELEMENTWISE_RESULTS:
            results = result if isinstance(result, (tuple, list)) else (result,)
            for single_result, source in zip(results, received, strict=False):
                self._inherit(single_result, [source])
            return result
        if name == "__getitem__":
            self._check_index(name, args[0], args[1])
            return self._inherit(result, [args[0]])
        if name == "__setitem__":
            self._check_assignment(*args)
            return result
        if name == "grad":  # torch.autograd.grad: each gradient is on the device of its input
            sources = args[1] if len(args) > 1 else kwargs["inputs"]
            pairs = zip(result, [sources] if isinstance(sources, Tensor) else sources, strict=True)
            for gradient, source in pairs:
                self._inherit(gradient, [source])
            return result
        mixed = [tensor for tensor in received if _on_device.get(tensor) is False]
        if mixed and len(mixed) < len(received):
            inside = [tensor for tensor in received if _on_device.get(tensor)]
            if inside and any(name in STRICT or tensor.dim() > 0 for tensor in mixed):
                shapes = ", ".join(
                    f"{tuple(tensor.shape)} on the {'device' if _on_device.get(tensor) else 'CPU'}{_origin(tensor)}"
                    for tensor in received
                    if _on_device.get(tensor) is not None
                )
                self._record_fault(name, f"its tensors have shapes {shapes}")
        return self._inherit(result, received)

    def _read_attribute(self, func: Any, args: tuple[Any, ...]) -> Any:
        result = func(*args)
        owner = args[0]
        attribute = getattr(func.__self__, "__name__", "")
        if attribute == "device" and _on_device.get(owner):
            return DEVICE if result.type == "cpu" else result
        if isinstance(result, Tensor):
            self._inherit(result, [owner])
        return result

    def _label_new(self, result: Any, device: Any) -> Any:
        """Label a new tensor according to the `device=` argument with which it was created."""
        if device is None or not _is_device(device):
            self._label_on_cpu(result)
        else:
            self.label_device(result)
        return result

    def _label_like(self, result: Any, source: Tensor, device: Any) -> Any:
        return self._inherit(result, [source]) if device is None else self._label_new(result, device)

    def _label_moved(self, name: str, result: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
        """Label the result of `.to`, `.cpu` and similar calls.

        If torch returned the same tensor, but the label changes, the result is a new view of it. So the tensor that was
        moved keeps its own label.
        """
        source = args[0]
        inside = _on_device.get(source)
        for choice in (*args[1:], *kwargs.values()):
            if isinstance(choice, Tensor):
                inside = _on_device.get(choice)
            elif isinstance(choice, (torch.device, str)):
                inside = _is_device(choice)
        if name == "cpu":
            inside = False
        if result is source and inside != _on_device.get(source):
            result = source.view_as(source)
        if inside:
            self.label_device(result)
        elif inside is False:
            self._label_on_cpu(result)
        return result

    def _inherit(self, result: Any, sources: list[Tensor]) -> Any:
        """Label results like the tensors from which they are computed."""
        known = [_on_device.get(tensor) for tensor in sources]
        if any(known):
            self.label_device(result)
        elif known and all(on_device is False for on_device in known):
            self._label_on_cpu(result, sources)
        return result

    def _label_on_cpu(self, result: Any, sources: Sequence[Tensor] = ()) -> None:
        """Give tensors the label "on the CPU", unless a calling function has separate code for each kind of device.

        In its code for the CPU, such a function may create tensors and read constants. Tensors are labelled in any case
        if they are computed from a tensor whose place of creation is known.

        Args:
            result: the tensors.
            sources: tensors on the CPU from which `result` is computed; empty if `result` was created on the CPU or
                moved to it.
        """
        tensors = [tensor for tensor in tensors_in(result) if _on_device.get(tensor) is not False]
        places = [_created_at[tensor] for tensor in sources if tensor in _created_at]
        if tensors and (places or not _has_device_code()):
            place = places[0] if places else _call_site() if not sources else None
            for tensor in tensors:
                _on_device[tensor] = False
                if place is not None:
                    _created_at[tensor] = place

    def _check_index(self, name: str, tensor: Any, index: Any) -> None:
        """Record a fault if a tensor on the device indexes a tensor on the CPU; CUDA allows the reverse."""
        if isinstance(tensor, Tensor) and _on_device.get(tensor) is False:
            for part in tensors_in(index):
                if _on_device.get(part) and (part.dim() > 0 or part.dtype == torch.bool):
                    self._record_fault(name, "a tensor on the device indexes a tensor on the CPU")

    def _check_assignment(self, tensor: Tensor, index: Any, value: Any) -> None:
        """Record a fault if an assignment to elements selected by indices mixes devices; CUDA allows it for slices."""
        self._check_index("__setitem__", tensor, index)
        listed = index if isinstance(index, tuple) else (index,)
        advanced = any(
            isinstance(part, list)
            or (isinstance(part, Tensor) and (part.dim() > 0 or part.dtype == torch.bool))
            for part in listed
        )
        if advanced and isinstance(value, Tensor) and value.dim() > 0:
            labels = _on_device.get(tensor), _on_device.get(value)
            if labels in ((True, False), (False, True)):
                inside, outside = ("device", "CPU") if labels[0] else ("CPU", "device")
                self._record_fault(
                    "__setitem__",
                    f"a tensor {tuple(value.shape)} on the {outside} is assigned into a tensor on the {inside}",
                )

    def _record_fault(self, name: str, problem: str) -> None:
        if _has_device_code():
            return
        text = f"{name} at {_call_site()}: {problem}"
        if text not in self.faults:
            self.faults.append(text)


def check_devices(make_calls: Callable[[OneDevice], Calls], worst: Worst) -> None:
    """Record every call that would mix devices while an object is built and used.

    A call that raises an error is repeated without labels. An error that occurs only with labels is recorded; any other
    error is left to other checks.

    Args:
        make_calls: Function that receives the `OneDevice`. It builds the object, labels its tensors and its inputs, and
            yields the calls to perform.
        worst: Recorder of the faults.
    """
    mode = OneDevice()
    worst.count(False, "no call mixes devices")
    seed(SEED)
    calls = make_calls(mode)
    while True:
        with mode, torch.no_grad():
            name, call = next(calls, ("", None))
        if call is None:
            break
        _perform(mode, call)
        for fault in mode.faults:
            worst.count(True, f"{name}: {fault}")
        mode.faults.clear()


def _perform(mode: OneDevice, call: Callable[[], Any]) -> None:
    """Perform a call with labels; record a fault if it raises an error only with labels."""
    error_message = ""
    for labelled in (True, False):
        seed(SEED)
        try:
            with mode if labelled else nullcontext(), torch.no_grad():
                call()
        except TooSlow:
            raise
        except Exception as error:
            if not labelled:  # the input is refused, or another check finds the error
                return
            error_message = " ".join(f"{type(error).__name__}: {error}".split())
        if not error_message:
            return
    mode.faults.append(f"raises an error only on a device: {error_message}")


def tensors_in(value: Any, depth: int = 0) -> Iterator[Tensor]:
    """Yield every tensor in a value, and in lists, tuples, sets and dictionaries nested up to 4 levels deep.

    `depth` is the number of containers around `value`.
    """
    if isinstance(value, Tensor):
        yield value
    elif depth < 4 and isinstance(value, (list, tuple, set)):
        for part in value:
            yield from tensors_in(part, depth + 1)
    elif depth < 4 and isinstance(value, dict):
        for part in value.values():
            yield from tensors_in(part, depth + 1)


def _is_device(chosen: Any) -> bool:
    return chosen == DEVICE if isinstance(chosen, torch.device) else str(chosen) == str(DEVICE)


def _label_constants(packages: set[str]) -> None:
    """Give the label "on the CPU" to global tensors in the modules of the packages, since no call moves them."""
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in packages:
            for value in list(vars(module).values()):
                if isinstance(value, Tensor) and _on_device.get(value) is None:
                    _on_device[value] = False


def _origin(tensor: Tensor) -> str:
    """Return where a tensor on the CPU was created, as words for a message; "" if that is not known."""
    place = _created_at.get(tensor)
    return "" if _on_device.get(tensor) or place is None else f" (created at {place})"


def _caller() -> FrameType | None:
    """Return the innermost stack frame of the recorded call; beartype may have added frames between it and here."""
    frame = sys._getframe(1)
    while frame is not None and (frame.f_code.co_filename, frame.f_code.co_name) != _ENTRY:
        frame = frame.f_back
    return frame and frame.f_back


_ENTRY = (__file__, "__torch_function__")
"""File and function by which torch enters `OneDevice`."""


def _of_library(frame: FrameType) -> bool:
    """Return whether a stack frame is one of a library, or was added by beartype."""
    path, module = frame.f_code.co_filename, frame.f_globals.get("__name__", "")
    return path.startswith("<@beartype") or module.partition(".")[0] in _LIBRARIES


def _has_device_code() -> bool:
    """Return whether a calling function tests on which device a tensor is, and so has separate code for each device.

    Only its code for the CPU runs here, so its calls say nothing about its code for a GPU.
    """
    frame = _caller()
    while frame is not None and frame.f_code.co_filename != __file__:
        code = frame.f_code
        known, tests_device = _TESTS_DEVICE.get(id(code), (None, False))
        if known is not code:
            tests_device = not _of_library(frame) and _tests_device(code)
            _TESTS_DEVICE[id(code)] = code, tests_device
        if tests_device:
            return True
        frame = frame.f_back
    return False


def _tests_device(code: CodeType) -> bool:
    """Return whether a function reads `is_cuda`, `is_cpu` or `device.type`."""
    if {"is_cuda", "is_cpu"} & {*code.co_names}:
        return True
    before = None
    for instruction in dis.get_instructions(code) if "type" in code.co_names else ():
        if instruction.argval == "type" and before == "device":
            return True
        before = instruction.argval
    return False


_TESTS_DEVICE: dict[int, tuple[CodeType, bool]] = {}
"""Identity of the code of a function → the code, and whether it tests on which device a tensor is.

Keys are no code objects, since Python computes their hash anew for each look-up.
"""


def _call_site() -> str:
    """Return file and line of the innermost call outside libraries, with the last three parts of the path."""
    frame = _caller()
    while frame is not None and frame.f_code.co_filename != __file__:
        if not _of_library(frame):
            return short_place(frame.f_code.co_filename, frame.f_lineno)
        frame = frame.f_back
    return "an unknown line"
