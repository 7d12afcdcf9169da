"""Names and shares of the classes in a user's data: faults are refused, and what may mislead is reported."""

import math
import unicodedata
from collections.abc import Callable, Hashable, Iterable, Sequence

import numpy as np
from jaxtyping import Int

from framework.errors import DataError, quote, shorten
from framework.storage.text import INVISIBLE, parse_number

DOMINANT = 0.9
"""Smallest share of one class in the test split at which the share is reported."""


def compare_classes(names: Iterable[str], place: str) -> tuple[str, ...]:
    """Return a remark about classes whose names differ only in capital letters; () if there are none.

    Args:
        names: names of the classes.
        place: the file, column or folder that names them, for the message.

    Raises:
        DataError: two names look the same, but differ in composed and decomposed letters, in invisible characters or in
            blanks, so that they would be two classes; or two names are the same number in different notation.
    """
    different = sorted(set(names))
    alike = _first_equal(different, _as_seen)
    if alike:
        raise DataError(
            f"{place}: The classes {alike[0]!a} and {alike[1]!a} look the same ({quote(_as_seen(alike[0]))}), but "
            "their characters differ, so they would be two classes. Write the name in the same way everywhere."
        )
    equal = _first_equal(different, _as_number)
    if equal:
        raise DataError(
            f"{place}: The classes {quote(equal[0])} and {quote(equal[1])} are the same number. Write each class in "
            "the same way everywhere."
        )
    similar = _first_equal(different, str.casefold)
    if not similar:
        return ()
    return (
        f"the classes {shorten(' and '.join(map(quote, similar)))} differ only in capital letters and are different "
        "classes; write them in the same way to make them one class",
    )


def describe_dominant(classes: Sequence[str], tested: Int[np.ndarray, "samples"]) -> tuple[str, ...]:
    """Return a remark about a class that has at least the share DOMINANT of the test split; () if none has.

    The accuracy is then high for a model that learned nothing, and a prediction set that is right on average may leave
    out every other class.

    Args:
        classes: names of the classes.
        tested: index of the class of each test sample.
    """
    counts = np.bincount(tested, minlength=len(classes))
    most = int(counts.argmax())
    if len(tested) in (0, counts[most]) or counts[most] < DOMINANT * len(tested):
        return ()
    return (
        f"{counts[most]} of {len(tested)} test samples have the class {quote(classes[most])}: a model that always "
        f"predicts it has the accuracy {counts[most] / len(tested):.4g}. Compare the accuracy with this number, or "
        "state what each error costs (metric=[decision_cost])",
    )


def _as_seen(name: str) -> str:
    """Return a name with composed letters (NFC), single blanks and no invisible characters."""
    composed = unicodedata.normalize("NFC", name)
    return " ".join("".join(letter for letter in composed if letter not in INVISIBLE).split())


def _as_number(name: str) -> float | str:
    """Return the finite number that a name represents, or the name itself."""
    number = parse_number(name)
    return name if number is None or not math.isfinite(number) else number


def _first_equal(names: Iterable[str], key: Callable[[str], Hashable]) -> tuple[str, str] | None:
    """Return the first two names for which `key` returns the same; None if there are none."""
    first: dict[Hashable, str] = {}
    for name in names:
        if first.setdefault(key(name), name) != name:
            return first[key(name)], name
    return None
