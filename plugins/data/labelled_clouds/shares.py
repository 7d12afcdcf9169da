"""Draws which samples are held out, and which fold each belongs to, of every class alike."""

import numpy as np
from jaxtyping import Bool, Int


def spared(
    labels: Int[np.ndarray, "samples"], share: float, random: np.random.Generator
) -> Bool[np.ndarray, "samples"]:
    """Which samples to hold out: `share` of all, of every class alike, but never the last of a class.

    Classes give their whole parts, and those with the largest rests one more each, until the number is reached.
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
    """The fold of each sample: every class is dealt out in turn, so that folds differ by at most one of each."""
    order = np.concatenate(
        [random.permutation(np.flatnonzero(labels == label)) for label in np.unique(labels)]
    )
    fold = np.empty(len(labels), np.int64)
    fold[order] = np.arange(len(labels)) % count
    return fold
