r"""Conversion of file names to text, in which bytes that are not UTF-8 are escaped, and back.

A file name on Linux consists of arbitrary bytes; a name from an old archive may be Latin-1. Python represents a byte
that is not UTF-8 by a lone surrogate, which no text file, font or database accepts.
"""

import os
import re
from pathlib import Path

from framework.errors import escape_undecodable

_UNSAFE = re.compile("[\ud800-\udfff\x00-\x1f\x7f]")


def spell_name(name: str | os.PathLike[str]) -> str:
    r"""Return the name of a file as one line of text, from which `path_of` recovers the name.

    Bytes that are not UTF-8, line ends and terminal control characters are escaped, for example as \xe9. If a name
    contains one of them or the characters \x, its backslashes are doubled.
    """
    text = os.fspath(name)
    if "\\x" not in text and not _UNSAFE.search(text):
        return text
    doubled = text.replace("\\", "\\\\")
    return escape_undecodable(re.sub(r"[\x00-\x1f\x7f]", lambda letter: f"\\x{ord(letter[0]):02x}", doubled))


def path_of(spelling: str) -> Path:
    """Return the path for which `spell_name` returned the text `spelling`."""
    if "\\x" not in spelling:
        return Path(spelling)
    name = re.sub(rb"\\(\\|x([0-9a-f]{2}))", _read, os.fsencode(spelling))
    return Path(os.fsdecode(name))


def is_within(name: str) -> bool:
    """Return whether a path from a list or table stays in the data folder: it is relative and has no part "..".

    Callers refuse other paths, because a list from another person could name private images, which the figures of a
    run would show.
    """
    return not name.startswith("/") and ".." not in name.split("/")


def as_bytes(name: str | os.PathLike[str]) -> bytes:
    """Return a file's name as bytes for hashing: UTF-8, and different for different names."""
    return os.fspath(name).encode("utf-8", "surrogatepass")


def _read(escape: re.Match[bytes]) -> bytes:
    return bytes([int(escape[2], 16)]) if escape[2] else b"\\"
