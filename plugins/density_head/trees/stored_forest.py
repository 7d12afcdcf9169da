"""Validation of stored forest arrays, before compiled code walks them without bounds checks."""

from collections.abc import Mapping

import numpy as np

from plugins.density_head.trees.heads_without_gradient import FLOOR, WIDEST


def require_forest(arrays: Mapping[str, np.ndarray], classes: int, numbers: int) -> None:
    """Require that every walk from a root ends at a leaf, and that every leaf has valid content.

    The nodes of a tree are stored from its root up to the root of the next tree. As in scikit-learn, each branch leads
    to a later node of the same tree, and no two branches lead to the same node. So a walk has at most as many steps as
    its tree has nodes.

    Args:
        arrays: arrays of plugins.density_head.trees.forest and ExtraTreesHead, with the dtypes of the head's buffers.
        classes: number of classes of the target; 0 for reals.
        numbers: number of reals of the target; 0 for classes.

    Raises:
        ValueError: the arrays are not such a forest; the message is a clause that says what is wrong.
    """
    feature, threshold, branch = arrays["feature"], arrays["threshold"], arrays["branch"]
    read = int(_require_shape(arrays, "read", ()))
    if len(_require_shape(arrays, "feature", (-1,))) == 0:
        filled = [
            name
            for name in ("threshold", "branch", "root", "start", "label", "count", "mean")
            if arrays[name].size
        ]
        if filled or read:
            reason = f"these arrays hold numbers: {', '.join(filled)}" if filled else "`read` is not 0"
            raise ValueError(f"the forest has no nodes (`feature` is empty), but {reason}")
        return
    _require_shape(arrays, "threshold", (len(feature),))
    _require_shape(arrays, "branch", (len(feature), 2))
    is_leaf = feature < 0
    leaves = int(is_leaf.sum())
    if not 0 < read < 2**31:
        raise ValueError(
            f"`read`, the number of features that the forest reads, is {read}; expected at least 1 and less than 2³¹"
        )
    _require_range(feature, -1, read, "feature")
    _require_finite(threshold, "threshold")

    first = _require_shape(arrays, "root", (-1,)).astype(np.int64)
    if len(first) == 0 or first[0] != 0 or first[-1] >= len(feature) or (np.diff(first) <= 0).any():
        raise ValueError(
            f"the array `root`, which holds the first node of each tree, is {_excerpt(first)}; expected ascending "
            f"numbers from 0 to at most {len(feature) - 1}"
        )
    inner = np.flatnonzero(~is_leaf)
    end = np.append(first[1:], len(feature))[np.searchsorted(first, inner, "right") - 1]
    if (branch[inner] <= inner[:, None]).any() or (branch[inner] >= end[:, None]).any():
        raise ValueError(
            "the array `branch`, which holds the two children of each node, contains a child that is not a later "
            "node of the same tree"
        )
    parents = np.bincount(branch[inner].ravel(), minlength=len(feature))
    parents[first] += 1
    if (parents != 1).any():
        raise ValueError(
            f"{(parents != 1).sum()} nodes of the forest are the child of no node or of several nodes; expected "
            "exactly one parent for each node"
        )
    if (np.sort(branch[is_leaf], 0) != np.arange(leaves)[:, None]).any():
        raise ValueError(
            f"the array `branch` does not give each of the {leaves} leaves of the forest a number of its own from 0 "
            f"to {leaves - 1}"
        )
    if classes:
        _require_votes(arrays, leaves, classes)
        _require_empty(arrays, "mean")
    else:
        _require_finite(_require_shape(arrays, "mean", (leaves, numbers)), "mean")
        _require_empty(arrays, "start", "label", "count")
    require_widths(arrays["width"], numbers)


def _excerpt(numbers: np.ndarray) -> str:
    """Return at most four numbers as text for a message."""
    return f"[{', '.join(map(str, numbers[:4]))}{', …' * (len(numbers) > 4)}]"


def require_widths(width: np.ndarray, numbers: int) -> None:
    """Require valid standard deviations, one for each number of the target.

    Raises:
        ValueError: the array has another shape or other values.
    """
    # no fit gives less than the floor, except for rounding
    if width.shape != (numbers,) or not ((width > 0.99 * FLOOR) & (width <= WIDEST)).all():
        raise ValueError(
            f"the array `width`, which holds the standard deviations of the targets, has the shape {width.shape} or "
            f"a value out of range; expected {numbers} numbers from {FLOOR} to {WIDEST}"
        )


def _require_votes(arrays: Mapping[str, np.ndarray], leaves: int, classes: int) -> None:
    start = _require_shape(arrays, "start", (leaves + 1,)).astype(np.int64)
    entries = len(_require_shape(arrays, "label", (-1,)))
    count = _require_shape(arrays, "count", (entries,))
    if start[0] != 0 or start[-1] != entries or (np.diff(start) <= 0).any():
        raise ValueError(
            f"the array `start`, which holds the first label of each leaf, does not ascend from 0 to {entries}, the "
            "number of labels"
        )
    _require_range(arrays["label"], 0, classes, "label")
    _require_range(count, 1, 2**31, "count")


def _require_shape(arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return the array `name` after a check of its shape; a length of -1 in `shape` allows any length."""
    actual = arrays[name].shape
    if len(actual) != len(shape) or any(
        side not in (-1, length) for side, length in zip(shape, actual, strict=True)
    ):
        expected = str(shape).replace("-1", "any")
        raise ValueError(f"the array `{name}` of the forest has the shape {actual}; expected {expected}")
    return arrays[name]


def _require_empty(arrays: Mapping[str, np.ndarray], *names: str) -> None:
    for name in names:
        if arrays[name].size or arrays[name].ndim != (2 if name == "mean" else 1):
            raise ValueError(
                f"the array `{name}` of the forest has the shape {arrays[name].shape}; expected an empty array for "
                "this kind of target"
            )


def _require_range(values: np.ndarray, least: int, end: int, name: str) -> None:
    if values.size and not (least <= values.min() and values.max() < end):
        raise ValueError(
            f"the array `{name}` of the forest has values from {values.min()} to {values.max()}; expected values "
            f"from {least} to {end - 1}"
        )


def _require_finite(values: np.ndarray, name: str) -> None:
    if not np.isfinite(values).all():
        raise ValueError(
            f"the array `{name}` of the forest has values that are not finite; expected finite values"
        )
