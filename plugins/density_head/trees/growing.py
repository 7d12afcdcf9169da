"""Functions that grow a forest with scikit-learn and store it in flat arrays, which are used without scikit-learn."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from sklearn.ensemble import ExtraTreesClassifier, ExtraTreesRegressor

from plugins.density_head.trees.forest import at_most

Arrays = dict[str, np.ndarray]


def grow_forest(
    features: np.ndarray,
    target: np.ndarray,
    *,
    classes: int,
    trees: int,
    share: float | None,
    leaf: int,
    depth: int | None,
    seed: int,
) -> Arrays:
    """Grow a forest and return its arrays: nodes (plugins.density_head.trees.forest) and content of the leaves.

    Args:
        features: (sample, feature) float32.
        target: (sample,) labels below `classes`; or (sample, number) float64 if `classes` is 0.
        classes: number of classes; 0 for reals.
        trees: number of trees.
        share: share of the features tried at each split; None for the square root of their number if the target is a
            class, and for all features otherwise.
        leaf: smallest number of training samples of a leaf.
        depth: largest number of splits from root to leaf; None for no limit.
        seed: seed of the forest.
    """
    options: dict[str, Any] = {
        "n_estimators": trees,
        "min_samples_leaf": leaf,
        "max_depth": depth,
        "random_state": seed % 2**32,
        "n_jobs": torch.get_num_threads(),
    }
    if classes:
        forest: Any = ExtraTreesClassifier(**{**options, "max_features": "sqrt" if share is None else share})
        forest.fit(features, target)
        grown_trees = [tree.tree_ for tree in forest.estimators_]
        return nodes(grown_trees) | votes(grown_trees, forest.classes_)
    forest = ExtraTreesRegressor(**options, max_features=1.0 if share is None else share)
    forest.fit(features, target if target.shape[1] > 1 else target[:, 0])
    grown_trees = [tree.tree_ for tree in forest.estimators_]
    means = [tree.value[tree.children_left < 0, :, 0] for tree in grown_trees]
    return nodes(grown_trees) | {"mean": np.concatenate(means)}


def nodes(trees: Sequence[Any]) -> Arrays:
    """Return the nodes of all trees in the arrays of trees.forest; leaves are numbered in the order of their nodes."""
    count = np.array([tree.node_count for tree in trees])
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    feature = np.concatenate([np.where(tree.children_left < 0, -1, tree.feature) for tree in trees])
    pairs = [np.stack([tree.children_left, tree.children_right], 1) for tree in trees]
    branch = np.concatenate([pair + start for pair, start in zip(pairs, first, strict=True)])
    is_leaf = feature < 0
    branch[is_leaf] = np.arange(is_leaf.sum())[:, None]
    return {
        "feature": feature.astype(np.int32),
        "threshold": at_most(np.concatenate([tree.threshold for tree in trees])),
        "branch": branch.astype(np.int32),
        "root": first.astype(np.int32),
    }


def votes(trees: Sequence[Any], labels: np.ndarray) -> Arrays:
    """Return the arrays `start`, `label` and `count` of `trees.forest.frequencies`.

    They hold the number of training samples of each class in each leaf. `labels` are the classes that occur in the
    training samples, in the order in which scikit-learn numbers them.
    """
    counts = []
    for tree in trees:
        leaf = tree.children_left < 0
        # a share times a number of samples is an integer, except for rounding
        counts.append(np.rint(tree.value[leaf, 0] * tree.n_node_samples[leaf, None]).astype(np.int32))
    table = np.concatenate(counts)
    leaf, column = np.nonzero(table)
    start = np.concatenate([[0], np.cumsum(np.bincount(leaf, minlength=len(table)))])
    return {
        "start": start.astype(np.int32),
        "label": labels[column].astype(np.int32),
        "count": table[leaf, column],
    }
