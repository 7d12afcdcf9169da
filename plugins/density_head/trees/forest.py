"""A forest in flat arrays, and the compiled functions that walk it; nothing here needs the library that grew it.

Arrays:
    feature: (node,) int32, which feature a node asks for; -1 at a leaf.
    threshold: (node,) float32; samples whose feature is at most this go left.
    branch: (node, 2) int32, the nodes to the left and right; at a leaf the number of the leaf, twice.
    root: (tree,) int32, nodes.

`no_type_check` keeps the type checks that tests switch on from wrapping a kernel before it is compiled.
"""

from pathlib import Path
from typing import no_type_check

import numpy as np

from framework.storage.kernels import compiler, kept_in

compiled = compiler(kept_in("forest", [Path(__file__)]))


def at_most(threshold: np.ndarray) -> np.ndarray:
    """The largest float32 that is no larger: a float32 is at most the one where it is at most the other."""
    rounded = threshold.astype(np.float32)
    return np.where(rounded > threshold, np.nextafter(rounded, np.float32(-np.inf)), rounded)


@compiled
@no_type_check
def leaves(samples, feature, threshold, branch, root):
    """The leaf of each sample (sample, feature) float32 in each tree: (tree, sample) int32."""
    found = np.empty((len(root), len(samples)), np.int32)
    for tree in range(len(root)):
        for sample in range(len(samples)):
            node = root[tree]
            while feature[node] >= 0:
                side = 0 if samples[sample, feature[node]] <= threshold[node] else 1
                node = branch[node, side]
            found[tree, sample] = branch[node, 0]
    return found


@compiled
@no_type_check
def frequencies(leaf, start, label, count, classes):
    """Mean over the trees of the shares of the classes in a sample's leaves: (sample, class) float64.

    Args:
        leaf: (tree, sample).
        start: (leaf + 1,), where the entries of each leaf begin.
        label, count: (entry,), the classes in a leaf, and how many training samples of each.
        classes: how many there are.
    """
    trees, samples = leaf.shape
    found = np.zeros((samples, classes))
    for tree in range(trees):
        for sample in range(samples):
            at = leaf[tree, sample]
            total = 0
            for entry in range(start[at], start[at + 1]):
                total += count[entry]
            for entry in range(start[at], start[at + 1]):
                found[sample, label[entry]] += count[entry] / total
    return found / trees
