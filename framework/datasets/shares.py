"""Random choice of splits and of folds, with equal shares of every class."""

import numpy as np
from jaxtyping import Bool, Int
from numpy.typing import NDArray

from framework.errors import DataError


def choose_held_out(
    labels: Int[np.ndarray, "samples"], share: float, random: np.random.Generator
) -> Bool[np.ndarray, "samples"]:
    """Return which samples to hold out: a share of all samples, equal in every class, but never all of a class.

    From each class, `share` times its size is held out, rounded down. Then one more sample is held out from each of the
    classes with the largest remainders, until `share` times the number of all samples is reached.
    """
    held_out = np.zeros(len(labels), bool)
    counts = np.bincount(labels) if len(labels) else np.zeros(1, np.int64)
    exact = share * counts
    number = np.minimum(np.floor(exact).astype(np.int64), np.maximum(counts - 1, 0))
    remainder = np.where(counts - number > 1, exact - number, -1.0)
    missing = round(share * len(labels)) - int(number.sum())
    for label in np.lexsort([random.random(len(counts)), -remainder])[: max(missing, 0)]:
        number[label] += remainder[label] > 0
    for label, size in enumerate(number):
        held_out[random.permutation(np.flatnonzero(labels == label))[:size]] = True
    return held_out


def assign_folds(
    labels: Int[np.ndarray, "samples"], count: int, random: np.random.Generator
) -> Int[np.ndarray, "samples"]:
    """Return the fold of each sample; the number of samples of a class differs by at most one between folds."""
    order = np.concatenate(
        [random.permutation(np.flatnonzero(labels == label)) for label in np.unique(labels)]
    )
    fold = np.empty(len(labels), np.int64)
    fold[order] = np.arange(len(labels)) % count
    return fold


def hold_out(
    splits: NDArray,
    labels: Int[np.ndarray, "samples"],
    share: float,
    random: np.random.Generator,
    name: str = "validation",
) -> None:
    """Move a share of the training samples, equal in every class, to the split `name`; `splits` is changed in place."""
    training = np.flatnonzero(splits == "train")
    splits[training[choose_held_out(labels[training], share, random)]] = name


def check_shares(validation: float, test: float) -> None:
    """Check that shares for validation and test leave samples for training, unless `test` is 1 (all files are tested).

    Raises:
        DataError: The sum of the shares is 1 or more.
    """
    if test < 1 <= validation + test:
        raise DataError(
            f"data.validation + data.test = {validation + test:g}, but the sum must be less than 1 to leave files "
            "for training. Reduce one of them."
        )


def choose_splits(
    splits: NDArray,
    labels: Int[np.ndarray, "samples"],
    validation: float,
    test: float,
    random: np.random.Generator,
) -> NDArray:
    """Return the split of every sample, chosen at random where none is given.

    Args:
        splits: Split of each sample; "" if the sample has none yet.
        labels: Class of each sample.
        validation: Share for validation: of the samples without a split or, if all samples have one, of the training
            samples. It is not used if `splits` contains "validation".
        test: Share for the test, of the samples without a split.
        random: Generator of the choice.
    """
    chosen = np.where(splits == "", "train", splits)
    if "" in splits:
        hold_out(chosen, labels, test, random, "test")
        validation /= 1 - test  # as a share of the files that are not for the test
    if "validation" not in splits and validation:
        hold_out(chosen, labels, validation, random)
    return chosen
