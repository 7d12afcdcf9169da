"""Finds on the CPU the calls that would mix tensors of the CPU with tensors of a GPU.

`OneDevice` runs code with the tensors that it receives marked as tensors "of the device", as a GPU would hold them, and
tensors made without `device=` marked as tensors of the CPU. Results inherit the marks of what they are computed from,
and a call that mixes both where CUDA would raise is recorded. Nothing is moved: all numbers stay as they are.
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
"""What `tensor.device` says of a tensor of the device; torch reads it as the CPU.

It differs from `torch.device("cpu")`, which `tensor.device` says of a tensor of the CPU.
"""
FACTORIES = frozenset(
    ("zeros", "ones", "empty", "full", "arange", "range", "linspace", "logspace", "eye", "rand", "randn", "randint",
     "randperm", "from_numpy", "frombuffer", "tril_indices", "triu_indices", "hann_window", "hamming_window",
     "blackman_window", "bartlett_window", "kaiser_window", "fft_fftfreq", "fft_rfftfreq", "empty_strided",
     "scalar_tensor", "sparse_coo_tensor")
)  # fmt: skip
"""Functions whose result is of the CPU unless `device=` says otherwise."""
CONVERSIONS = frozenset(("tensor", "as_tensor", "asarray"))
"""Functions whose result is where their argument is if that is a tensor, else as of FACTORIES."""
OF_THE_FIRST = frozenset(
    ("expand_as", "view_as", "reshape_as", "copy_", "set_", "resize_as_", "__deepcopy__", "is_same_size", "align_as",
     "_make_subclass", "backward", "register_hook", "new_tensor", "new_zeros", "new_ones",
     "new_full", "new_empty", "new_empty_strided", "zeros_like", "ones_like", "empty_like", "full_like", "rand_like",
     "randn_like", "randint_like")
)  # fmt: skip
"""Functions whose result is where their first argument is, whatever the others are."""
ONE_BY_ONE = frozenset(("broadcast_tensors", "atleast_1d", "atleast_2d", "atleast_3d"))
"""Functions each of whose results is where the argument in the same place is."""
STRICT = frozenset(
    ("cat", "concat", "concatenate", "stack", "hstack", "vstack", "dstack", "column_stack", "row_stack", "block_diag",
     "searchsorted", "bucketize", "gather", "scatter", "scatter_", "scatter_add", "scatter_add_", "scatter_reduce",
     "scatter_reduce_", "index_select", "index_add", "index_add_", "index_copy", "index_copy_", "take",
     "take_along_dim", "equal", "allclose", "isclose", "outer", "kron", "tensordot", "einsum", "isin")
)  # fmt: skip
"""Functions that refuse tensors of two devices even where those of the CPU are single numbers."""
_LIBRARIES = frozenset(("torch", "torchmetrics", "jaxtyping", "beartype", "numpy", "scipy"))
Questions = Iterator[tuple[str, Callable[[], Any]]]
"""Names and what is asked."""
_on_device: Any = WeakTensorKeyDictionary()
"""Tensor → whether it is of the device (True) or of the CPU (False); of any other nothing is known."""


class OneDevice(TorchFunctionMode):
    """Records the calls inside that mix tensors of the device with tensors of the CPU.

    Attributes:
        faults: what was mixed and where, each place once.
    """

    def __init__(self) -> None:
        super().__init__()
        self.faults: list[str] = []

    def receive(self, value: Any) -> Any:
        """Mark every tensor in a value, whatever containers or dictionaries hold it, as of the device; returns it."""
        for tensor in tensors_in(value):
            _on_device[tensor] = True
        return value

    def move(self, module: nn.Module) -> None:
        """Mark what `module.to(device)` moves: parameters, buffers and the states of metrics.

        Plain attributes stay on the CPU, and so do tensors that are constants of the modules of its package.
        """
        _mark_constants({"framework", type(module).__module__.partition(".")[0]})
        for part in module.modules():
            self.receive([*part._parameters.values(), *part._buffers.values()])
            states = getattr(part, "_defaults", None)
            if isinstance(states, dict):  # a torchmetrics.Metric
                self.receive([states, [getattr(part, name) for name in states]])
                part._device = DEVICE  # type: ignore[assignment]

    def keep(self, value: Any) -> None:
        """Mark every tensor in a value as of the CPU, as attributes of an object that nothing moves."""
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
        if name == "grad":  # of torch.autograd: each gradient is where its input is
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
        """Mark a new tensor by the `device=` it was made with."""
        if device is None or not _is_device(device):
            self._leave(result)
        else:
            self.receive(result)
        return result

    def _made_like(self, result: Any, source: Tensor, device: Any) -> Any:
        return self._inherit(result, [source]) if device is None else self._placed(result, device)

    def _moved(self, name: str, result: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
        """Mark what `.to`, `.cpu` and their like return; a new tensor where it is on the other side of the old one."""
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
        """Mark results by what they are computed from."""
        known = [_on_device.get(tensor) for tensor in sources]
        if any(known):
            self.receive(result)
        elif known and all(mark is False for mark in known):
            self._leave(result)
        return result

    def _leave(self, result: Any) -> None:
        """Mark tensors as of the CPU, but not those of a function that decides by itself where it computes."""
        tensors = [tensor for tensor in tensors_in(result) if _on_device.get(tensor) is not False]
        if tensors and not _decided():
            for tensor in tensors:
                _on_device[tensor] = False

    def _indexed(self, name: str, tensor: Any, index: Any) -> None:
        """Record a tensor of the CPU that is indexed by one of the device; the other way round is right."""
        if isinstance(tensor, Tensor) and _on_device.get(tensor) is False:
            for part in tensors_in(index):
                if _on_device.get(part) and (part.dim() > 0 or part.dtype == torch.bool):
                    self._fault(name, "a tensor of the device indexes one of the CPU")

    def _assigned(self, tensor: Tensor, index: Any, value: Any) -> None:
        """Record what cannot be assigned: slices are copied between devices, indexed numbers are not."""
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
    """Report every call that would mix devices while something is made and asked.

    What raises an error is asked once more without marks: an error that comes only with them is reported, any other is
    left to the checks that are for it.

    Args:
        make: builds what is checked in the given mode, marks what is moved and received, and yields its questions.
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
            if not marked:  # it is refused, or another check is for it
                return
            said = " ".join(f"{type(error).__name__}: {error}".split())
        if not said:
            return
    mode.faults.append(f"raises only on a device: {said}")


def tensors_in(value: Any, depth: int = 0) -> Iterator[Tensor]:
    """Every tensor in a value, or in the lists, tuples and dictionaries that it holds."""
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
    """Mark tensors that modules hold as constants, which nothing moves."""
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in packages:
            for value in list(vars(module).values()):
                if isinstance(value, Tensor) and _on_device.get(value) is None:
                    _on_device[value] = False


def _frames() -> Iterator[FrameType]:
    """The calls that led here, the innermost first, up to the check."""
    frame = sys._getframe(1)
    while frame is not None and frame.f_code.co_filename == __file__:
        frame = frame.f_back
    while frame is not None and frame.f_code.co_filename != __file__:
        if frame.f_globals.get("__name__", "").partition(".")[0] not in _LIBRARIES:
            yield frame
        frame = frame.f_back


def _decided() -> bool:
    """Whether a function that led here asks where a tensor is, and so has a way for each kind of device.

    Its way for the CPU, which is taken here, is not the one that a GPU takes.
    """
    return any(_asks(frame.f_code) for frame in _frames())


def _asks(code: CodeType) -> bool:
    """Whether a function reads `is_cuda`, `is_cpu` or `device.type`."""
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
    """File and line of the call, below its package, and its text."""
    for frame in _frames():
        path = frame.f_code.co_filename
        return f"{'/'.join(path.split('/')[-3:])}:{frame.f_lineno}"
    return "an unknown place"
