"""Random choice of held-out samples and of folds, with equal shares of every class."""

import numpy as np
from jaxtyping import Bool, Int


def spared(
    labels: Int[np.ndarray, "samples"], share: float, random: np.random.Generator
) -> Bool[np.ndarray, "samples"]:
    """Return which samples to hold out: `share` of all, equal in every class, but never the last sample of a class.

    Each class gives the whole part of its share; classes with the largest remainders give one more each, until the
    total is reached.
    """
    held = np.zeros(len(labels), bool)
    counts = np.bincount(labels) if len(labels) else np.zeros(1, np.int64)
    wanted = share * counts
    give = np.minimum(np.floor(wanted).astype(np.int64), np.maximum(counts - 1, 0))
    rest = np.where(counts - give > 1, wanted - give, -1.0)
    missing = round(share * len(labels)) - int(give.sum())
    for label in np.lexsort([random.random(len(counts)), -rest])[: max(missing, 0)]:
        give[label] += rest[label] > 0
    for label, number in enumerate(give):
        held[random.permutation(np.flatnonzero(labels == label))[:number]] = True
    return held


def folds(
    labels: Int[np.ndarray, "samples"], count: int, random: np.random.Generator
) -> Int[np.ndarray, "samples"]:
    """Return the fold of each sample; classes are dealt out in turn, so folds differ by at most one sample of each."""
    order = np.concatenate(
        [random.permutation(np.flatnonzero(labels == label)) for label in np.unique(labels)]
    )
    fold = np.empty(len(labels), np.int64)
    fold[order] = np.arange(len(labels)) % count
    return fold
