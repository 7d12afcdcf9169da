"""Tests that arrays that are not a forest, and bytes that are not a model, are refused before compiled code runs."""

import struct

import numpy as np
import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.errors import CheckpointError
from framework.target import Target

TARGETS = {"classes": Target("class", ("a", "b", "c", "d")), "reals": Target("real", ("x", "y"))}
ASKED = torch.randn(40, 5, generator=torch.Generator().manual_seed(3))


def fit_head(name, kind, **more):
    """Return a head fitted to features that are informative about the target."""
    few = {"extra_trees": {"trees": 6}, "xgboost": {"rounds": 8, "depth": 3}}[name]
    head = build("density_head", resolve("density_head", {"name": name, **few, **more}), target=TARGETS[kind])
    features = torch.randn(300, 5, generator=torch.Generator().manual_seed(0))
    wanted = features[:, :2] @ torch.tensor([[1.0, 0.5], [-1.0, 2.0]])
    if kind == "classes":
        wanted = (features[:, 0] > 0).long() + 2 * (features[:, 1] > 0).long()
    head.fit(features, wanted, 5)
    return head


def predict(head):
    density = head(ASKED)
    return density.logits if head.classes else density.mode


def put(place, value):
    """Return a flat array with another number at one position."""

    def damage(array):
        array.flatten()[place] = value
        return array

    return damage


HUGE = 2**31 - 1
OF_ANY = {
    "of another type": lambda array: array.double() if not array.is_floating_point() else array.long(),
    "complex": lambda array: array.to(torch.complex64),
    "sparse": lambda array: array.reshape(-1).to_sparse(),
    "no array": lambda array: array.tolist(),
    "one dimension more": lambda array: array[None],
    "cut": lambda array: array[:-1] if array.dim() else array[None][:0],
    "one more": lambda array: torch.cat([array, array[-1:]]) if array.dim() else array - 1,
}
OF_FOREST = {
    "feature": [put(0, 5), put(0, HUGE), put(3, -2), put(0, -1), put(-1, 0)],
    "branch": [put(0, 0), put(1, -1), put(0, HUGE), put(1, -(2**31)), put(-1, HUGE), put(-1, -1)],
    "root": [put(1, 0), put(0, 1), put(0, -1), put(-1, HUGE), put(1, 2)],
    "start": [put(0, 1), put(1, 0), put(1, -1), put(-1, HUGE), put(2, HUGE)],
    "label": [put(0, 4), put(0, -1), put(-1, HUGE)],
    "count": [put(0, 0), put(1, -1), put(2, -(2**31))],
    "threshold": [put(0, torch.nan), put(0, torch.inf)],
    "mean": [put(0, torch.nan), put(-1, -torch.inf)],
    "width": [put(0, 1e-300), put(0, 1e300), put(0, 0.0), put(0, -1.0), put(1, torch.nan), put(1, torch.inf)],
    "read": [put(0, 0), put(0, 1), put(0, -1), put(0, 2**40)],
}
"""Valid arrays except for one number; a root moved within its tree leads branches out of the tree before it."""


@pytest.mark.parametrize("kind", TARGETS)
@pytest.mark.parametrize("name", ["extra_trees", "xgboost"])
def test_each_damaged_array_is_refused_and_changes_nothing(name, kind):
    head = fit_head(name, kind)
    whole, before = {key: array.clone() for key, array in head.state_dict().items()}, predict(head)
    tried = set()
    for key, array in whole.items():
        if array.dim() and not array.numel():
            continue  # belongs to the other kind of target
        damages = {**OF_ANY, **dict(enumerate(OF_FOREST[key] if name == "extra_trees" else []))}
        for description, damage in damages.items():
            with pytest.raises(CheckpointError, match=r"is damaged: .*\. Load another"):
                head.load_state_dict({**whole, key: damage(array.clone())})
                raise AssertionError(f"{key}: {description} is taken")
            tried.add(key)
    assert tried >= {key for key, array in whole.items() if array.numel()}
    assert torch.equal(predict(head), before)
    other = build("density_head", resolve("density_head", {"name": name}), target=TARGETS[kind])
    other.load_state_dict(head.double().state_dict())  # the state of a cast model
    assert torch.equal(predict(other), before)


def number(content, after, place, value, kind=">i"):
    """Return the bytes of a model with another number in the first array of that name."""
    start = content.index(after) + len(after) + len("[$l#L") + 8 + struct.calcsize(kind) * place
    return content[:start] + struct.pack(kind, value) + content[start + struct.calcsize(kind) :]


def damaged_models(content):
    """Yield byte strings that differ from a model in one number each."""
    for name in (b"left_children", b"right_children"):
        for place, value in ((0, 0), (1, 0), (0, 2**20), (0, HUGE), (0, -1), (1, -2), (0, -(2**31)), (1, 1)):
            yield number(content, name, place, value)
    for value in (5, HUGE, -1):
        yield number(content, b"split_indices", 0, value)
    yield number(content, b"parents", 0, 0)
    yield number(content, b"parents", 1, 2**20)
    yield number(content, b"split_conditions", 0, np.nan, ">f")
    yield number(content, b"split_conditions", -1, np.inf, ">f")
    yield number(content, b"split_type", 0, 1, "B")
    yield number(content, b"default_left", 0, 2, "B")
    for count in (-1, 0, 10**6, 2**62):  # lengths of arrays
        start = content.index(b"left_children[$l#L") + 18
        yield content[:start] + struct.pack(">q", count) + content[start + 8 :]
    for some, other in (
        (b"gbtree", b"dart\0\0"),
        (b"num_trees", b"num_treez"),
        (b"multi:softprob", b"rank:pairwiseX"),
        (b"reg:squarederror", b"binary:logistic_"),
        (b"num_parallel_treeSL\0\0\0\0\0\0\0\x011", b"num_parallel_treeSL\0\0\0\0\0\0\0\x019"),
        (b"num_featureSL\0\0\0\0\0\0\0\x015", b"num_featureSL\0\0\0\0\0\0\0\x019"),
        (b"size_leaf_vectorSL\0\0\0\0\0\0\0\x011", b"size_leaf_vectorSL\0\0\0\0\0\0\0\x017"),
        (b"num_deletedSL\0\0\0\0\0\0\0\x010", b"num_deletedSL\0\0\0\0\0\0\0\x017"),
        (b"tree_info[#L", b"tree_info[$l"),
        (b"iteration_indptr[#L\0\0\0\0\0\0\0\x09i\0i", b"iteration_indptr[#L\0\0\0\0\0\0\0\x09i\x01i"),
        (b"base_scoreSL\0\0\0\0\0\0\0", b"base_scoreSL\0\0\0\0\0\0\1"),
    ):
        if some in content:
            yield content.replace(some, other)
    for length in range(0, len(content), 1 + len(content) // 40):
        yield content[:length]
    yield content + b"}"
    yield b"{}"
    yield b"[#L" * 5000
    yield b"{L\0\0\0\0\0\0\0\1a" * 5000


@pytest.mark.parametrize("kind", TARGETS)
def test_bytes_that_are_no_model_of_this_head_are_refused(kind):
    """Check the message for each; an empty model aborts the process in xgboost, and a cycle of nodes never ends."""
    head = fit_head("xgboost", kind)
    state, before = head.state_dict(), predict(head)
    content, count = state["model"].numpy().tobytes(), 0
    for damaged in damaged_models(content):
        assert damaged != content
        model = torch.tensor(list(damaged), dtype=torch.uint8)
        with pytest.raises(CheckpointError, match=r"XGBoostHead is damaged: .*\. Load another"):
            head.load_state_dict({**state, "model": model})
            pytest.fail(repr(damaged[:100]))
        count += 1
    assert count > 80
    assert torch.equal(predict(head), before)
    assert torch.equal(predict(fit_head("xgboost", kind)), before)


def test_a_model_of_another_target_is_refused():
    for name in ("extra_trees", "xgboost"):
        for kind, other in (("classes", "reals"), ("reals", "classes")):
            with pytest.raises(CheckpointError, match="is damaged"):
                fit_head(name, kind).load_state_dict(fit_head(name, other).state_dict())


@pytest.mark.parametrize("splits", ["hist", "exact"])
@pytest.mark.parametrize("kind", TARGETS)
def test_every_model_that_is_trained_is_taken(splits, kind):
    """Check trees of a single node and deep ones, drawn samples and features, and a single round."""
    for more in (
        {"rounds": 1, "depth": 1},
        {"weight": 1000.0},
        {"samples": 0.3, "features": 0.3, "depth": 12, "weight": 0.0},
    ):
        head = fit_head("xgboost", kind, splits=splits, **more)
        other = build("density_head", resolve("density_head", {"name": "xgboost"}), target=TARGETS[kind])
        other.load_state_dict(head.state_dict())
        assert torch.equal(predict(other), predict(head))
