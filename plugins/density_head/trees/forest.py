"""A forest in flat arrays, and the compiled functions that walk through its trees without scikit-learn.

Arrays:
    feature: (node,) int32, the feature that a node compares; -1 at a leaf.
    threshold: (node,) float32; samples whose feature is at most the threshold go left.
    branch: (node, 2) int32, the left and the right child of a node; at a leaf, the number of the leaf, twice.
    root: (tree,) int32, the root node of each tree.

Tests switch on type checks, which would wrap a function before it is compiled; `no_type_check` prevents that.
"""

from pathlib import Path
from typing import no_type_check

import numpy as np

from framework.storage.kernels import compiler, kernel_cache

compiled = compiler(kernel_cache("forest", [Path(__file__)]))


def at_most(threshold: np.ndarray) -> np.ndarray:
    """Return the largest float32 that is at most each float64 in `threshold`.

    A float32 feature is at most the result if and only if it is at most the threshold.
    """
    rounded = threshold.astype(np.float32)
    return np.where(rounded > threshold, np.nextafter(rounded, np.float32(-np.inf)), rounded)


@compiled
@no_type_check
def leaves(samples, feature, threshold, branch, root):
    """Return the leaf of each sample in each tree, (tree, sample) int32.

    Args:
        samples: (sample, feature) float32.
        feature: (node,) int32, the feature that a node compares; -1 at a leaf.
        threshold: (node,) float32; samples whose feature is at most the threshold go left.
        branch: (node, 2) int32, the left and the right child of a node; at a leaf, the number of the leaf, twice.
        root: (tree,) int32, the root node of each tree.
    """
    leaf = np.empty((len(root), len(samples)), np.int32)
    for tree in range(len(root)):
        for sample in range(len(samples)):
            node = root[tree]
            while feature[node] >= 0:
                side = 0 if samples[sample, feature[node]] <= threshold[node] else 1
                node = branch[node, side]
            leaf[tree, sample] = branch[node, 0]
    return leaf


@compiled
@no_type_check
def frequencies(leaf, start, label, count, classes):
    """Return the share of each class in a sample's leaves, averaged over the trees, (sample, class) float64.

    Args:
        leaf: (tree, sample), the leaf of each sample in each tree.
        start: (leaf + 1,), index of the first entry of each leaf, then the number of entries.
        label: (entry,), the class of each entry.
        count: (entry,), the number of training samples of that class in the leaf.
        classes: number of classes.
    """
    trees, samples = leaf.shape
    total_share = np.zeros((samples, classes))
    for tree in range(trees):
        for sample in range(samples):
            at = leaf[tree, sample]
            total = 0
            for entry in range(start[at], start[at + 1]):
                total += count[entry]
            for entry in range(start[at], start[at + 1]):
                total_share[sample, label[entry]] += count[entry] / total
    return total_share / trees
