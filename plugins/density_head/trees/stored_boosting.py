"""Validation of stored XGBoostHead models, before the compiled library reads their bytes."""

import math
import re
from collections.abc import Mapping, Sequence, Set
from typing import Any

import numpy as np

from framework.errors import shorten
from plugins.density_head.trees.ubjson import parse

NOBODY = 2**31 - 1
"""Number that xgboost stores as the parent of a root."""
FLOATS = ("base_weights", "loss_changes", "split_conditions", "sum_hessian")
LINKS = ("left_children", "right_children", "parents", "split_indices")
FLAGS = ("default_left", "split_type")
CATEGORIES = {
    "categories": ">i4",
    "categories_nodes": ">i4",
    "categories_segments": ">i8",
    "categories_sizes": ">i8",
}
TREE = {*FLOATS, *LINKS, *FLAGS, *CATEGORIES, "id", "tree_param"}


def require_boosting(content: bytes, classes: int, numbers: int, features: int) -> None:
    """Require that the bytes encode trees for this target, and that every walk through a tree ends at a leaf.

    Every node but the root is the child of exactly one node, and stores the number of this parent. The root is the
    child of none. So no walk visits a node twice.

    Args:
        content: UBJSON, as `xgboost.Booster.save_raw` writes it.
        classes: number of classes of the target; 0 for reals.
        numbers: number of values that sums of trees predict: one for each class, or for each real number.
        features: number of features that the trees read.

    Raises:
        ValueError: the bytes are not such a model; the message is a clause that says what is wrong.
    """
    model = _require_keys(parse(content), "the top level", {"learner", "version"})
    version = model["version"]
    if not _are_integers(version) or len(version) != 3:
        raise ValueError("the stored `version` of xgboost does not consist of three integers")
    learner = _require_keys(
        model["learner"],
        "learner",
        {
            "attributes",
            "feature_names",
            "feature_types",
            "gradient_booster",
            "learner_model_param",
            "objective",
        },
    )
    _require_equal(learner["attributes"], {}, "attributes")
    _require_equal(learner["feature_names"], [], "feature_names")
    _require_equal(learner["feature_types"], [], "feature_types")
    parameters = _require_keys(
        learner["learner_model_param"],
        "learner_model_param",
        {"base_score", "boost_from_average", "num_class", "num_feature", "num_target"},
    )
    base = parameters.pop("base_score")
    _require_base_score(base, numbers)
    targets = "1" if classes else str(numbers)
    wanted = {"num_class": str(classes), "num_feature": str(features), "num_target": targets}
    _require_equal(parameters, wanted | {"boost_from_average": "1"}, "learner_model_param")
    softmax = {"name": "multi:softprob", "softmax_multiclass_param": {"num_class": str(classes)}}
    square = {"name": "reg:squarederror", "reg_loss_param": {"scale_pos_weight": "1"}}
    _require_equal(learner["objective"], softmax if classes else square, "objective")

    booster = _require_keys(learner["gradient_booster"], "gradient_booster", {"model", "name"})
    _require_equal(booster["name"], "gbtree", "gradient_booster.name")
    wanted_keys = {"gbtree_model_param", "iteration_indptr", "tree_info", "trees"}
    forest = _require_keys(
        booster["model"], "gradient_booster.model", wanted_keys, {"cats"}
    )  # xgboost writes "cats" since version 3.1
    for name, part in _require_keys(
        forest.get("cats", {}), "cats", set(), {"enc", "feature_segments", "sorted_idx"}
    ).items():
        if not isinstance(part, list | np.ndarray) or len(part):
            raise ValueError(
                f"the entry `cats.{name}` of the stored model is not empty; expected a model without categories"
            )
    trees = forest["trees"]
    if not isinstance(trees, list) or not trees or len(trees) % numbers:
        raise ValueError(
            f"the stored model has no list of trees, or the number of trees is not a positive multiple of {numbers}, "
            "the number of classes or real numbers that the trees predict"
        )
    counted = {"num_parallel_tree": "1", "num_trees": str(len(trees))}
    _require_equal(forest["gbtree_model_param"], counted, "gbtree_model_param")
    _require_equal(forest["iteration_indptr"], [*range(0, len(trees) + 1, numbers)], "iteration_indptr")
    _require_equal(forest["tree_info"], [*range(numbers)] * (len(trees) // numbers), "tree_info")
    for number, tree in enumerate(trees):
        _require_tree(_require_keys(tree, f"tree {number}", TREE), number, features)


def _require_tree(tree: Mapping[str, Any], number: int, features: int) -> None:
    _require_equal(tree["id"], number, f"tree {number}: id")
    count = len(tree["left_children"]) if isinstance(tree["left_children"], np.ndarray) else 0
    sizes = {
        "num_deleted": "0",
        "num_feature": str(features),
        "num_nodes": str(count),
        "size_leaf_vector": "1",
    }
    _require_equal(tree["tree_param"], sizes, f"tree {number}: tree_param")
    types = dict.fromkeys(FLOATS, ">f4") | dict.fromkeys(LINKS, ">i4") | dict.fromkeys(FLAGS, "u1")
    for name, dtype in (types | CATEGORIES).items():
        array, length = tree[name], count if name in types else 0
        if not isinstance(array, np.ndarray) or array.dtype != dtype or len(array) != length:
            raise ValueError(
                f"the array `{name}` of tree {number} has another type or length than expected: {length} numbers of "
                f"type {dtype}"
            )
    left, right, parent, feature = (tree[name].astype(np.int64) for name in LINKS)
    inner = np.flatnonzero(left >= 0)
    outer = np.flatnonzero(left < 0)
    children = np.concatenate([left[inner], right[inner]])
    if count == 0 or (left[outer] != -1).any() or (right[outer] != -1).any():
        raise ValueError(
            f"tree {number} has no node, or a node with only one child; expected two children or none for each node"
        )
    if len(children) != count - 1 or (children <= 0).any() or (children >= count).any():
        raise ValueError(
            f"tree {number} has nodes other than the root without a parent, or children that do not exist; expected "
            "one parent for each node except the root"
        )
    if (np.bincount(children, minlength=count)[1:] != 1).any():
        raise ValueError(f"tree {number} has a node with two parents, so that a walk might not end")
    wanted = np.full(count, NOBODY)
    wanted[left[inner]] = wanted[right[inner]] = inner
    if (parent != wanted).any():
        raise ValueError(
            f"tree {number} has a node whose stored parent is not the node of which it is a child"
        )
    if (feature < 0).any() or (feature >= features).any():
        raise ValueError(f"tree {number} reads a feature whose number is not from 0 to {features - 1}")
    if tree["split_type"].any() or (tree["default_left"] > 1).any():
        raise ValueError(
            f"tree {number} has splits by categories, or an invalid default direction; expected splits by numbers"
        )
    condition = tree["split_conditions"]
    if np.isnan(condition).any() or not np.isfinite(condition[outer]).all():
        raise ValueError(
            f"tree {number} has a leaf whose value is not finite, or a threshold that is NaN; expected finite leaves"
        )


def _require_base_score(text: Any, numbers: int) -> None:
    """Require that `text` holds one finite number, or a list of one number for each sum of trees: "[5E-1,1E0]".

    Versions of xgboost since 3.1 write a list.
    """
    if not isinstance(text, str) or not re.fullmatch(r"\[?[-+.,\dE]{1,100000}\]?", text):
        raise ValueError("the stored `base_score` is not a text of numbers")
    scores = [float(part) for part in text.strip("[]").split(",")]
    if len(scores) not in (1, numbers) or not all(map(math.isfinite, scores)):
        raise ValueError(
            f"the stored `base_score` has {len(scores)} numbers, of which some may not be finite; expected 1 or "
            f"{numbers} finite numbers"
        )


def _require_keys(
    value: Any, name: str, wanted: Set[str], optional: Set[str] = frozenset()
) -> dict[str, Any]:
    if not isinstance(value, dict) or not wanted <= value.keys() <= wanted | optional:
        keys = set(value) if isinstance(value, dict) else set()
        missing, surplus = (
            shorten(", ".join(sorted(names)), 60) or "none"
            for names in (wanted - keys, keys - wanted - optional)
        )
        raise ValueError(
            f"{name} of the stored model has other keys than expected; missing: {missing}; unexpected: {surplus}"
        )
    return dict(value)


def _require_equal(value: Any, wanted: Any, name: str) -> None:
    if (
        type(value) is not type(wanted)
        or value != wanted
        or (isinstance(value, list) and not _are_integers(value))
    ):
        raise ValueError(
            f"{name} of the stored model is {shorten(repr(value), 60)}; expected {shorten(repr(wanted), 60)}"
        )


def _are_integers(values: Any) -> bool:
    return isinstance(values, Sequence) and all(type(value) is int for value in values)
