r"""File names as text: what they hold beside UTF-8 is written out.

On Linux a name is any bytes; one of an old archive may be Latin-1. Python stands for such a byte by a lone surrogate,
which no text file, font or database takes.
"""

import os
import re
from pathlib import Path

from framework.errors import encodable

_UNSAFE = re.compile("[\ud800-\udfff\x00-\x1f\x7f]")


def spelled(name: str | os.PathLike[str]) -> str:
    r"""Return the name of a file as one line of text, from which `path_of` finds the name again.

    Bytes that are not UTF-8, and those that end lines or steer terminals, are written out as \xe9. Where a name holds
    any of them, or \x itself, its backslashes are doubled.
    """
    text = os.fspath(name)
    if "\\x" not in text and not _UNSAFE.search(text):
        return text
    doubled = text.replace("\\", "\\\\")
    return encodable(re.sub(r"[\x00-\x1f\x7f]", lambda letter: f"\\x{ord(letter[0]):02x}", doubled))


def path_of(spelling: str) -> Path:
    """Return the path that `spelled` made a text of."""
    if "\\x" not in spelling:
        return Path(spelling)
    name = re.sub(rb"\\(\\|x([0-9a-f]{2}))", _read, os.fsencode(spelling))
    return Path(os.fsdecode(name))


def as_bytes(name: str | os.PathLike[str]) -> bytes:
    """Return a file's name in bytes that tell it from others, UTF-8 where it is text: for what hashes names."""
    return os.fspath(name).encode("utf-8", "surrogatepass")


def _read(escape: re.Match[bytes]) -> bytes:
    return bytes([int(escape[2], 16)]) if escape[2] else b"\\"
