"""A check on the CPU for calls that would mix tensors of the CPU with tensors of a GPU.

`OneDevice` runs code with its input tensors marked as tensors of the device, as if a GPU held them. Tensors made
without `device=` are marked as tensors of the CPU. A result inherits the marks of the tensors that it is computed from,
and a call that mixes both kinds where CUDA would raise an error is recorded. No tensor is moved: all numbers stay as
they are.
"""

import dis
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from types import CodeType, FrameType
from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torch.utils.weak import WeakTensorKeyDictionary

from framework.testing.finding import SEED, TooSlow, Worst, seed

DEVICE = torch.device("cpu", 0)
"""Device that `tensor.device` reports for a tensor marked as of the device; torch treats it as the CPU.

It differs from `torch.device("cpu")`, which `tensor.device` reports for a tensor marked as of the CPU.
"""
FACTORIES = frozenset(
    ("zeros", "ones", "empty", "full", "arange", "range", "linspace", "logspace", "eye", "rand", "randn", "randint",
     "randperm", "from_numpy", "frombuffer", "tril_indices", "triu_indices", "hann_window", "hamming_window",
     "blackman_window", "bartlett_window", "kaiser_window", "fft_fftfreq", "fft_rfftfreq", "empty_strided",
     "scalar_tensor", "sparse_coo_tensor")
)  # fmt: skip
"""Functions whose result is on the CPU unless `device=` is given."""
CONVERSIONS = frozenset(("tensor", "as_tensor", "asarray"))
"""Functions whose result is on the device of their argument if that is a tensor; else they act as FACTORIES."""
OF_THE_FIRST = frozenset(
    ("expand_as", "view_as", "reshape_as", "copy_", "set_", "resize_as_", "__deepcopy__", "is_same_size", "align_as",
     "_make_subclass", "backward", "register_hook", "new_tensor", "new_zeros", "new_ones",
     "new_full", "new_empty", "new_empty_strided", "zeros_like", "ones_like", "empty_like", "full_like", "rand_like",
     "randn_like", "randint_like")
)  # fmt: skip
"""Functions whose result is on the device of their first argument, whatever the devices of the others are."""
ONE_BY_ONE = frozenset(("broadcast_tensors", "atleast_1d", "atleast_2d", "atleast_3d"))
"""Functions that return one result for each argument, on the device of that argument."""
STRICT = frozenset(
    ("cat", "concat", "concatenate", "stack", "hstack", "vstack", "dstack", "column_stack", "row_stack", "block_diag",
     "searchsorted", "bucketize", "gather", "scatter", "scatter_", "scatter_add", "scatter_add_", "scatter_reduce",
     "scatter_reduce_", "index_select", "index_add", "index_add_", "index_copy", "index_copy_", "take",
     "take_along_dim", "equal", "allclose", "isclose", "outer", "kron", "tensordot", "einsum", "isin")
)  # fmt: skip
"""Functions that refuse tensors of two devices even where the CPU tensors have no dimensions."""
_LIBRARIES = frozenset(("torch", "torchmetrics", "jaxtyping", "beartype", "numpy", "scipy"))
Questions = Iterator[tuple[str, Callable[[], Any]]]
"""Names of calls, and functions that perform them."""
_on_device: Any = WeakTensorKeyDictionary()
"""Mark of a tensor: True on the device, False on the CPU; a tensor without an entry has no known place."""


class OneDevice(TorchFunctionMode):
    """Recorder of calls that mix tensors of the device with tensors of the CPU, used as a context manager.

    Attributes:
        faults: Descriptions of the mixed tensors and the place of the call; each place occurs once.
    """

    def __init__(self) -> None:
        super().__init__()
        self.faults: list[str] = []

    def receive(self, value: Any) -> Any:
        """Mark every tensor in a value or its nested containers as of the device, and return the value."""
        for tensor in tensors_in(value):
            _on_device[tensor] = True
        return value

    def move(self, module: nn.Module) -> None:
        """Mark the tensors that `module.to(device)` would move: parameters, buffers and the states of metrics.

        Plain attributes stay on the CPU. Tensors that modules of the same package hold as constants do too.
        """
        _mark_constants({"framework", type(module).__module__.partition(".")[0]})
        for part in module.modules():
            self.receive([*part._parameters.values(), *part._buffers.values()])
            states = getattr(part, "_defaults", None)
            if isinstance(states, dict):  # state of a torchmetrics.Metric
                self.receive([states, [getattr(part, name) for name in states]])
                part._device = DEVICE  # type: ignore[assignment]

    def keep(self, value: Any) -> None:
        """Mark every tensor in a value as of the CPU, like attributes of an object that no call moves."""
        for tensor in tensors_in(value):
            _on_device[tensor] = False

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        name = getattr(func, "__name__", "")
        if name == "__get__":
            return self._attribute(func, args)
        result = func(*args, **kwargs)
        if name == "__set__":
            return result
        if name == "__iter__":
            result = list(result)
        if name in FACTORIES:
            return self._placed(result, kwargs.get("device"))
        if name in CONVERSIONS and not (args and isinstance(args[0], Tensor)):
            return self._placed(result, kwargs.get("device"))
        if name in ("to", "type_as", "cpu", *CONVERSIONS):
            return self._moved(name, result, args, kwargs)
        received = list(tensors_in((args, kwargs)))
        if name.startswith(("new_",)) or name.endswith("_like") or name == "full_like":
            return self._made_like(result, received[0], kwargs.get("device"))
        if name in ("numpy", "__array__"):
            if received and _on_device.get(received[0]):
                self._fault(name, "it reads a tensor of the device")
            return result
        if name in OF_THE_FIRST:
            return self._inherit(result, received[:1])
        if name in ONE_BY_ONE:
            results = result if isinstance(result, (tuple, list)) else (result,)
            for one, source in zip(results, received, strict=False):
                self._inherit(one, [source])
            return result
        if name == "__getitem__":
            self._indexed(name, args[0], args[1])
            return self._inherit(result, [args[0]])
        if name == "__setitem__":
            self._assigned(*args)
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
                    f"{tuple(tensor.shape)} of the {'device' if _on_device.get(tensor) else 'CPU'}"
                    for tensor in received
                    if _on_device.get(tensor) is not None
                )
                self._fault(name, f"its tensors are {shapes}")
        return self._inherit(result, received)

    def _attribute(self, func: Any, args: tuple[Any, ...]) -> Any:
        result = func(*args)
        owner = args[0]
        attribute = getattr(func.__self__, "__name__", "")
        if attribute == "device" and _on_device.get(owner):
            return DEVICE if result.type == "cpu" else result
        if isinstance(result, Tensor):
            self._inherit(result, [owner])
        return result

    def _placed(self, result: Any, device: Any) -> Any:
        """Mark a new tensor according to the `device=` argument that it was made with."""
        if device is None or not _is_device(device):
            self._leave(result)
        else:
            self.receive(result)
        return result

    def _made_like(self, result: Any, source: Tensor, device: Any) -> Any:
        return self._inherit(result, [source]) if device is None else self._placed(result, device)

    def _moved(self, name: str, result: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
        """Mark the result of `.to`, `.cpu` and similar calls.

        The result is a new tensor where its mark differs from that of its source.
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
            self.receive(result)
        elif inside is False:
            self._leave(result)
        return result

    def _inherit(self, result: Any, sources: list[Tensor]) -> Any:
        """Mark results by the marks of the tensors that they are computed from."""
        known = [_on_device.get(tensor) for tensor in sources]
        if any(known):
            self.receive(result)
        elif known and all(mark is False for mark in known):
            self._leave(result)
        return result

    def _leave(self, result: Any) -> None:
        """Mark tensors as of the CPU, unless a calling function chooses by itself where it computes."""
        tensors = [tensor for tensor in tensors_in(result) if _on_device.get(tensor) is not False]
        if tensors and not _decided():
            for tensor in tensors:
                _on_device[tensor] = False

    def _indexed(self, name: str, tensor: Any, index: Any) -> None:
        """Record a fault where a CPU tensor is indexed by a tensor of the device; CUDA allows the reverse."""
        if isinstance(tensor, Tensor) and _on_device.get(tensor) is False:
            for part in tensors_in(index):
                if _on_device.get(part) and (part.dim() > 0 or part.dtype == torch.bool):
                    self._fault(name, "a tensor of the device indexes one of the CPU")

    def _assigned(self, tensor: Tensor, index: Any, value: Any) -> None:
        """Record a fault where an assignment to indexed elements mixes devices; CUDA allows it for slices."""
        self._indexed("__setitem__", tensor, index)
        listed = index if isinstance(index, tuple) else (index,)
        advanced = any(
            isinstance(part, list)
            or (isinstance(part, Tensor) and (part.dim() > 0 or part.dtype == torch.bool))
            for part in listed
        )
        if advanced and isinstance(value, Tensor) and value.dim() > 0:
            places = _on_device.get(tensor), _on_device.get(value)
            if places in ((True, False), (False, True)):
                inside, outside = ("device", "CPU") if places[0] else ("CPU", "device")
                self._fault(
                    "__setitem__", f"{tuple(value.shape)} of the {outside} into a tensor of the {inside}"
                )

    def _fault(self, name: str, what: str) -> None:
        if _decided():
            return
        text = f"{name} at {_place()}: {what}"
        if text not in self.faults:
            self.faults.append(text)


def on_one_device(make: Callable[[OneDevice], Questions], worst: Worst) -> None:
    """Report every call that would mix devices while an object is built and used.

    A call that raises an error is repeated without marks. An error that occurs only with marks is reported; any other
    error is left to the checks that test for it.

    Args:
        make: Function that builds the object under the given mode, marks the tensors that are moved and received, and
            yields the calls to make.
        worst: Recorder of the faults.
    """
    mode = OneDevice()
    worst.count(False, "no tensor met one of another device")
    seed(SEED)
    questions = make(mode)
    while True:
        with mode, torch.no_grad():
            name, question = next(questions, ("", None))
        if question is None:
            break
        _ask(mode, question)
        for fault in mode.faults:
            worst.count(True, f"{name}: {fault}")
        mode.faults.clear()


def _ask(mode: OneDevice, question: Callable[[], Any]) -> None:
    said = ""
    for marked in (True, False):
        seed(SEED)
        try:
            with mode if marked else nullcontext(), torch.no_grad():
                question()
        except TooSlow:
            raise
        except Exception as error:
            if not marked:  # the input is refused, or another check covers the error
                return
            said = " ".join(f"{type(error).__name__}: {error}".split())
        if not said:
            return
    mode.faults.append(f"raises only on a device: {said}")


def tensors_in(value: Any, depth: int = 0) -> Iterator[Tensor]:
    """Yield every tensor in a value and in the lists, tuples, sets and dictionaries nested in it, 4 levels deep."""
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


def _mark_constants(packages: set[str]) -> None:
    """Mark tensors that modules of the packages hold as constants as of the CPU; no call moves them."""
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in packages:
            for value in list(vars(module).values()):
                if isinstance(value, Tensor) and _on_device.get(value) is None:
                    _on_device[value] = False


def _frames() -> Iterator[FrameType]:
    """Yield the frames of the calls between here and the check, innermost first, without those of libraries."""
    frame = sys._getframe(1)
    while frame is not None and (frame.f_code.co_filename, frame.f_code.co_name) != _ENTRY:
        frame = frame.f_back
    frame = frame and frame.f_back
    while frame is not None and frame.f_code.co_filename != __file__:
        path, module = frame.f_code.co_filename, frame.f_globals.get("__name__", "")
        if not path.startswith("<@beartype") and module.partition(".")[0] not in _LIBRARIES:
            yield frame
        frame = frame.f_back


_ENTRY = (__file__, "__torch_function__")
"""File and function through which torch enters `OneDevice`; type checkers may put frames between it and a helper."""


def _decided() -> bool:
    """Return whether a calling function asks where a tensor is, and so has separate code for each kind of device.

    Its code for the CPU, which runs here, is not the code that runs on a GPU, so its calls are not judged.
    """
    return any(_asks(frame.f_code) for frame in _frames())


def _asks(code: CodeType) -> bool:
    """Return whether a function reads `is_cuda`, `is_cpu` or `device.type`."""
    known = _ASKS.get(code)
    if known is None:
        known = bool({"is_cuda", "is_cpu"} & {*code.co_names})
        if not known and "type" in code.co_names:
            before = None
            for instruction in dis.get_instructions(code):
                known |= instruction.argval == "type" and before == "device"
                before = instruction.argval
        _ASKS[code] = known
    return known


_ASKS: dict[CodeType, bool] = {}


def _place() -> str:
    """Return file and line of the innermost call outside libraries; the path is cut to its last three parts."""
    for frame in _frames():
        path = frame.f_code.co_filename
        return f"{'/'.join(path.split('/')[-3:])}:{frame.f_lineno}"
    return "an unknown place"
