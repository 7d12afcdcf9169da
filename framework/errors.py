"""Errors that a user can cause; each message says what the framework got, what it requires and what to do."""

import re
from collections.abc import Iterable
from difflib import SequenceMatcher, get_close_matches
from itertools import islice


class UserError(Exception):
    """An error that the user can correct. Its message is printed without a stack trace.

    Characters that control a terminal are escaped, because a message may quote a file of another person.

    If a worker of a `DataLoader` raises such an error, torch raises a new error of the same class whose message is the
    worker's stack trace. The constructor then keeps only the original message.
    """

    def __init__(self, *arguments: object) -> None:
        super().__init__(
            *(
                escape_unprintable(_sentence(argument, type(self))) if isinstance(argument, str) else argument
                for argument in arguments
            )
        )


def escape_unprintable(text: str, allowed: str = "\n\t") -> str:
    """Return `text` with unprintable characters escaped, except those in `allowed`, so that it controls no terminal."""
    return "".join(
        letter if letter.isprintable() or letter in allowed else repr(letter)[1:-1]
        for letter in escape_undecodable(text)
    )


def escape_undecodable(text: str) -> str:
    r"""Return a text in which bytes that are not UTF-8, as in names of files, are escaped as \xe9.

    Python represents each of these bytes by a lone surrogate (PEP 383), which no text file, font or database accepts.
    """
    return re.sub("[\ud800-\udfff]", _written_out, text)


def _written_out(letter: re.Match[str]) -> str:
    number = ord(letter[0])
    return f"\\x{number - 0xDC00:02x}" if 0xDC80 <= number <= 0xDCFF else f"\\u{number:04x}"


def _sentence(message: str, kind: type[UserError]) -> str:
    """Return the message of an error of class `kind`, given the text that torch's `ExceptionWrapper` makes of it."""
    if not re.match(r"Caught \w+ in .*\.\nOriginal Traceback \(most recent call last\):\n", message):
        return message
    # The trace of an error that was raised from another one follows the other's trace.
    between = r"\n\n(?:The above|During handling of the above) exception,? .*:\n\n(?=Traceback )"
    trace = re.split(between, message)[-1].removesuffix("\n")
    # Every line before the sentence is indented. The line of a class defined in a script names no module.
    name = rf"(?:{re.escape(kind.__module__)}\.)?{re.escape(kind.__qualname__)}"
    match = re.search(rf"^{name}(?:: (.*))?\Z", trace, re.DOTALL | re.MULTILINE)
    return (match[1] or "") if match else message


class ConfigError(UserError):
    """Error for a config that names something that does not exist, or holds a value out of range."""


class DataError(UserError):
    """Error for data on disk that is missing, unreadable or wrong."""


class CheckpointError(UserError):
    """Error for a checkpoint that is damaged, belongs to another model, or does not fit on the disk."""


class NonFiniteLoss(UserError):
    """Error for a training loss that became NaN or infinite; raised before the optimiser steps."""


class NonFiniteParameters(ValueError):
    """Error for NaN or infinity in the raw parameters that a network gives to a density head."""


def shorten(content: object, limit: int = 200) -> str:
    """Return the content of a file, or the message of a library, as a short text for an error message.

    The text is shortened to `limit` characters, and characters that control a terminal are escaped.
    """
    text = " ".join(line.strip() for line in str(content).splitlines())
    text = text if len(text) <= limit else text[: limit - 1] + "…"
    return escape_unprintable(text, allowed="")


def quote(content: object) -> str:
    """Return the representation of an object, shortened as by `shorten`, for an error message."""
    return shorten(repr(content))


LEAST_SIMILARITY = 0.65
"""Smallest similarity of a name that is suggested: 'resnet' and 'unet' have 0.6, 'mpl' and 'mlp' 0.67."""
LISTED_WHOLE, LISTED = 24, 8
"""Largest number of names that a message lists in full, and the number of names that it lists if there are more."""


def count_of(number: int, noun: str) -> str:
    """Return a number with its noun in the singular or plural, such as "1 file" or "3 test files".

    Args:
        number: the number.
        noun: the noun in the singular, which takes an "s" in the plural; words may stand before it.
    """
    return f"{number} {noun}{'' if number == 1 else 's'}"


def significant(value: float, digits: int, *, sign: bool = False) -> str:
    """Return a number with significant digits, such as "0.0123"; below a million it has no exponent, such as "1234".

    Args:
        value: the number.
        digits: number of significant digits; more are returned for a number with more digits before the point.
        sign: whether a positive number gets a plus sign.
    """
    text = f"{value:{'+' if sign else ''}.{digits}g}"
    return f"{value:{'+' if sign else ''}.0f}" if "e+" in text and abs(value) < 1e6 else text


def nearest_name(word: str, known: Iterable[str], likeness: float = LEAST_SIMILARITY) -> str | None:
    """Return the name most similar to `word`, or None if no name is similar.

    'lr' is similar to learning_rate, 'moons' to moons/everything, and 'BMI' to bmi.

    Args:
        word: word that is not the name of anything.
        known: names to choose from.
        likeness: smallest similarity of two words, from 0 to 1 (`difflib.SequenceMatcher.ratio`).
    """
    word, names = shorten(word), list(islice(known, 1000))
    near = [name for name in names if name.casefold() == word.casefold()]
    near = near or get_close_matches(word, names, n=1, cutoff=likeness)
    near = near or [name for name in names if "".join(piece[:1] for piece in name.split("_")) == word]
    near = near or [name for name in names if name.startswith((f"{word.rstrip('/')}/", f"{word}_"))]
    return near[0] if near else None


def list_names(word: str, known: Iterable[str]) -> str:
    """Return the names in `known` as a text.

    If there are more than LISTED_WHOLE, the text holds only the LISTED names most similar to `word`, and the number of
    the remaining names.
    """
    names = list(known)
    if len(names) <= LISTED_WHOLE:
        return ", ".join(names)
    matcher = SequenceMatcher(None, b=shorten(word))

    def likeness(name: str) -> float:
        matcher.set_seq1(name[:200])
        return matcher.ratio()

    near = sorted(names[:1000], key=likeness, reverse=True)[:LISTED]
    return f"{', '.join(near)} and {len(names) - LISTED} more"


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return ' Did you mean ...?' with the name in `known` most similar to `word`, or "" if no name is similar.

    The text begins with a space, so that it can be appended to a message.
    """
    near = nearest_name(word, known)
    return f" Did you mean {quote(near)}?" if near else ""
