"""Reads JSON and YAML files, a run's or a stranger's: plain values only, and no more of them than the file has."""

import json
import pickletools
from pathlib import Path
from typing import Any

import yaml

from framework.errors import DataError, UserError
from framework.storage.reading import RESTORE, guarded, read_bytes

LARGEST_JSON, LARGEST_YAML = 2**24, 2**17
"""Bytes."""
DEEPEST, MOST_ITEMS = 64, 100_000


def read_json(file: Path, wanted: str, remedy: str = RESTORE) -> dict[str, Any]:
    """The object in a file.

    Raises:
        DataError: it is missing, damaged, or holds something else; says that `wanted` was.
    """
    with guarded(file, wanted, remedy):
        found = json.loads(_content(file, LARGEST_JSON))
        if not isinstance(found, dict):
            raise ValueError(f"it holds {type(found).__name__}")
        return found


def read_yaml(file: Path, wanted: str, remedy: str = RESTORE, error: type[UserError] = DataError) -> Any:
    """The values in a file.

    Raises:
        error: it is missing or damaged, has a tag that stands for an object, or an alias: of these a few lines could
            stand for more values than any memory holds.
    """
    with guarded(file, wanted, remedy, kind=error):
        text = _content(file, LARGEST_YAML).decode("utf-8")
        depth = 0
        for event in yaml.parse(text, yaml.SafeLoader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > DEEPEST or isinstance(event, yaml.AliasEvent):
                raise ValueError(f"an alias, or values more than {DEEPEST} deep in others")
        return yaml.safe_load(text)


def require_flat(pickled: bytes) -> None:
    """Refuse a pickle whose tuples hold the same tuple again and again: as a key such a one is hashed for ever.

    Raises:
        ValueError: one stands for more than MOST_ITEMS values, or the pickle is damaged.
    """
    stack: list[int] = []  # how many values each item stands for; 0: a mark
    memo: dict[int, int] = {}
    for opcode, argument, _ in pickletools.genops(pickled):
        if "PUT" in opcode.name or opcode.name == "MEMOIZE":
            memo[len(memo) if argument is None else int(argument)] = stack[-1]
        elif "GET" in opcode.name:
            stack.append(memo[int(argument or 0)])
        elif opcode.name == "MARK":
            stack.append(0)
        else:
            taken = opcode.stack_before
            size = 0
            if pickletools.markobject in taken:
                while stack[-1]:
                    size += stack.pop()
                stack.pop()
                taken = taken[: taken.index(pickletools.markobject)]
            size += sum(stack.pop() for _ in taken)
            stack += [1 + size if "TUPLE" in opcode.name else 1] * len(opcode.stack_after)
            if (size > MOST_ITEMS and "TUPLE" in opcode.name) or opcode.name == "DUP":
                raise ValueError(f"a tuple that stands for more than {MOST_ITEMS} values")


def _content(file: Path, most: int) -> bytes:
    found = read_bytes(file)
    if len(found) > most:
        raise ValueError(f"{len(found)} bytes; at most {most}")
    return found
