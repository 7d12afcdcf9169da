"""Random choice of held-out samples and of folds, with equal shares of every class."""

import numpy as np
from jaxtyping import Bool, Int


def choose_held_out(
    labels: Int[np.ndarray, "samples"], share: float, random: np.random.Generator
) -> Bool[np.ndarray, "samples"]:
    """Return which samples to hold out: a share of all samples, equal in every class, but never all of a class.

    From each class, `share` times its size is held out, rounded down. Then one more sample is held out from each of the
    classes with the largest remainders, until the total is reached.
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
