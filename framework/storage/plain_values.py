"""Reads JSON and YAML files, a run's or a stranger's: plain values only, and no more of them than the file has."""

import json
from pathlib import Path
from typing import Any

import yaml

from framework.errors import DataError, UserError
from framework.storage.reading import RESTORE, guarded, read_bytes

LARGEST_JSON, LARGEST_YAML = 2**24, 2**17
"""Bytes."""
DEEPEST = 64


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


def _content(file: Path, most: int) -> bytes:
    found = read_bytes(file)
    if len(found) > most:
        raise ValueError(f"{len(found)} bytes; at most {most}")
    return found
