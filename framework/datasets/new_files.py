"""Test of a trained model on further labelled files: the choice of the files that are tested, and their classes."""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray
from pydantic import Field

from framework.errors import DataError, did_you_mean, quote, shorten

TestShare = Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)]
"""Share of the files for the test; 1 tests a trained model on all files of a further folder."""
EXCERPT = 4096
"""Number of bytes from the middle of each file that `hash_files` reads."""


class Trained(NamedTuple):
    """Description of the files on which a model was trained, which the model stores.

    Attributes:
        content: Hash of these files; "" if an older version stored the model.
        classes: Names of the classes in the order of the labels; () if the files have none, or an older version stored
            the model.
    """

    content: str = ""
    classes: tuple[str, ...] = ()

    def state(self) -> dict[str, Any]:
        """Return the state for `Data.state_dict`."""
        fields = {"content": self.content, "classes": list(self.classes)}
        return {name: value for name, value in fields.items() if value}


def restore_trained(state: Mapping[str, Any], name: str) -> Trained:
    """Return the description that `Trained.state` stored.

    Args:
        state: The state.
        name: Name of the data set, for the message.

    Raises:
        DataError: The state holds something else.
    """
    content, classes = state.get("content", ""), state.get("classes", [])
    are_names = isinstance(classes, list | tuple) and all(isinstance(label, str) for label in classes)
    if not isinstance(content, str) or not are_names or set(state) - {"content", "classes"}:
        raise DataError(
            f"The stored state of {name} must hold a hash and the names of the classes, but holds something else. Load "
            "another checkpoint, or train the model again."
        )
    return Trained(content, tuple(classes))


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
    count = int((chosen == "test").sum())
    if count == len(chosen):
        return ()
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
