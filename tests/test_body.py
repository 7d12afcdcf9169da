import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from framework.bodies.body import (
    Body,
    BodyModel,
    quaternion_minus_identity,
    rotation_minus_identity,
    sine_over_angle,
    with_joints,
)
from framework.errors import ConfigError, DataError

PARENTS = (1, -1, 1, 2, 0, 2)  # the root is not the first, and a child comes before its parent


def body(features=None, seed=0, **changes):
    """Return a body of 17 vertices, 6 joints and 3 shape coefficients."""
    random = np.random.default_rng(seed)
    weights = random.random((17, 6)) * (random.random((17, 6)) < 0.5) + 1e-3
    parts = {
        "template": random.normal(size=(17, 3)),
        "faces": random.integers(0, 17, (9, 3)),
        "weights": weights / weights.sum(1, keepdims=True),
        "parents": PARENTS,
        "joints": random.normal(size=(6, 3)),
        "shapes": random.normal(size=(17, 3, 3)),
        "joint_shapes": random.normal(size=(6, 3, 3)),
        "pose_shapes": None if features is None else random.normal(size=(17, 3, features)),
        "names": tuple("abcdef"),
    }
    return Body(source="a test", **{**parts, **changes})


def parameters(count=4, size=1.0, seed=1):
    random = np.random.default_rng(seed)
    return (
        random.normal(size=(count, 3)),
        size * random.normal(size=(count, 6, 3)),
        random.normal(size=(count, 3)),
    )


def by_loop(made, shape, pose, translation):
    """Compute eq. 7.1-7.2 by loops over bodies, vertices and joints, with homogeneous matrices and SciPy's rotation."""
    found = np.empty((len(shape), len(made.template), 3))
    for row in range(len(shape)):
        turn = [Rotation.from_rotvec(vector).as_matrix() for vector in pose[row]]
        rest = made.template + made.shapes @ shape[row]
        joints = made.joints + made.joint_shapes @ shape[row]
        others = [joint for joint in range(6) if made.parents[joint] >= 0]
        if made.pose_shapes is not None and made.pose_shapes.shape[2] == 45:
            rest = rest + made.pose_shapes @ np.concatenate([(turn[j] - np.eye(3)).ravel() for j in others])
        elif made.pose_shapes is not None:
            quaternions = [quaternion(pose[row, joint]) - [0, 0, 0, 1] for joint in others]
            rest = rest + made.pose_shapes @ np.concatenate([*quaternions, [shape[row, 1]]])
        for vertex in range(len(rest)):
            total = np.zeros(3)
            for joint in range(6):
                matrix, at = np.eye(4), joint
                while at >= 0:
                    step = np.eye(4)
                    step[:3, :3] = turn[at]
                    parent = made.parents[at]
                    step[:3, 3] = joints[at] - (joints[parent] if parent >= 0 else 0)
                    matrix, at = step @ matrix, parent
                moved = matrix @ np.append(rest[vertex] - joints[joint], 1)
                total += made.weights[vertex, joint] * moved[:3]
            found[row, vertex] = total + translation[row]
    return found


def quaternion(vector):
    angle = np.linalg.norm(vector)
    return np.append(np.sin(angle / 2) / angle * vector, np.cos(angle / 2))


def posed(made, shape, pose, translation=None, dtype=torch.float64):
    given = [
        None if values is None else torch.as_tensor(values, dtype=dtype)
        for values in (shape, pose, translation)
    ]
    return BodyModel(made).to(dtype)(*given).numpy()


@pytest.mark.parametrize("features", [None, 45, 21])
@pytest.mark.parametrize("size", [1e-9, 0.3, 2.0, 20.0])
@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-12), (torch.float32, 2e-5)])
def test_agrees_with_a_loop_of_homogeneous_matrices(features, size, dtype, tolerance):
    made = body(features)
    shape, pose, translation = (values.astype(np.float32).astype(float) for values in parameters(size=size))
    found = posed(made, shape, pose, translation, dtype)
    wanted = by_loop(made, shape, pose, translation)
    np.testing.assert_allclose(found, wanted, atol=tolerance * np.abs(wanted).max())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_pose_of_zeros_is_template_plus_shapes(dtype):
    made = body()
    model = BodyModel(made).to(dtype)
    shape = torch.as_tensor(parameters()[0], dtype=dtype)
    rest = torch.addmm(model.template, shape, model.shapes).unflatten(1, (3, -1)).transpose(1, 2)
    assert torch.equal(model(shape, torch.zeros(4, 6, 3, dtype=dtype)), rest)
    template = torch.as_tensor(made.template).to(dtype)
    assert torch.equal(model(shape[:, :0], torch.zeros(4, 6, 3, dtype=dtype))[0], template)
    np.testing.assert_allclose(
        rest.numpy(), made.template + np.einsum("vks,bs->bvk", made.shapes, shape), rtol=1e-5
    )


def test_a_turn_of_the_root_turns_the_whole_body_about_it():
    made = body()
    shape, _, translation = parameters()
    pose = np.zeros((4, 6, 3))
    pose[:, 1] = [0.3, -2.0, 1.0]
    rest = posed(made, shape, 0 * pose)
    middle = (made.joints[1] + np.einsum("ks,bs->bk", made.joint_shapes[1], shape))[:, None]
    turn = Rotation.from_rotvec([0.3, -2.0, 1.0]).as_matrix()
    wanted = (rest - middle) @ turn.T + middle + translation[:, None]
    np.testing.assert_allclose(posed(made, shape, pose, translation), wanted, atol=1e-13)


def test_joints_go_where_the_chain_takes_them():
    made = body()
    shape, pose, _ = parameters()
    model = BodyModel(made)
    found = model.posed_joints(torch.from_numpy(shape), torch.from_numpy(pose)).numpy()
    # a vertex at a joint, with weight 1 for that joint, moves as the joint does
    single = body(
        template=np.vstack([made.joints, made.template[6:]]),
        weights=np.eye(17, 6) + np.eye(17, 6, -6) + np.eye(17, 6, -12),
    )
    single = Body(**{**single.__dict__, "shapes": np.concatenate([made.joint_shapes, made.shapes[6:]])})
    np.testing.assert_allclose(found, posed(single, shape, pose)[:, :6], atol=1e-12)
    rest = model.rest_joints(torch.from_numpy(shape)).numpy()
    np.testing.assert_allclose(
        rest, made.joints + np.einsum("jks,bs->bjk", made.joint_shapes, shape), atol=1e-14
    )


def test_whole_turns_change_nothing():
    made = body()
    shape, pose, _ = parameters()
    angle = np.linalg.norm(pose, axis=-1, keepdims=True)
    for turns in (1, -3, 1000):
        more = pose * (1 + 2 * np.pi * turns / angle)
        np.testing.assert_allclose(posed(made, shape, more), posed(made, shape, pose), atol=1e-14 * 1e4)


@settings(deadline=None, max_examples=100)
@given(st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3), st.floats(-160, 0))
def test_rotations_are_scipys_and_tiny_ones_keep_their_digits(vector, shrink):
    vector = np.array(vector) * 10.0**shrink
    found = rotation_minus_identity(torch.from_numpy(vector)).numpy()
    size = max(1.0, np.linalg.norm(vector))
    np.testing.assert_allclose(
        found + np.eye(3), Rotation.from_rotvec(vector).as_matrix(), atol=1e-15 * size + 4e-15
    )
    x, y, z = vector
    if 0 < np.linalg.norm(vector) < 1e-9:
        np.testing.assert_allclose(
            found, [[0, -z, y], [z, 0, -x], [-y, x, 0]], rtol=1e-8, atol=np.square(vector).sum()
        )
    np.testing.assert_allclose((found + np.eye(3)) @ (found + np.eye(3)).T, np.eye(3), atol=4e-15)


def test_sine_over_angle_at_both_sides_of_its_series():
    import mpmath

    for angle in (0.0, 1e-200, 1e-8, 0.05, 0.0999999, 0.1, 0.1000001, 1.0, math.pi, 1e5):
        with mpmath.workdps(40):
            square = mpmath.mpf(angle * angle)
            wanted = float(mpmath.sinc(mpmath.sqrt(square)))
        found = sine_over_angle(torch.tensor(angle * angle, dtype=torch.float64)).item()
        assert found == pytest.approx(wanted, rel=4e-16, abs=1e-16), angle


@pytest.mark.parametrize("features", [None, 45, 21])
@pytest.mark.parametrize("size", [0.0, 0.099, 1.5])
def test_gradients_are_those_of_differences(features, size):
    model = BodyModel(body(features))
    given = [torch.from_numpy(values).requires_grad_() for values in parameters(count=2, size=size)]
    assert torch.autograd.gradcheck(model, given, eps=1e-6, atol=1e-6)
    (model(*given).square().sum()).backward()
    assert all(values.grad.isfinite().all() for values in given)


def test_quaternions_have_a_gradient_at_nothing():
    vector = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(quaternion_minus_identity, vector)


def test_joints_that_never_bend_can_be_left_out():
    made = body()
    less = with_joints(made, ["b", "c", "f"])  # the chains are b-a-e, b-c-d and c-f
    assert less.parents == (-1, 0, 1)
    shape, pose, translation = parameters()
    pose[:, [0, 3, 4]] = 0
    np.testing.assert_allclose(
        posed(less, shape, pose[:, [1, 2, 5]], translation), posed(made, shape, pose, translation), atol=1e-13
    )


@pytest.mark.parametrize(
    "names, features, message",
    [
        (["b", "z"], None, "has no joint 'z'"),
        (["a"], None, "the root 'b'"),
        (["b"], 45, "no pose shapes"),
    ],
)
def test_joints_that_cannot_be_left_out_are_named(names, features, message):
    with pytest.raises(ConfigError, match=message):
        with_joints(body(features), names)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"weights": np.ones((17, 6))}, r"weights of vertex 0 .* sum to 6"),
        ({"weights": np.ones((16, 6)) / 6}, r"weights has the shape \(16, 6\); expected \(17, 6\)"),
        ({"template": np.full((17, 3), np.nan)}, "51 numbers of template are not finite"),
        ({"faces": np.array([[0, 1, 17]])}, "vertices 0 to 17, but the vertices are numbered 0 to 16"),
        ({"parents": (1, 0, 1, 2, 0, 2)}, "form no tree"),
        ({"parents": (-1, -1, 1, 2, 0, 2)}, "form no tree"),
        ({"parents": (1, -1, 3, 2, 0, 2)}, "form no tree"),
        ({"parents": (1, -1, 1, 2, 0, 6)}, "form no tree"),
        (
            {"pose_shapes": np.zeros((17, 3, 44))},
            r"pose_shapes has the shape \(17, 3, 44\); expected \(17, 3, 45\)",
        ),
        ({"names": ("a",)}, "has 6 joints, but 1 names"),
    ],
)
def test_parts_that_do_not_fit_are_refused(changes, message):
    with pytest.raises(DataError, match=message):
        body(**changes)


def test_weights_that_are_rounded_are_made_to_sum_to_1():
    weights = body().weights
    made = body(weights=weights * 1.0005)
    np.testing.assert_allclose(made.weights, weights, rtol=1e-14)


@pytest.mark.parametrize(
    "shape, pose, message",
    [
        (
            torch.zeros(2, 4),
            torch.zeros(2, 6, 3),
            r"shape parameters \(2, 4\), expected \(batch, at most 3\)",
        ),
        (torch.zeros(2, 3), torch.zeros(3, 6, 3), r"pose \(3, 6, 3\), expected \(batch, 6, 3\)"),
        (torch.zeros(2, 3), torch.zeros(2, 5, 3), r"pose \(2, 5, 3\), expected \(batch, 6, 3\)"),
        (
            torch.zeros(2, 3),
            torch.tensor([0.0, math.nan])[:, None, None].expand(2, 6, 3),
            "The body parameter pose has a number .* in batch row 1",
        ),
        (
            torch.tensor([[0.0] * 3, [math.inf] * 3]),
            torch.zeros(2, 6, 3),
            "The body parameter shape has a number .* in batch row 1",
        ),
        (
            torch.zeros(2, 3),
            torch.full((2, 6, 3), 1e200, dtype=torch.float64),
            "The body parameter pose has a number .* in batch row 0",
        ),
    ],
)
def test_parameters_that_do_not_fit_are_refused(shape, pose, message):
    with pytest.raises(ValueError, match=message):
        BodyModel(body())(shape.double(), pose.double())


def test_an_empty_batch_gives_no_bodies():
    assert posed(body(), np.zeros((0, 3)), np.zeros((0, 6, 3))).shape == (0, 17, 3)


def test_it_moves_with_its_dtype():
    model = BodyModel(body()).float()
    assert model(torch.zeros(1, 3), torch.zeros(1, 6, 3)).dtype == torch.float32
    assert not model.state_dict()  # a body is data, not weights
