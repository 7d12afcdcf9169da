import pickle

import numpy as np
import pytest
import torch
from scipy import sparse

from framework.bodies import body_files
from framework.bodies.body import Body, BodyModel
from framework.errors import DataError

JOINTS, VERTICES, SHAPES = 4, 12, 5


def arrays(features=9 * (JOINTS - 1), seed=0):
    """Return the arrays of a body in the published layout: parents 0 ← 1 ← 2, 0 ← 3."""
    random = np.random.default_rng(seed)
    weights, regressor = random.random((VERTICES, JOINTS)), random.random((JOINTS, VERTICES))
    return {
        "v_template": random.normal(size=(VERTICES, 3)),
        "shapedirs": random.normal(size=(VERTICES, 3, SHAPES)),
        "posedirs": random.normal(size=(VERTICES, 3, features)),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        "weights": weights / weights.sum(1, keepdims=True),
        "kintree_table": np.array([[2**32 - 1, 0, 1, 0], [0, 1, 2, 3]], dtype=np.uint32),
        "f": random.integers(0, VERTICES, (8, 3)).astype(np.uint32),
        "bs_type": "lrotmin",
    }


def written(folder, content, name="body.pkl"):
    file = folder / name
    if file.suffix == ".npz":
        np.savez(file, **content)
    else:
        file.write_bytes(pickle.dumps(content, protocol=2))
    return file


def same(one, other):
    for name in ("template", "faces", "weights", "joints", "shapes", "joint_shapes", "pose_shapes"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.parents == other.parents


def test_npz_and_pickle_hold_the_same_body(tmp_path):
    content = arrays()
    loose = {**content, "J_regressor": sparse.csc_matrix(content["J_regressor"])}
    body = body_files.read(written(tmp_path, content, "body.npz"))
    same(body, body_files.read(written(tmp_path, loose)))
    assert body.parents == (-1, 0, 1, 0)
    np.testing.assert_allclose(body.joints, content["J_regressor"] @ content["v_template"], atol=1e-15)


def test_joints_move_with_the_shape_as_if_regressed_from_the_shaped_vertices(tmp_path):
    content = arrays()
    model = BodyModel(body_files.read(written(tmp_path, content)))
    shape = np.random.default_rng(1).normal(size=(3, SHAPES))
    shaped = content["v_template"] + np.einsum("vks,bs->bvk", content["shapedirs"], shape)
    wanted = np.einsum("jv,bvk->bjk", content["J_regressor"], shaped)
    np.testing.assert_allclose(model.rest_joints(torch.from_numpy(shape)).numpy(), wanted, atol=1e-13)


@pytest.mark.parametrize("features", [9 * (JOINTS - 1), 4 * (JOINTS - 1) + 1])
def test_pose_blend_shapes_of_both_kinds_are_read(tmp_path, features):
    body = body_files.read(written(tmp_path, arrays(features)))
    assert BodyModel(body).quaternions == (features == 13)
    assert body.pose_shapes.shape == (VERTICES, 3, features)


def test_a_body_without_pose_blend_shapes(tmp_path):
    content = arrays()
    del content["posedirs"]
    assert body_files.read(written(tmp_path, content)).pose_shapes is None


def test_more_than_is_needed_does_no_harm(tmp_path):
    content = {**arrays(), "hands_mean": np.zeros(45), "joint2num": np.array({"hip": 1}, dtype=object)}
    same(
        body_files.read(written(tmp_path, content, "body.npz")), body_files.read(written(tmp_path, arrays()))
    )


def test_our_own_layout_keeps_every_bit(tmp_path):
    body = body_files.read(written(tmp_path, arrays()))
    named = Body(**{**body.__dict__, "names": ("root", "spine", "kopf ä", "arm"), "source": "somewhere"})
    body_files.save(named, tmp_path / "own.npz")
    found = body_files.load(tmp_path / "own.npz")
    same(found, named)
    assert (found.names, found.source) == (named.names, "somewhere")
    assert [file.name for file in tmp_path.glob(".*")] == []


NESTED = [0.0, 1.0, 2.0]
for _ in range(30):
    NESTED = [NESTED, NESTED]  # would become an array of 2³⁰ rows


def changed(**changes):
    return {name: value for name, value in {**arrays(), **changes}.items() if value is not None}


@pytest.mark.parametrize(
    "content, message",
    [
        (changed(weights=None, f=None), "weights, f are missing; the file contains v_template"),
        (changed(shapedirs=np.zeros((3, 3, 3))), r"do not fit together: .*shapedirs \(3, 3, 3\)"),
        (changed(J_regressor=np.zeros((JOINTS, 3))), r"do not fit together: .*J_regressor \(4, 3\)"),
        (
            changed(v_template=np.full((VERTICES, 3), np.inf)),
            "v_template has the type float64 .* other than finite numbers",
        ),
        (changed(weights=np.zeros((VERTICES, JOINTS))), "sum to 0; expected no weight below 0"),
        (changed(posedirs=np.zeros((VERTICES, 3, 7))), r"pose_shapes has the shape \(12, 3, 7\)"),
        (changed(kintree_table=np.zeros((2, JOINTS), int)), "form no tree"),
        (changed(f=np.full((2, 3), VERTICES)), "vertices 12 to 12, but the vertices are numbered 0 to 11"),
        (changed(v_template="text"), "v_template has the type <U4"),
        (changed(J_regressor=sparse.csc_matrix((10**6, 10**6))), "too large for a body model"),
        (changed(v_template=NESTED), "v_template has the type list; expected an array"),
        (changed(f=(0, 1, 2)), "f has the type tuple; expected an array"),
        (changed(v_template=np.zeros((0, 3)), shapedirs=np.zeros((0, 3, 10**9))), "do not fit together"),
        ([1, 2], "an object of type list"),
        (
            print,
            "the pickle is refused: the pickle names builtins.print.*nothing in this file was run|__builtin__.print",
        ),
        (changed(shapedirs=np.array([None, 1])), "the pickle is refused"),
    ],
)
def test_wrong_files_are_refused(tmp_path, content, message):
    with pytest.raises(DataError, match=message):
        body_files.read(written(tmp_path, content))


def test_an_array_of_objects_in_an_npz_is_refused(tmp_path):
    content = {**arrays(), "weights": np.array([{"a": 1}], dtype=object)}
    with pytest.raises(DataError, match="weights cannot be read as plain numbers"):
        body_files.read(written(tmp_path, content, "body.npz"))


@pytest.mark.parametrize("name", ["body.npz", "body.pkl"])
def test_missing_damaged_and_other_files_are_refused(tmp_path, name):
    with pytest.raises(DataError, match="no such file"):
        body_files.read(tmp_path / name)
    file = written(tmp_path, arrays(), name)
    file.write_bytes(file.read_bytes()[:300])
    with pytest.raises(DataError, match=r"cannot be read|the pickle is refused: the pickle is damaged"):
        body_files.read(file)
    with pytest.raises(DataError, match=r"must end in \.npz or \.pkl"):
        body_files.read(tmp_path / "body.obj")
    (tmp_path / "own.npz").write_bytes(b"PK nothing")
    with pytest.raises(DataError, match="cannot be read as a body"):
        body_files.load(tmp_path / "own.npz")
