"""Reader of arrays from pickles that calls no function named in a pickle.

A pickle is a program: it names functions of any installed module and calls them. This module uses the standard library
only to split a pickle into its instructions, and interprets only the few instructions that arrays need. A name becomes
an inert record of the name and of its arguments. Records of an array, a sparse matrix or a wrapped array are then
converted to plain arrays; any other name is refused before that. Pickles of Python 2 (text as latin-1) and of every
protocol are read.

The cost of a file is bounded by its size: the number of instructions, the depth of nesting, and the size of arrays,
which may not exceed the data in the file. Sparse matrices are an exception: they become dense, and the number of
elements of all of them together is limited. Keys of dictionaries are words and small numbers, because hashing other
keys could take unlimited time (for example, a tuple that holds the same tuple twice, thirty levels deep).
"""

import math
import pickletools
import re
from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np

from framework.errors import shorten

MULTIARRAY = ("numpy.core.multiarray", "numpy._core.multiarray")
_NAMES = {
    **dict.fromkeys(MULTIARRAY, ("_reconstruct", "scalar")),
    **dict.fromkeys(("numpy.core.numeric", "numpy._core.numeric"), ("_frombuffer",)),
    "numpy": ("ndarray", "dtype"),
    "_codecs": ("encode",),
    **dict.fromkeys(("copy_reg", "copyreg"), ("_reconstructor",)),
    **dict.fromkeys(("__builtin__", "builtins"), ("object", "bytes")),
    # the autodiff library whose arrays hold the first published body models
    "chumpy.ch": ("Ch",),
    "chumpy.reordering": ("Select",),
}
"""Names that a pickle may use, by module."""
ALLOWED = {(module, name): name for module, names in _NAMES.items() for name in names}
"""Names that a pickle may use, as (module, name), and the `kind` of the `_Record` that is made of each."""
SPARSE = re.compile(r"(csc|csr|coo)_(matrix|array)")
DTYPE = re.compile(r"[<>=|]?(b1|[iu][1248]|f[248]|c(8|16)|[SU]\d{1,4})")
DEEPEST = 40
MOST_INSTRUCTIONS = 200_000
"""Largest number of instructions; published bodies have a few thousand."""
LARGEST = 2**24
"""Largest number of elements of all sparse matrices of a file together, after they were made dense."""
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
FRESH = {"EMPTY_LIST": list, "EMPTY_DICT": dict}
VALUES = re.compile(
    r"(BIN)?INT[12]?|LONG[14]?|(SHORT_)?(BIN)?(STRING|UNICODE|BYTES)8?|BYTEARRAY8|(BIN)?FLOAT"
)
"""Instructions that hold a number, text or bytes."""
TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
MARK = object()
MOST_SIDES, LONGEST_SIDE = 32, 2**31
"""Largest number of dimensions of an array, and exclusive limit of the length of each dimension.

A file could otherwise hold lengths of thousands of digits, whose multiplication is slow.
"""


class PickleRefused(ValueError):
    """Error for a pickle that holds more than arrays, or is damaged; its message says what was found."""


class _Record:
    """Record of a name that a pickle refers to, and of the arguments with which the pickle calls it.

    `called` is true if the pickle calls the name; otherwise the record is of the name alone.
    """

    def __init__(self, kind: str, arguments: tuple[Any, ...] = (), *, called: bool = False) -> None:
        self.kind = kind
        self.arguments = arguments
        self.called = called
        self.state: Any = None


def load(content: bytes) -> Any:
    """Return the content of a pickle.

    The content consists of None, numbers, text, bytes, lists, tuples, dictionaries and arrays; sparse matrices become
    arrays.

    Raises:
        PickleRefused: the pickle names anything else, holds arrays of objects, or is damaged.
    """
    try:
        return _Plain(len(content)).of(_build_records(content), 0)
    except PickleRefused:
        raise
    except Exception as error:  # a damaged pickle can raise an error of any type
        raise PickleRefused(f"the pickle is damaged ({type(error).__name__}: {shorten(error)})") from error


def _build_records(content: bytes) -> Any:
    """Return the object that a pickle's instructions build, with a `_Record` in place of each named object."""
    stack: list[Any] = []
    memo: dict[int, Any] = {}
    for count, (opcode, argument, _) in enumerate(pickletools.genops(content)):
        if count == MOST_INSTRUCTIONS:
            _refuse(f"the pickle has more than {MOST_INSTRUCTIONS} instructions")
        name = opcode.name
        if VALUES.fullmatch(name):
            stack.append(argument)
        elif name in CONSTANTS:
            stack.append(CONSTANTS[name])
        elif name in FRESH:
            stack.append(FRESH[name]())
        elif name in ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"):
            number = len(memo) if name == "MEMOIZE" else int(argument or 0)
            if not 0 <= number <= MOST_INSTRUCTIONS:
                _refuse(
                    f"the memo of the pickle has the number {number}; expected numbers from 0 to {MOST_INSTRUCTIONS}"
                )
            memo[number] = stack[-1]
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            stack.append(memo[int(argument or 0)])
        elif name == "STOP":
            return stack.pop()
        elif name not in ("PROTO", "FRAME"):
            _obey(name, argument, stack)
    return _refuse("the pickle is cut short, because the instruction that ends it is missing")


def _obey(name: str, argument: Any, stack: list[Any]) -> None:
    """Execute an instruction that changes only the stack; other instructions are refused."""
    match name:
        case "MARK":
            stack.append(MARK)
        case "POP":
            stack.pop()
        case "POP_MARK":
            _since_mark(stack)
        case "DUP":
            stack.append(stack[-1])
        case "TUPLE":
            stack.append(tuple(_since_mark(stack)))
        case "TUPLE1" | "TUPLE2" | "TUPLE3":
            items = [stack.pop() for _ in range(TUPLES[name])]
            stack.append(tuple(items[::-1]))
        case "LIST":
            stack.append(_since_mark(stack))
        case "DICT":
            items = _since_mark(stack)
            stack.append({})
            _set(stack[-1], items)
        case "APPEND" | "APPENDS":
            items = [stack.pop()] if name == "APPEND" else _since_mark(stack)
            if type(stack[-1]) is not list:
                _refuse("the pickle appends to an object that is not a list")
            stack[-1].extend(items)
        case "SETITEM" | "SETITEMS":
            items = [stack.pop(), stack.pop()][::-1] if name == "SETITEM" else _since_mark(stack)
            _set(stack[-1], items)
        case "GLOBAL":
            stack.append(_named(*argument.split(" ", 1)))
        case "STACK_GLOBAL":
            word, module = stack.pop(), stack.pop()
            stack.append(_named(module, word))
        case "REDUCE" | "NEWOBJ":
            arguments, called = stack.pop(), stack.pop()
            if not isinstance(called, _Record) or called.called or type(arguments) is not tuple:
                _refuse("the pickle calls an object that is not the name of a function or class")
            if called.kind == "_reconstructor":
                called, arguments = arguments[0], ()
                if not isinstance(called, _Record) or called.called:
                    _refuse("the pickle builds an object without a class")
            stack.append(_Record(called.kind, arguments, called=True))
        case "BUILD":
            state = stack.pop()
            if not isinstance(stack[-1], _Record) or not stack[-1].called:
                _refuse("the pickle sets attributes of something that is not an object")
            stack[-1].state = state
        case _:
            _refuse(f"the pickle has the instruction {name}, which arrays do not need")


def _since_mark(stack: list[Any]) -> list[Any]:
    place = len(stack) - 1
    while stack[place] is not MARK:  # raises an IndexError if there is no mark
        place -= 1
    items = stack[place + 1 :]
    del stack[place:]
    return items


def _set(target: Any, items: list[Any]) -> None:
    if type(target) is not dict:
        _refuse("the pickle sets an item of an object that is not a dictionary")
    for key, value in zip(items[::2], items[1::2], strict=True):
        if not (isinstance(key, str | bytes) or (isinstance(key, int) and abs(key) < 2**31)):
            _refuse(
                f"a dictionary has a key of type {type(key).__name__}; expected words or small numbers as keys"
            )
        target[key] = value


def _named(module: Any, word: Any) -> _Record:
    kind = ALLOWED.get((module, word))
    if kind is None and str(module).startswith("scipy.sparse") and SPARSE.fullmatch(str(word)):
        kind = word[:3]
    if kind is None:
        _refuse(f"the pickle names {module}.{word}, which could run code or is not needed for arrays")
    return _Record(kind)


def _refuse(why: str) -> NoReturn:
    raise PickleRefused(shorten(why))


class _Plain:
    """Converter of the records (`_Record`) of a pickle to arrays.

    An object that is referenced several times is converted only once, so that the cost is bounded by the file's size.

    Args:
        size: size of the file, bytes, which limits the total size of the arrays.
    """

    def __init__(self, size: int) -> None:
        self.converted: dict[int, Any] = {}
        self.bytes_left = (
            4 * size
        )  # four copies of an array: its text, its bytes, the array itself, and a selection from it
        self.sparse_left = LARGEST

    def of(self, item: Any, depth: int) -> Any:
        if depth > DEEPEST:
            _refuse(f"the pickle is nested more than {DEEPEST} deep, or within itself")
        if item is None or isinstance(item, str | bytes | int | float):
            return item
        if id(item) not in self.converted:
            self.converted[id(item)] = self._convert(item, depth + 1)
        return self.converted[id(item)]

    def _convert(self, item: Any, depth: int) -> Any:
        if isinstance(item, dict):
            return {key: self.of(value, depth) for key, value in item.items()}
        if isinstance(item, list | tuple):
            return type(item)(self.of(value, depth) for value in item)
        if isinstance(item, bytearray):
            return bytes(item)
        if not isinstance(item, _Record) or not item.called:
            _refuse(
                f"the pickle holds the bare name {item.kind if isinstance(item, _Record) else type(item).__name__}"
            )
        # bare names may be arguments: the original class of an array is irrelevant
        bare = [isinstance(value, _Record) and not value.called for value in item.arguments]
        arguments: list[Any] = [
            None if name else self.of(value, depth) for name, value in zip(bare, item.arguments, strict=True)
        ]
        state = self.of(item.state, depth)
        match item.kind:
            case "_reconstruct":
                return self._array(*_exactly(state, 5)[1:])
            case "_frombuffer":
                raw, dtype, shape, order = arguments[:4]
                return self._array(shape, dtype, order == "F", raw)
            case "dtype":
                return _dtype(arguments[0], state)
            case "scalar":
                return self._array((), arguments[0], False, arguments[1])[()]
            case "encode":
                self._spend(len(arguments[0]))
                return arguments[0].encode("latin1")
            case "bytes":
                return b"" if not arguments else _only_bytes(arguments[0])
            case "csc" | "csr" | "coo":
                return self._sparse(item.kind, _mapping(state))
            case "Ch":
                return _unwrap(state, "x")
            case "Select":
                flat, places = np.ravel(_unwrap(state, "a")), _unwrap(state, "idxs")
                self._spend(places.size * flat.itemsize)
                return flat[places].reshape(state.get("preferred_shape", places.shape))
        _refuse(f"the pickle holds the bare name {item.kind}")

    def _array(self, shape: Any, dtype: Any, fortran: Any, raw: Any) -> np.ndarray:
        if not isinstance(dtype, np.dtype):
            _refuse("an array has no type")
        raw = raw.encode("latin1") if isinstance(raw, str) else raw  # Python 2 wrote text
        sides = tuple(shape) if isinstance(shape, list | tuple) else ()
        if not isinstance(raw, bytes) or len(sides) > MOST_SIDES or not all(map(_side, sides)):
            _refuse("the pickle holds an array of Python objects")
        size = dtype.itemsize * math.prod(sides)
        if size != len(raw):
            _refuse(
                f"an array of shape {sides} and type {dtype} has {len(raw)} bytes of data instead of {size}"
            )
        self._spend(size)
        return np.frombuffer(raw, dtype).reshape(sides, order="F" if fortran else "C").copy()

    def _spend(self, size: int) -> None:
        self.bytes_left -= size
        if self.bytes_left < 0:
            _refuse("the pickle expands to much more data than the file holds")

    def _sparse(self, kind: str, state: Mapping[str, Any]) -> np.ndarray:
        """Return a sparse matrix as a dense array; entries at the same position are added.

        `kind` is the storage format of the matrix, and `state` its attributes.
        """
        rows, columns = state.get("_shape", state.get("shape"))
        if not _side(rows) or not _side(columns) or rows * columns > self.sparse_left:
            _refuse(f"a sparse matrix of {rows} x {columns} is too large for a body model")
        self.sparse_left -= rows * columns
        data = _line(state["data"], "biuf")
        if kind == "coo":
            row, column = (
                _line(part, "iu") for part in state.get("coords", (state.get("row"), state.get("col")))
            )
        else:
            starts, inner = _line(state["indptr"], "iu"), _line(state["indices"], "iu")
            lines = columns if kind == "csc" else rows
            # checked before casts and subtractions, which are modulo 2^64; `repeat` allocates the sum of its counts
            bounded = len(starts) == lines + 1 and starts.min() >= 0 and starts.max() <= len(data)
            counts = np.diff(starts.astype(np.int64)) if bounded else np.array([-1])
            if not bounded or starts[0] != 0 or starts[-1] != len(data) or (counts < 0).any():
                _refuse(
                    f"the beginnings of the {lines} lines of a sparse matrix do not rise from 0 to {len(data)}"
                )
            outer = np.repeat(np.arange(lines), counts)
            row, column = (inner, outer) if kind == "csc" else (outer, inner)
        dense = np.zeros((rows, columns), data.dtype)
        if not len(data) == len(row) == len(column) or (
            len(data) and (min(row.min(), column.min()) < 0 or row.max() >= rows or column.max() >= columns)
        ):
            _refuse(f"a sparse matrix of {rows} x {columns} has entries outside of the matrix")
        np.add.at(dense, (row, column), data)
        return dense


def _exactly(state: Any, count: int) -> tuple[Any, ...]:
    if not isinstance(state, tuple) or len(state) != count:
        _refuse(f"the state of an array has the type {type(state).__name__}; expected {count} parts")
    return state


def _dtype(text: Any, state: Any) -> np.dtype:
    text = text.decode("latin1") if isinstance(text, bytes) else text
    if not isinstance(text, str) or not DTYPE.fullmatch(text):
        _refuse(f"an array has the type {text!r}; expected numbers or text, no objects")
    dtype = np.dtype(text)
    if state is None:
        return dtype
    order = state[1].decode("latin1") if isinstance(state[1], bytes) else state[1]
    if any(part is not None for part in state[2:5]):
        _refuse("the pickle holds an array of records; expected numbers or text")
    return dtype.newbyteorder(order) if order in ("<", ">") else dtype


def _side(value: Any) -> bool:
    return isinstance(value, int) and 0 <= value < LONGEST_SIDE


def _line(values: Any, kinds: str) -> np.ndarray:
    """Return `values` unchanged if they are a one-dimensional array whose kind of dtype is in `kinds`.

    Raises:
        PickleRefused: `values` is anything else.
    """
    if not isinstance(values, np.ndarray) or values.ndim != 1 or values.dtype.kind not in kinds:
        _refuse("a sparse matrix has no numbers")
    return values


def _unwrap(state: Any, key: str) -> np.ndarray:
    array = _mapping(state).get(key)
    if not isinstance(array, np.ndarray):
        _refuse(f"the attribute {key!r} of a wrapped array is missing")
    return array


def _mapping(state: Any) -> Mapping[str, Any]:
    if not isinstance(state, dict):
        _refuse(
            f"the state of an object has the type {type(state).__name__}; expected a dictionary of attributes"
        )
    return state


def _only_bytes(value: Any) -> bytes:
    return (
        bytes(value)
        if isinstance(value, bytes)
        else _refuse("the pickle builds bytes from something other than bytes")
    )
