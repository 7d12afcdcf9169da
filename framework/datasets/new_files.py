"""Test of a trained model on further labelled files: the choice of the files that are tested, and their classes."""

import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int
from numpy.typing import NDArray
from pydantic import Field

from framework.errors import DataError, count_of, did_you_mean, quote, shorten
from framework.storage.reading import open_regular

TestShare = Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)]
"""Share of the files for the test; 1 tests a trained model on all files of a further folder."""
EXCERPT = 4096
"""Number of bytes from the middle of each file that `hash_files` reads, and of each excerpt of `hash_contents`."""
READ_WHOLE, EXCERPTS = 2**16, 8
"""Largest size, in bytes, of a file that `hash_contents` reads as a whole; number of its excerpts of a larger file."""
DIGITS = 16
"""Number of hexadecimal digits of a hash of `hash_contents`."""
LEFT_OUT = "left out"
"""Split of files that are neither trained on nor tested, in the lists of splits that `leave_out_trained` returns."""


class Trained(NamedTuple):
    """Description of the files on which a model was trained, which the model stores.

    Attributes:
        content: Hash of these files; "" if an older version stored the model.
        classes: Names of the classes in the order of the labels; () if the files have none, or an older version stored
            the model.
        files: Hashes (`hash_contents`) of the files for training and validation, in ascending order and without a
            separator; "" if an older version stored the model. Who has a file can thus find out whether the model was
            trained on it.
    """

    content: str = ""
    classes: tuple[str, ...] = ()
    files: str = ""

    @classmethod
    def on(cls, content: str, classes: tuple[str, ...], hashes: Sequence[str], splits: NDArray) -> "Trained":
        """Return the description of files with these hashes and splits."""
        trained_on = {
            text for text, split in zip(hashes, splits, strict=True) if split in ("train", "validation")
        }
        return cls(content, classes, "".join(sorted(trained_on - {""})))

    def state(self) -> dict[str, Any]:
        """Return the state for `Data.state_dict`."""
        fields = {"content": self.content, "classes": list(self.classes), "files": self.files}
        return {name: value for name, value in fields.items() if value}

    def has(self, hashes: Sequence[str]) -> Bool[np.ndarray, "files"]:
        """Return for each file whether the model was trained on a file of the same content."""
        own_hashes = {self.files[start : start + DIGITS] for start in range(0, len(self.files), DIGITS)}
        return np.array([text in own_hashes for text in hashes], bool)


def restore_trained(state: Mapping[str, Any], name: str) -> Trained:
    """Return the description that `Trained.state` stored.

    Args:
        state: The state.
        name: Name of the data set, for the message.

    Raises:
        DataError: The state holds something else.
    """
    content, classes, files = state.get("content", ""), state.get("classes", []), state.get("files", "")
    are_names = isinstance(classes, list | tuple) and all(isinstance(label, str) for label in classes)
    are_hashes = isinstance(content, str) and isinstance(files, str) and len(files) % DIGITS == 0
    if not are_hashes or not are_names or set(state) - set(Trained._fields):
        raise DataError(
            f"The stored state of {name} must hold hashes and the names of the classes, but holds something else. Load "
            "another checkpoint, or train the model again."
        )
    return Trained(content, tuple(classes), files)


def hash_files(root: Path, names: Iterable[str], labels: Iterable[object]) -> str:
    """Return a hash of the names, labels and sizes of files, and of an excerpt of each.

    Args:
        root: Folder to which the names are relative.
        names: Names of the files.
        labels: Label of each file.
    """
    digest = hashlib.sha256()
    for name, label in zip(names, labels, strict=True):
        file = root / name
        size, excerpt = 0, b""
        try:
            if file.is_file():  # a pipe would wait for its writer
                size = file.stat().st_size
                with file.open("rb") as stream:
                    stream.seek(max(0, (size - EXCERPT) // 2))
                    excerpt = stream.read(EXCERPT)
        except OSError:  # the message about reading the file says why
            pass
        digest.update(repr((name, label, size)).encode("utf-8", "surrogateescape") + excerpt)
    return digest.hexdigest()


def hash_contents(files: Iterable[Path]) -> list[str]:
    """Return a hash of the content of each file, whatever its name; "" for a file that cannot be read.

    Of a file above READ_WHOLE bytes, the size and EXCERPTS evenly spread parts are read.
    """
    return [_hash_content(file) for file in files]


def _hash_content(file: Path) -> str:
    try:
        with open_regular(file) as stream:
            size = os.fstat(stream.fileno()).st_size
            digest = hashlib.blake2b(str(size).encode(), digest_size=DIGITS // 2)
            if size <= READ_WHOLE:
                digest.update(stream.read())
            else:
                for number in range(EXCERPTS):
                    stream.seek((size - EXCERPT) * number // (EXCERPTS - 1))
                    digest.update(stream.read(EXCERPT))
    except (OSError, ValueError, DataError):  # the message about reading the file says why
        return ""
    return digest.hexdigest()


def hash_array(array: NDArray) -> str:
    """Return a hash of an array in the form of `hash_contents`, such as of an image in a file of many images."""
    digest = hashlib.blake2b(repr((array.shape, array.dtype.str)).encode(), digest_size=DIGITS // 2)
    digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def leave_out_trained(
    stated: NDArray,
    chosen: NDArray,
    hashes: Sequence[str],
    trained: Trained | None,
    content: str,
    source: Path,
) -> tuple[NDArray, tuple[str, ...]]:
    """Return the splits without test files that the model was trained on, and a remark about such files.

    Files of a further folder are left out of the test if no folder or table states that they are for the test. Files
    that are stated to be for the test remain, and the remark says how many of them the model was trained on. This also
    holds for the folder of the training, in which copies of a file may lie in several splits.

    Args:
        stated: Split of each file; "" if none is stated.
        chosen: Split of each file after the random choice.
        hashes: Hash of each file (`hash_contents`).
        trained: What the trained model stores about its files; None without a trained model, whose files are then those
            for training and validation.
        content: Hash of the files.
        source: Folder or table of the files, for messages.

    Raises:
        DataError: The model was trained on all test files of a further folder.
    """
    known = (trained or Trained.on(content, (), hashes, chosen)).has(hashes) & (chosen == "test")
    if not known.any():
        return chosen, ()
    is_further = trained is not None and trained.content != content
    left_out = known & (np.broadcast_to(stated == "", known.shape) if is_further else False)
    splits = np.where(left_out, LEFT_OUT, chosen.astype("<U10"))
    remarks = ()
    if left_out.any():
        if not (splits == "test").any():
            raise DataError(
                f"{source}: The model was trained on each of the {int(left_out.sum())} files that are to be tested. "
                "Give files that it was not trained on."
            )
        remarks = (
            f"left out of the test: {count_of(int(left_out.sum()), 'file')} that the model was trained on",
        )
    if remaining := int((known & ~left_out).sum()):
        remarks += (
            f"{remaining} of the {int((splits == 'test').sum())} test files have the content of files for training or "
            "validation, so that the errors on them may be too small",
        )
    return splits, remarks


def are_all_for_test(
    splits: NDArray, test: float, trained: Trained | None, content: str, source: Path
) -> bool:
    """Return whether the setting `data.test` makes all files test files.

    Args:
        splits: Split of each file; "" if none is stated.
        test: Value of `data.test`.
        trained: What the trained model stores about its files; None without a trained model.
        content: Hash of the files.
        source: Folder or table of the files, for messages.

    Raises:
        DataError: `test` is 1, but the splits are stated, or there is no model that was trained on other files.
    """
    if test < 1:
        return False
    if splits.size and (splits != "").all():
        raise DataError(
            f"data.test=1 has no effect, because folders, names of files or a column assign the files of {source} to "
            "splits. Leave data.test out."
        )
    if trained is None or trained.content == content:
        which = "the model was trained on these files" if trained else "there is no trained model"
        raise DataError(
            f"{source}: data.test=1 makes all files test files, but {which}. Leave data.test out, or use it with "
            "mode=test, checkpoint=<run folder> and another data.root."
        )
    return True


def describe_tested_share(
    splits: NDArray, chosen: NDArray, trained: Trained | None, content: str, source: Path
) -> tuple[str, ...]:
    """Return a remark if a trained model is tested on a random share of further files, and not on all of them.

    Args:
        splits: Split of each file; "" if none is stated.
        chosen: Split of each file after the random choice.
        trained: What the trained model stores about its files; None without a trained model.
        content: Hash of the files.
        source: Folder or table of the files.
    """
    if trained is None or trained.content in ("", content) or not (splits == "").any():
        return ()
    if np.isin(chosen, ("test", LEFT_OUT)).all():
        return ()
    count = int((chosen == "test").sum())
    return (
        f"{quote(source.name)} does not hold the training files: {count} of its {len(chosen)} files, chosen at random, "
        "are the test split; data.test=1 makes all of them test files",
    )


def index_labels(
    labels: Sequence[str], trained: Trained | None, source: Path
) -> tuple[tuple[str, ...], Int[np.ndarray, "files"]]:
    """Return the names of the classes, and the class of each file as an index into them.

    The classes are those of the trained model; the files need not have all of them. Without a trained model, the
    classes are the labels in alphabetical order.

    Raises:
        DataError: A label is not a class of the trained model.
    """
    present = set(labels)
    classes = trained.classes if trained is not None and trained.classes else tuple(sorted(present))
    unknown = sorted(present - set(classes))
    if unknown:
        raise DataError(
            f"{source}: The model does not know the class {quote(unknown[0])}.{did_you_mean(unknown[0], classes)} Its "
            f"classes are {shorten(', '.join(classes))}. Rename the class to one of them, or leave its files out."
        )
    index = {name: number for number, name in enumerate(classes)}
    return classes, np.array([index[label] for label in labels], dtype=np.int64)
