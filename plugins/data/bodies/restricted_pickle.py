"""Arrays out of pickles, without running anything that a pickle names.

A pickle is a program: it names functions of any installed module and calls them. Here a name becomes an inert record of
itself and of what it was given; afterwards those few records that mean an array, a sparse matrix or a wrapped array are
turned into one, and any other name has already been refused. Pickles of Python 2 (text as latin-1) and of every
protocol are read.
"""

import io
import pickle
import pickletools
import re
from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np
from scipy import sparse

MULTIARRAY = ("numpy.core.multiarray", "numpy._core.multiarray")
ALLOWED = {
    **{(module, name): name for module in MULTIARRAY for name in ("_reconstruct", "scalar")},
    ("numpy.core.numeric", "_frombuffer"): "_frombuffer",
    ("numpy._core.numeric", "_frombuffer"): "_frombuffer",
    ("numpy", "ndarray"): "ndarray",
    ("numpy", "dtype"): "dtype",
    ("_codecs", "encode"): "encode",
    ("copy_reg", "_reconstructor"): "_reconstructor",
    ("copyreg", "_reconstructor"): "_reconstructor",
    ("__builtin__", "object"): "object",
    ("builtins", "object"): "object",
    ("__builtin__", "bytes"): "bytes",
    ("builtins", "bytes"): "bytes",
    # the autodiff library in whose arrays body models were first published
    ("chumpy.ch", "Ch"): "Ch",
    ("chumpy.reordering", "Select"): "Select",
}
"""What a pickle may name, and what it is called here."""
SPARSE = re.compile(r"(csc|csr|coo)_(matrix|array)")
DTYPE = re.compile(r"[<>=|]?(b1|[iu][1248]|f[248]|c(8|16)|[SU]\d{1,4})")
DEEPEST = 40
MEMO = {"PUT", "BINPUT", "LONG_BINPUT"}


class PickleRefused(ValueError):
    """A pickle that holds more than arrays, or is damaged; says what was found."""


class _Named:
    """Something a pickle names; a class of its own for every name, so that nothing outlives the reading."""

    kind = ""
    arguments: tuple[Any, ...] = ()
    state: Any = None

    def __new__(cls, *arguments: Any) -> "_Named":
        found = object.__new__(cls)
        found.arguments = arguments
        return found

    def __init__(self, *arguments: Any) -> None:
        pass

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Reader(pickle.Unpickler):
    def find_class(self, module_name: str, global_name: str) -> Any:
        kind = ALLOWED.get((module_name, global_name))
        if kind is None and module_name.startswith("scipy.sparse") and SPARSE.fullmatch(global_name):
            kind = global_name[:3]
        if kind is None:
            _refuse(f"it names {module_name}.{global_name}, which could run code or is no array")
        return type("_" + kind.strip("_"), (_Named,), {"kind": kind})


def load(content: bytes) -> Any:
    """What a pickle holds: None, numbers, text, bytes, lists, tuples, dictionaries, arrays, SciPy's sparse matrices.

    Raises:
        PickleRefused: it names anything else, holds arrays of objects, or is damaged.
    """
    try:
        _check_memo(content)
        found = _Reader(io.BytesIO(content), encoding="latin1").load()
        return _plain(found, {}, 0)
    except PickleRefused:
        raise
    except Exception as error:  # a damaged pickle leads the reader to whatever error it likes
        raise PickleRefused(f"it is damaged ({type(error).__name__}: {error})") from error


def _check_memo(content: bytes) -> None:
    """Walk over a pickle without obeying it; refuse memo numbers that would make the reader reserve memory for them."""
    put = 0
    for opcode, argument, _ in pickletools.genops(content):
        if opcode.name in MEMO:
            put += 1
            if not 0 <= int(argument or 0) <= 2 * put + 1000:
                _refuse(f"its memo jumps to number {argument}")


def _refuse(why: str) -> NoReturn:
    raise PickleRefused(why)


def _plain(item: Any, done: dict[int, Any], depth: int) -> Any:
    """Without records: what was read twice is made once, so that nesting cannot multiply it."""
    if depth > DEEPEST:
        _refuse(f"it is nested more than {DEEPEST} deep, or within itself")
    if item is None or isinstance(item, str | bytes | int | float | complex):
        return item
    if isinstance(item, bytearray):
        return bytes(item)
    if id(item) not in done:
        done[id(item)] = _made(item, done, depth + 1)
    return done[id(item)]


def _made(item: Any, done: dict[int, Any], depth: int) -> Any:
    if isinstance(item, dict):
        return {_plain(key, done, depth): _plain(value, done, depth) for key, value in item.items()}
    if isinstance(item, list | tuple):
        return type(item)(_plain(value, done, depth) for value in item)
    if not isinstance(item, _Named):
        what = f"a bare {item.kind}" if isinstance(item, type) and issubclass(item, _Named) else type(item)
        _refuse(f"it holds {what}")
    if item.kind == "_reconstructor":
        cls = item.arguments[0]
        if not (isinstance(cls, type) and issubclass(cls, _Named)):
            _refuse("it rebuilds an object of no class")
        made = cls()
        made.__setstate__(item.state)
        item = made
    given = [_argument(value, done, depth) for value in item.arguments]
    state = _plain(item.state, done, depth)
    match item.kind:
        case "_reconstruct":
            return _array(*_exactly(state, 5)[1:])
        case "_frombuffer":
            raw, dtype, shape, order = given[:4]
            return _array(shape, dtype, order == "F", raw)
        case "dtype":
            return _dtype(given[0], state)
        case "scalar":
            return _array((), given[0], False, given[1])[()]
        case "encode":
            return given[0].encode("latin1")
        case "bytes":
            return b"" if not given else bytes(_only_bytes(given[0]))
        case "csc" | "csr" | "coo":
            return _sparse(item.kind, state)
        case "Ch":
            return _wrapped(state, "x")
        case "Select":
            flat = np.ravel(_wrapped(state, "a"))[_wrapped(state, "idxs")]
            return flat.reshape(state.get("preferred_shape", flat.shape))
    return _refuse(f"it holds a bare {item.kind}")


def _argument(value: Any, done: dict[int, Any], depth: int) -> Any:
    """Classes may be arguments: which one an array once was is no matter."""
    return None if isinstance(value, type) and issubclass(value, _Named) else _plain(value, done, depth)


def _exactly(state: Any, count: int) -> tuple[Any, ...]:
    if not isinstance(state, tuple) or len(state) != count:
        _refuse(f"an array whose state is {type(state).__name__}; wanted {count} parts")
    return state


def _dtype(text: Any, state: Any) -> np.dtype:
    text = text.decode("latin1") if isinstance(text, bytes) else text
    if not isinstance(text, str) or not DTYPE.fullmatch(text):
        _refuse(f"an array of {text!r}; wanted numbers or text, no objects")
    found = np.dtype(text)
    if state is None:
        return found
    order = state[1].decode("latin1") if isinstance(state[1], bytes) else state[1]
    if any(part is not None for part in state[2:5]):
        _refuse("an array of records; wanted numbers or text")
    return found.newbyteorder(order) if order in ("<", ">") else found


def _array(shape: Any, dtype: Any, fortran: Any, raw: Any) -> np.ndarray:
    if not isinstance(dtype, np.dtype):
        _refuse("an array without a type")
    raw = raw.encode("latin1") if isinstance(raw, str) else raw  # as Python 2 wrote it
    sides = tuple(shape) if isinstance(shape, list | tuple) else ()
    if not isinstance(raw, bytes) or not all(isinstance(side, int) and side >= 0 for side in sides):
        _refuse("an array of Python objects")
    size = dtype.itemsize
    for side in sides:
        size *= side  # whole numbers of Python: nothing overflows
    if size != len(raw):
        _refuse(f"an array of shape {sides} and type {dtype} with {len(raw)} bytes of data instead of {size}")
    return np.frombuffer(raw, dtype).reshape(sides, order="F" if fortran else "C").copy()


def _sparse(kind: str, state: Any) -> Any:
    state = _mapping(state)
    rows, columns = (int(side) for side in state.get("_shape", state.get("shape")))
    data = state["data"]
    if kind == "coo":
        places = state["coords"] if "coords" in state else (state["row"], state["col"])
        found = sparse.coo_matrix((data, tuple(places)), shape=(rows, columns))
    else:
        made = sparse.csc_matrix if kind == "csc" else sparse.csr_matrix
        found = made((data, state["indices"], state["indptr"]), shape=(rows, columns))
        found.check_format(full_check=True)
    return found


def _wrapped(state: Any, key: str) -> np.ndarray:
    found = _mapping(state).get(key)
    if not isinstance(found, np.ndarray):
        _refuse(f"a wrapped array without its {key!r}")
    return found


def _mapping(state: Any) -> Mapping[str, Any]:
    if not isinstance(state, dict):
        _refuse(f"an object whose state is {type(state).__name__}; wanted its attributes")
    return state


def _only_bytes(value: Any) -> bytes:
    return value if isinstance(value, bytes) else _refuse("bytes made of something else")
