"""Messages of errors, which stay unchanged wherever the error is raised."""

import math
import pickle
import re
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from framework import errors
from framework.errors import (
    CheckpointError,
    ConfigError,
    DataError,
    NonFiniteLoss,
    UserError,
    count_of,
    significant,
)


class OfAPlugin(DataError):
    """Error class that a third party has derived."""


KINDS = [UserError, ConfigError, DataError, CheckpointError, NonFiniteLoss, OfAPlugin]
QUOTED = """The job ended with
Traceback (most recent call last):
  File "job.py", line 1, in <module>
framework.errors.DataError: another one
Mend it."""
SENTENCES = {
    "one line": "a.csv: the column 'x' is missing. Wanted x, y.",
    "several lines": "a.csv is damaged:\n  line 3: no number\n\n  line 4: nothing\nWrite it again.",
    "an end of line": "Two lines,\nthe second ended.\n",
    "a trace": QUOTED,
    "a colon": "framework.errors.DataError: said twice",
    "nothing": "",
}
RAISED: dict[str, Callable[[UserError], None]] = {}


def raised(way: Callable[[UserError], None]) -> Callable[[UserError], None]:
    RAISED[way.__name__] = way
    return way


@raised
def alone(error: UserError) -> None:
    raise error


@raised
def of_another(error: UserError) -> None:
    try:
        raise ValueError("beneath\nit")
    except ValueError as cause:
        raise error from cause


@raised
def of_its_own_kind(error: UserError) -> None:
    try:
        raise type(error)("of the inner one")
    except UserError as cause:
        raise error from cause


@raised
def while_another_was_handled(error: UserError) -> None:
    try:
        raise KeyError("beneath")
    except KeyError:
        raise error  # noqa: B904


@raised
def instead_of_another(error: UserError) -> None:
    try:
        raise KeyError("beneath")
    except KeyError:
        raise error from None


class Failing(Dataset):
    """Data set that fails at every item, each time with another error."""

    def __init__(self, cases: list[tuple[type[UserError], str, str]]) -> None:
        self.cases = cases

    def __len__(self) -> int:
        return len(self.cases)

    def __getitem__(self, index: int) -> torch.Tensor:
        kind, said, way = self.cases[index]
        RAISED[way](kind(said))
        return torch.zeros(1)


CASES = [(kind, said, way) for kind in KINDS for said in SENTENCES.values() for way in RAISED]


def test_every_subclass_is_among_them() -> None:
    own = {one for one in vars(errors).values() if isinstance(one, type) and issubclass(one, UserError)}
    assert own <= {*KINDS}


def test_what_a_worker_says_is_what_arrives() -> None:
    batches = iter(DataLoader(Failing(CASES), batch_size=1, num_workers=1))
    for kind, said, way in CASES:
        with pytest.raises(UserError) as caught:
            next(batches)
        assert type(caught.value) is kind
        assert str(caught.value) == said, (kind, way)


@pytest.mark.parametrize(
    "said",
    [
        *SENTENCES.values(),
        "Caught ConfigError in DataLoader worker process 0.",
        "Caught ConfigError in DataLoader worker process 0.\nOriginal Traceback (most recent call last):\n  cut off",
    ],
)
@pytest.mark.parametrize("kind", KINDS)
def test_any_other_text_is_kept(kind: type[UserError], said: str) -> None:
    assert str(kind(said)) == str(pickle.loads(pickle.dumps(kind(said)))) == said
    assert kind(said, 3).args == (said, 3)
    assert not re.search(".", str(kind()))


@pytest.mark.parametrize(
    ("number", "expected"), [(0, "0 files"), (1, "1 file"), (2, "2 files"), (1000, "1000 files")]
)
def test_a_count_has_a_noun_in_the_right_number(number: int, expected: str) -> None:
    assert count_of(number, "file") == expected


@pytest.mark.parametrize(
    ("value", "digits", "expected"),
    [
        (0.0, 2, "0"),
        (0.01234, 3, "0.0123"),
        (12.34, 3, "12.3"),
        (99.4, 2, "99"),
        (99.96, 2, "100"),
        (184.7, 2, "185"),
        (-1234.5, 3, "-1234"),
        (999_999.4, 4, "999999"),
        (1.5e6, 2, "1.5e+06"),
        (1e-7, 2, "1e-07"),
        (math.inf, 2, "inf"),
        (math.nan, 2, "nan"),
    ],
)
def test_a_number_of_usual_size_has_no_exponent(value: float, digits: int, expected: str) -> None:
    assert significant(value, digits) == expected
    if value > 0:
        assert significant(value, digits, sign=True) == f"+{expected}"


def test_remarks_on_what_is_left_out_have_their_nouns_from_one_function() -> None:
    """A remark such as "left out: {count} files" would say "1 files"."""
    root = Path(__file__).parents[1]
    remark = re.compile(r'"left out[^"{]*: \{(?!count_of)[^}"]*\} (?:\w+ )?\w+s\b')
    sources = [file for folder in ("framework", "plugins") for file in (root / folder).rglob("*.py")]
    wrong = [str(file) for file in sources if remark.search(file.read_text(encoding="utf-8"))]
    assert not wrong, f"{wrong} write a noun in the plural behind a count. Use framework.errors.count_of."
