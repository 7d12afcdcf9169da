"""Validation of stored forest arrays, before compiled code walks them without bounds checks."""

from collections.abc import Mapping

import numpy as np

from plugins.density_head.trees.heads_without_gradient import FLOOR, WIDEST


def require_forest(arrays: Mapping[str, np.ndarray], classes: int, numbers: int) -> None:
    """Require that every walk through these arrays ends at a leaf, and that every leaf holds something.

    The nodes of a tree stand between its root and the root of the next tree. Each branch leads to a later node of the
    same tree to which no other branch leads, as scikit-learn lays trees out. So no walk is longer than its tree has
    nodes.

    Args:
        arrays: as in plugins.density_head.trees.forest and ExtraTreesHead, with the dtypes of the head's buffers.
        classes: number of classes of the target; 0 for reals.
        numbers: number of reals of the target; 0 for classes.

    Raises:
        ValueError: the arrays are no such forest; the message is a clause with what came and what was wanted.
    """
    feature, threshold, branch = arrays["feature"], arrays["threshold"], arrays["branch"]
    read = int(_shaped(arrays, "read", ()))
    if len(_shaped(arrays, "feature", (-1,))) == 0:
        held = [
            name
            for name in ("threshold", "branch", "root", "start", "label", "count", "mean")
            if arrays[name].size
        ]
        if held or read:
            raise ValueError(
                f"there are no nodes, but {', '.join(held) or 'features to read'}; wanted nothing"
            )
        return
    _shaped(arrays, "threshold", (len(feature),))
    _shaped(arrays, "branch", (len(feature), 2))
    is_leaf = feature < 0
    leaves = int(is_leaf.sum())
    if not 0 < read < 2**31:
        raise ValueError(f"read is {read}; wanted the number of features, at least 1")
    _within(feature, -1, read, "feature")
    _finite(threshold, "threshold")

    first = _shaped(arrays, "root", (-1,)).astype(np.int64)
    if len(first) == 0 or first[0] != 0 or first[-1] >= len(feature) or (np.diff(first) <= 0).any():
        raise ValueError(f"root does not rise from 0 within {len(feature)} nodes")
    inner = np.flatnonzero(~is_leaf)
    end = np.append(first[1:], len(feature))[np.searchsorted(first, inner, "right") - 1]
    if (branch[inner] <= inner[:, None]).any() or (branch[inner] >= end[:, None]).any():
        raise ValueError("branch leads to a node that is not a later one of the same tree")
    parents = np.bincount(branch[inner].ravel(), minlength=len(feature))
    parents[first] += 1
    if (parents != 1).any():
        raise ValueError(
            f"branch leads to {(parents != 1).sum()} nodes from none or several; wanted one each"
        )
    if (np.sort(branch[is_leaf], 0) != np.arange(leaves)[:, None]).any():
        raise ValueError(f"branch does not number {leaves} leaves, each once")
    if classes:
        _votes(arrays, leaves, classes)
        _empty(arrays, "mean")
    else:
        _finite(_shaped(arrays, "mean", (leaves, numbers)), "mean")
        _empty(arrays, "start", "label", "count")
    require_widths(arrays["width"], numbers)


def require_widths(width: np.ndarray, numbers: int) -> None:
    """Require valid standard deviations, one for each number of the target.

    Raises:
        ValueError: the array is something else.
    """
    # no fit gives less than the floor, except for rounding
    if width.shape != (numbers,) or not ((width > 0.99 * FLOOR) & (width <= WIDEST)).all():
        raise ValueError(f"width is no row of {numbers} numbers from {FLOOR} to {WIDEST}")


def _votes(arrays: Mapping[str, np.ndarray], leaves: int, classes: int) -> None:
    start = _shaped(arrays, "start", (leaves + 1,)).astype(np.int64)
    entries = len(_shaped(arrays, "label", (-1,)))
    count = _shaped(arrays, "count", (entries,))
    if start[0] != 0 or start[-1] != entries or (np.diff(start) <= 0).any():
        raise ValueError(f"start does not rise from 0 to {entries}, the number of labels")
    _within(arrays["label"], 0, classes, "label")
    _within(count, 1, 2**31, "count")


def _shaped(arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return one of the arrays, after a check of its shape; -1 stands for any length."""
    found = arrays[name].shape
    if len(found) != len(shape) or any(
        side not in (-1, came) for side, came in zip(shape, found, strict=True)
    ):
        raise ValueError(f"{name} has the shape {found}; wanted {shape}".replace("-1", "any"))
    return arrays[name]


def _empty(arrays: Mapping[str, np.ndarray], *names: str) -> None:
    for name in names:
        if arrays[name].size or arrays[name].ndim != (2 if name == "mean" else 1):
            raise ValueError(
                f"{name} has the shape {arrays[name].shape}; wanted no numbers for such a target"
            )


def _within(values: np.ndarray, least: int, end: int, name: str) -> None:
    if values.size and not (least <= values.min() and values.max() < end):
        raise ValueError(f"{name} is between {values.min()} and {values.max()}; wanted {least} to {end - 1}")


def _finite(values: np.ndarray, name: str) -> None:
    if not np.isfinite(values).all():
        raise ValueError(f"{name} is not finite")
