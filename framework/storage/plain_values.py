"""Readers for untrusted JSON, YAML and pickle files, which admit plain values only and limit their number."""

import json
import pickletools
import re
import sys
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import yaml
from yaml.composer import ComposerError
from yaml.constructor import ConstructorError

from framework.errors import DataError, UserError, quote, shorten
from framework.storage.reading import RESTORE, read_bytes, translate_errors
from framework.storage.text import decode

LARGEST_JSON, LARGEST_YAML = 2**24, 2**17
"""Largest size of a JSON file and of a YAML file, in bytes."""
DEEPEST, MOST_ITEMS = 64, 100_000


class PlainLoader(yaml.SafeLoader):
    """YAML loader that reads only plain decimal numbers as numbers; 1_0, 0x10, 010 and 1:30 are read as text."""


PlainLoader.yaml_implicit_resolvers = {
    first: [(tag, words) for tag, words in resolvers if tag.rpartition(":")[2] not in ("int", "float")]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_INT = re.compile(r"[-+]?(?:0|[1-9][0-9]*)$")
_FLOAT = re.compile(
    r"(?:[-+]?(?:[0-9]+\.[0-9]*|\.[0-9]+)(?:[eE][-+][0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
)
PlainLoader.add_implicit_resolver("tag:yaml.org,2002:int", _INT, list("-+0123456789"))
PlainLoader.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+.0123456789"))
PlainLoader.add_constructor("tag:yaml.org,2002:int", lambda loader, node: _whole_number(str(node.value)))


def read_json(file: Path, expected: str, remedy: str = RESTORE) -> dict[str, Any]:
    """Return the object in a JSON file.

    Raises:
        DataError: The file is missing or damaged, or contains another value than an object. The message contains
            `expected`, a description of the file, and `remedy`.
    """
    with translate_errors(file, expected, remedy):
        content = json.loads(decode(_content(file, LARGEST_JSON)), parse_int=_whole_number)
        if not isinstance(content, dict):
            raise ValueError(
                f"the file contains a {type(content).__name__}, but a JSON object ({{...}}) is required"
            )
        return content


def read_yaml(file: Path, expected: str, remedy: str = RESTORE, error: type[UserError] = DataError) -> Any:
    """Return the values in a YAML file.

    Args:
        file: Path of the file.
        expected: Description of the expected content, for messages.
        remedy: Advice for a damaged file, for messages.
        error: Class of the errors.

    Raises:
        error: The file is missing or damaged, or contains a tag (!name) or an alias. A tag can stand for a Python
            object, and programs read it differently. With aliases, a few lines could mean more values than fit into
            any memory.
    """
    with translate_errors(file, expected, remedy, kind=error):
        text = decode(_content(file, LARGEST_YAML))
        depth = 0
        for event in yaml.parse(text, PlainLoader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > DEEPEST or isinstance(event, yaml.AliasEvent):
                raise ValueError(
                    f"the file contains an alias (*name) or values nested more than {DEEPEST} levels deep, which are "
                    "not allowed"
                )
            if getattr(event, "tag", None) is not None:
                raise ValueError(f"{_place(event.start_mark)}: the tag {shorten(event.tag)} is not allowed")
        try:
            return yaml.load(text, PlainLoader)
        except (ComposerError, ConstructorError) as fault:
            raise ValueError(f"{_place(fault.problem_mark)}: {fault.context}, {fault.problem}") from fault


def _place(mark: Any) -> str:
    """Return the place of a mark of YAML in its file, as text."""
    return f"line {mark.line + 1}, column {mark.column + 1}"


def is_number(value: Any) -> TypeGuard[int | float]:
    """Return whether a value of JSON or YAML is a number that fits into a float.

    Unlike in Python, true and false are not numbers here.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return isinstance(value, float) or abs(value) <= sys.float_info.max


def plain_numbers(value: Any) -> Any:
    """Return a value of JSON or YAML after checking that it is a number or nested lists of numbers.

    The check is needed because NumPy and torch also accept true and text.

    Raises:
        ValueError: An item is not a number; the message quotes it.
    """
    if isinstance(value, list | tuple):
        return [plain_numbers(item) for item in value]
    if not is_number(value):
        raise ValueError(f"expected a number, got {quote(value)}")
    return value


class Foreign(ValueError):
    """Error for a file with content other than plain values and dense tensors; its text names that content."""


@dataclass(slots=True)
class _Item:
    """Description of a value on the stack of a pickle; the value itself is not built.

    Attributes:
        size: Size of the text, or of everything that the value contains.
        values: Number of values that a tuple contains, including nested values.
        name: Name of a global as "module name"; "" for any other value.
        text: Text of a short string, or of the short string that ends a tuple; "" for any other value.
        mark: Whether the item is a mark, which a pickle pushes before a list of values, and not a value.
    """

    size: int = 1
    values: int = 1
    name: str = ""
    text: str = ""
    mark: bool = False


PUTS = frozenset(("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"))
GETS = frozenset(("GET", "BINGET", "LONG_BINGET"))
TUPLES = frozenset(("TUPLE", "TUPLE1", "TUPLE2", "TUPLE3"))
ADDS = {"APPEND": 1, "SETITEM": 2, "BUILD": 1, "APPENDS": 0, "SETITEMS": 0, "ADDITEMS": 0}
"""Instructions that add values from the top of the stack to the object below them, with the number of values.

0 means all values above the last mark, which another instruction has pushed before the values.
"""
OTHERS = {"STACK_GLOBAL", "INST", "OBJ", "NEWOBJ_EX", "EXT1", "EXT2", "EXT4", "PERSID", "DUP"}
OTHERS |= {"NEXT_BUFFER", "READONLY_BUFFER"}
"""Instructions that `torch.save` never writes and torch does not read."""
VALUES = frozenset(
    opcode.name
    for opcode in pickletools.opcodes
    if not opcode.stack_before
    and len(opcode.stack_after) == 1
    and opcode.name not in {*GETS, *OTHERS, "MARK", "GLOBAL"}
)
"""Instructions that push a new value onto the stack, such as a number, a text or an empty list."""
RENAMED = {"__builtin__": "builtins"}
"""Names of Python 2 modules, as pickles of protocol 2 use them, with their names in Python 3."""
ENCODE = "_codecs encode"
"""Function that a pickle of protocol 2 calls to build bytes."""
TIMES_ITSELF = 4
"""Largest ratio of the total size of the objects that calls in a pickle build to the size of the pickle."""
HIGHEST = 2**62
MOST_INSTRUCTIONS = 1_000_000
"""Largest number of instructions in a pickle; a tensor takes 30 of them, a number 1 or 2."""


def require_plain_pickle(pickled: bytes, called: Collection[str] = (), named: Collection[str] = ()) -> None:
    """Inspect a pickle without building any object.

    A tuple may not contain more than MOST_ITEMS values, including nested values. Without this limit, a few tuples that
    each contain the one before twice could have so many values that hashing them as a key would never end.

    Args:
        pickled: Bytes of one pickle.
        called: Globals that the pickle may name and call, each as its module and its name in Python 3,
            with a blank between them.
        named: Globals that the pickle may name but not call.

    Raises:
        Foreign: The pickle names another global, or calls another object.
        ValueError: The pickle would build objects far larger than itself.
        Exception: The pickle is damaged.
    """
    stack: list[_Item] = []
    memo: dict[int, _Item] = {}
    size_left = TIMES_ITSELF * len(pickled) + 1000
    for opcode, argument, _ in instructions(pickled):
        name = opcode.name
        if name in PUTS:
            memo[len(memo) if argument is None else int(argument)] = stack[-1]
        elif name in GETS:
            stack.append(memo[int(argument or 0)])
        elif name in VALUES:
            if isinstance(argument, str | bytes):
                short = argument if isinstance(argument, str) and len(argument) < 32 else ""
                stack.append(_Item(1 + len(argument), text=short))
            else:
                stack.append(_Item())
        elif name in TUPLES:
            inner = (
                _above_mark(stack) if name == "TUPLE" else [stack.pop() for _ in range(int(name[-1]))][::-1]
            )
            values = 1 + sum(item.values for item in inner)
            if values > MOST_ITEMS:
                raise ValueError(
                    f"the pickle contains a tuple of more than {MOST_ITEMS} values, which is not allowed"
                )
            text = inner[-1].text if inner else ""
            stack.append(_Item(1 + sum(item.size for item in inner), values, text=text))
        elif name == "GLOBAL":
            module, _, word = str(argument).partition(" ")
            global_name = f"{RENAMED.get(module, module)} {word}"
            if global_name not in called and global_name not in named:
                raise Foreign(
                    f"the pickle names {shorten(global_name.replace(' ', '.', 1))}, which is not allowed"
                )
            stack.append(_Item(name=global_name))
        elif name in ADDS:
            inner = [stack.pop() for _ in range(ADDS[name])] or _above_mark(stack)
            # the size of an object that is added to itself would double each time
            stack[-1].size = min(stack[-1].size + sum(item.size for item in inner), HIGHEST)
        elif name in ("REDUCE", "NEWOBJ"):
            arguments, function = stack.pop(), stack.pop()
            if function.name not in called:
                raise Foreign(
                    f"the pickle calls {function.name or 'an object that is not a function'}, which is not allowed"
                )
            if function.name == ENCODE and arguments.text != "latin1":  # some codecs take quadratic time
                raise Foreign("the pickle builds bytes in a way that Python's pickle module does not use")
            size_left -= arguments.size
            if size_left < 0:
                raise ValueError(
                    "the pickle would build objects that are far larger than the pickle itself, which is not allowed"
                )
            stack.append(_Item(arguments.size))
        elif name == "MARK":
            stack.append(_Item(mark=True))
        elif name in OTHERS:
            raise Foreign(f"the pickle contains the instruction {name}, which is not allowed")
        else:
            removed = list(opcode.stack_before)
            if pickletools.markobject in removed:
                _above_mark(stack)
                removed = removed[: removed.index(pickletools.markobject)]
            size = sum(stack.pop().size for _ in removed)
            stack += [_Item(min(1 + size, HIGHEST)) for _ in opcode.stack_after]


def instructions(pickled: Any) -> Iterator[tuple[pickletools.OpcodeInfo, Any, int | None]]:
    """Yield the instructions of one pickle, as `pickletools.genops` does.

    Raises:
        ValueError: The pickle has more than MOST_INSTRUCTIONS instructions, which would take seconds.
    """
    for number, instruction in enumerate(pickletools.genops(pickled)):
        if number == MOST_INSTRUCTIONS:
            raise ValueError(
                f"the pickle has more than {MOST_INSTRUCTIONS} instructions, which is not allowed"
            )
        yield instruction


def _above_mark(stack: list[_Item]) -> list[_Item]:
    """Remove the last mark and the items above it from the stack, and return those items."""
    index = len(stack) - 1
    while not stack[index].mark:
        index -= 1
        if index < 0:
            raise ValueError("the pickle is damaged: it lacks a mark that one of its instructions needs")
    items = stack[index + 1 :]
    del stack[index:]
    return items


def _whole_number(digits: str) -> int:
    """Return the integer that a JSON or YAML file contains as `digits`; refuse one that no float represents."""
    number = int(digits)
    if abs(number) > sys.float_info.max:
        raise ValueError(
            f"the file contains an integer of {len(digits)} digits, but numbers up to {sys.float_info.max:.2g} are "
            "required"
        )
    return number


def _content(file: Path, most: int) -> bytes:
    content = read_bytes(file)
    if len(content) > most:
        raise ValueError(f"the file has {len(content)} bytes, but at most {most} are read")
    return content
