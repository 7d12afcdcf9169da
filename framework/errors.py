"""The errors a user can cause; each message says what came, what was wanted and what to do."""

import re
from collections.abc import Iterable
from difflib import SequenceMatcher, get_close_matches
from itertools import islice


class UserError(Exception):
    """Something the user can mend. Printed as a sentence, without a stack trace.

    What steers a terminal is written out: a message may quote a file of somebody else.

    One that is raised in a worker of a `DataLoader` torch raises anew, of the same class, with the worker's stack trace
    for a message: of that the sentence alone is kept.
    """

    def __init__(self, *said: object) -> None:
        super().__init__(
            *(printable(_sentence(one, type(self))) if isinstance(one, str) else one for one in said)
        )


def printable(text: str, kept: str = "\n\t") -> str:
    """Return a text in which nothing steers a terminal: other letters than the `kept` are written out."""
    return "".join(
        letter if letter.isprintable() or letter in kept else repr(letter)[1:-1] for letter in encodable(text)
    )


def encodable(text: str) -> str:
    r"""Return a text whose bytes that are not UTF-8, as in names of files, are written out as \xe9.

    Python stands for each of them by a lone surrogate (PEP 383), which no text file, font or database takes.
    """
    return re.sub("[\ud800-\udfff]", _written_out, text)


def _written_out(letter: re.Match[str]) -> str:
    number = ord(letter[0])
    return f"\\x{number - 0xDC00:02x}" if 0xDC80 <= number <= 0xDCFF else f"\\u{number:04x}"


def _sentence(said: str, kind: type[UserError]) -> str:
    """What the error said, out of the text that `torch._utils.ExceptionWrapper` makes of it."""
    if not re.match(r"Caught \w+ in .*\.\nOriginal Traceback \(most recent call last\):\n", said):
        return said
    # an error that was raised from another comes after that one's trace
    between = r"\n\n(?:The above|During handling of the above) exception,? .*:\n\n(?=Traceback )"
    trace = re.split(between, said)[-1].removesuffix("\n")
    # every line before the sentence is indented; that of a class of a script names no module
    name = rf"(?:{re.escape(kind.__module__)}\.)?{re.escape(kind.__qualname__)}"
    found = re.search(rf"^{name}(?:: (.*))?\Z", trace, re.DOTALL | re.MULTILINE)
    return (found[1] or "") if found else said


class ConfigError(UserError):
    """A config names or holds something that does not exist or is out of range."""


class DataError(UserError):
    """Data on disk is missing, unreadable or wrong."""


class CheckpointError(UserError):
    """A checkpoint is damaged, belongs to another model, or finds no room on the disk."""


class NonFiniteLoss(UserError):
    """The training loss became NaN or infinite; raised before the optimiser steps."""


class NonFiniteAnswer(ValueError):
    """Numbers that a network gives a density head hold NaN or infinity."""


def shown(damage: object, most: int = 200) -> str:
    """What a file holds, or what a library says of it, for a message: cut, and without what steers a terminal."""
    text = " ".join(line.strip() for line in str(damage).splitlines())
    text = text if len(text) <= most else text[: most - 1] + "…"
    return printable(text, kept="")


def quoted(damage: object) -> str:
    """The same in quotation marks."""
    return shown(repr(damage))


LIKE = 0.65
"""Least likeness of a name that is suggested: 'resnet' and 'unet' have 0.6, 'mpl' and 'mlp' 0.67."""
LISTED_WHOLE, LISTED = 24, 8
"""Most names that a message lists, and how many it lists of more."""


def nearest(word: str, known: Iterable[str], likeness: float = LIKE) -> str | None:
    """Return the name like `word`, if there is one.

    'lr' is like learning_rate, and 'moons' like moons/everything.
    """
    word, names = shown(word), list(islice(known, 1000))
    near = get_close_matches(word, names, n=1, cutoff=likeness)
    near = near or [name for name in names if "".join(piece[:1] for piece in name.split("_")) == word]
    near = near or [name for name in names if name.startswith((f"{word.rstrip('/')}/", f"{word}_"))]
    return near[0] if near else None


def listed(word: str, known: Iterable[str]) -> str:
    """Return all names, or of many the nearest to `word` and how many more there are."""
    names = list(known)
    if len(names) <= LISTED_WHOLE:
        return ", ".join(names)
    matcher = SequenceMatcher(None, b=shown(word))

    def likeness(name: str) -> float:
        matcher.set_seq1(name[:200])
        return matcher.ratio()

    near = sorted(names[:1000], key=likeness, reverse=True)[:LISTED]
    return f"{', '.join(near)} and {len(names) - LISTED} more"


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """' Did you mean ...?' with a leading space, or nothing where nothing is near."""
    near = nearest(word, known)
    return f" Did you mean {quoted(near)}?" if near else ""
