import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from framework.bodies.body import Body, BodyModel
from framework.bodies.unposing import SMALLEST, unpose

PARENTS = (1, -1, 1, 2, 0)  # the root is not the first, and a child comes before its parent
VERTICES = 60


def body(features=None, **changes):
    random = np.random.default_rng(0)
    weights = random.random((VERTICES, 5)) * (random.random((VERTICES, 5)) < 0.5) + 1e-3
    parts = {
        "template": random.normal(size=(VERTICES, 3)),
        "faces": random.integers(0, VERTICES, (9, 3)),
        "weights": weights / weights.sum(1, keepdims=True),
        "parents": PARENTS,
        "joints": random.normal(size=(5, 3)),
        "shapes": random.normal(size=(VERTICES, 3, 2)),
        "joint_shapes": random.normal(size=(5, 3, 2)),
        "pose_shapes": None if features is None else random.normal(size=(VERTICES, 3, features)),
    }
    return Body(source="a test", **{**parts, **changes})


def drawn(size, batch=3):
    random = np.random.default_rng(1)
    turned, place = size * random.normal(size=(batch, 5, 3)), random.normal(size=(batch, 3))
    return random.normal(size=(batch, 2)), turned, place, 0.05 * random.normal(size=(batch, VERTICES, 3))


def affine(made, shape, pose):
    """Return the matrix and the translation of each vertex's skinning, by products of homogeneous matrices."""
    joints, matrices = made.joints + made.joint_shapes @ shape, []
    for joint in range(len(made.parents)):
        matrix, at = np.eye(4), joint
        while at >= 0:
            step = np.eye(4)
            step[:3, :3] = Rotation.from_rotvec(pose[at]).as_matrix()
            step[:3, 3] = joints[at] - step[:3, :3] @ joints[at]
            matrix, at = step @ matrix, made.parents[at]
        matrices.append(matrix[:3])
    found = np.einsum("vj,jmn->vmn", made.weights, np.array(matrices))
    return found[..., :3], found[..., 3]


@pytest.mark.parametrize("features", [None, 36, 17])
@pytest.mark.parametrize("size", [0.0, 0.1, 0.5, 2.0, 20.0])
def test_offsets_are_found_again_and_as_inverted_matrices_find_them(features, size):
    made, (shape, pose, translation, offsets) = body(features), drawn(size)
    for dtype, tolerance in ((torch.float64, 1e-6), (torch.float32, 1e-4)):
        model = BodyModel(made).to(dtype)
        given = [torch.as_tensor(values, dtype=dtype) for values in (shape, pose, translation)]
        mesh = model(*given, torch.as_tensor(offsets, dtype=dtype))
        found = unpose(model, mesh, *given)
        errors = np.abs(found.offsets.numpy() - offsets).max(2)
        upright = ~found.folded.numpy()
        assert (errors[upright] < tolerance).all() and found.offsets.dtype == dtype
        if size < 0.3:
            assert upright.all()
        for row in range(len(shape)):
            matrices, shifts = affine(made, shape[row], pose[row])
            smallest = np.linalg.svd(matrices, compute_uv=False)[:, 2]
            close = np.abs(smallest - SMALLEST) > 1e-5
            assert np.array_equal((smallest < SMALLEST)[close], ~upright[row][close])
            np.testing.assert_allclose(model.skinning(*given[:2])[row], matrices, atol=tolerance)
            # W⁻¹(X) is the rest pose with pose blend shapes and offsets
            bare = model(given[0], given[1], given[2])[row].double().numpy()
            for vertex in np.flatnonzero(upright[row]):
                back, own = (
                    np.linalg.inv(matrices[vertex]) @ (points[vertex] - translation[row] - shifts[vertex])
                    for points in (mesh[row].double().numpy(), bare)
                )
                np.testing.assert_allclose(found.offsets[row, vertex].numpy(), back - own, atol=tolerance)


def folding(degrees, share=0.5):
    """Return a model of sixty vertices that follow two bones, and parameters that rotate the second by `degrees`."""
    weights = np.tile([1 - share, share], (VERTICES, 1))
    made = body(parents=(-1, 0), joints=np.zeros((2, 3)), joint_shapes=np.zeros((2, 3, 2)), weights=weights)
    model = BodyModel(made).double()
    pose = torch.zeros(1, 2, 3, dtype=torch.float64)
    pose[0, 1, 2] = np.radians(degrees)
    rest, still = torch.zeros(1, 2, dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64)
    return model, (rest, pose, still)


@pytest.mark.parametrize("degrees", [0, 90, 150, 156, 157, 160, 179, 179.999999, 180, 200, 540])
def test_a_joint_folded_over_leaves_finite_offsets_that_show_the_same_mesh(degrees):
    model, given = folding(degrees)
    smallest = abs(np.cos(np.radians(degrees / 2)))
    apart = 0.03 * torch.randn(1, VERTICES, 3, generator=torch.Generator().manual_seed(0)).double()
    found = unpose(model, model(*given) + apart, *given)
    assert bool(found.folded.all()) == bool(found.folded.any()) == (smallest < SMALLEST)
    lengths, most = found.offsets.norm(dim=2), apart.norm(dim=2)
    assert found.offsets.isfinite().all() and (lengths <= most / SMALLEST * (1 + 1e-9)).all()
    shown = model(*given, offsets=found.offsets) - model(*given)
    kept = 1.0 if smallest >= SMALLEST else smallest**2 / SMALLEST**2
    # along the axis of the fold all is kept; across it, the poorly determined part is taken from the model
    torch.testing.assert_close(shown[..., 2], apart[..., 2], atol=1e-12, rtol=0)
    torch.testing.assert_close(shown[..., :2], kept * apart[..., :2], atol=1e-9, rtol=0)


def test_offsets_do_not_jump_where_inverting_ends():
    limit = 2 * np.degrees(np.arccos(SMALLEST))
    before, after = (folding(limit + side) for side in (-1e-6, 1e-6))
    apart = 0.03 * torch.randn(1, VERTICES, 3, generator=torch.Generator().manual_seed(0)).double()
    one, other = (unpose(model, model(*given) + apart, *given) for model, given in (before, after))
    assert not one.folded.any() and other.folded.all()
    assert (one.offsets - other.offsets).abs().max() < 1e-6


def test_weights_half_and_half_are_the_worst():
    for share in (0.1, 0.39, 0.41, 0.5, 0.59, 0.61, 0.9):
        model, given = folding(180, share)
        found = unpose(model, model(*given), *given)
        # across the axis the blended matrix is (1 - share) - share
        assert bool(found.folded.all()) == (abs(1 - 2 * share) < SMALLEST)


def test_a_mesh_that_is_not_finite_is_refused():
    model, given = folding(30)
    mesh = model(*given)
    mesh[0, 4, 1] = torch.nan
    with pytest.raises(ValueError, match="1 vertices have a coordinate that is not finite"):
        unpose(model, mesh, *given)
