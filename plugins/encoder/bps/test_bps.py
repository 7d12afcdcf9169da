import copy
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError, DataError, UserError
from framework.geometry.clouds import normalise_clouds, pad, sizes
from plugins.encoder.bps import encoding
from plugins.encoder.bps.basis import basis
from plugins.encoder.bps.encoding import channels, decode, encode, encode_distances, per_point, prepare_basis
from plugins.encoder.bps.frame import frame
from plugins.encoder.bps.rows import COLUMNS

STRATEGIES = ("ball_uniform", "grid", "ball_grid", "hexagonal")
DTYPES = [torch.float32, torch.float64]


def numbers(*shape, seed=0, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def batch_of(lengths, columns=3, dtype=torch.float64):
    return pad([numbers(length, columns, seed=seed).to(dtype) * 2 + 5 for seed, length in enumerate(lengths)])


def by_hand(cloud, points):
    """Return distance, delta and index of the nearest point of one normalised cloud, by loops (eq. 6.4-6.5)."""
    neighbours = []
    for place in points:
        best, index = math.inf, -1
        for number, point in enumerate(cloud[:, :3]):
            distance = math.dist(place, point)
            if distance < best:  # of equally near points the first one stays
                best, index = distance, number
        neighbours.append((best, cloud[index, :3] - place, index))
    distances, deltas, indices = zip(*neighbours, strict=True)
    return np.array(distances), np.array(deltas), np.array(indices)


def build_encoder(shape=(40, 3), columns=(), **config):
    return build(
        "encoder",
        resolve("encoder", {"name": "bps", **config}),
        input_shape=shape,
        input_columns=tuple(columns),
    )


# The basis


def test_random_points_are_uniform_over_the_ball():
    points = basis("ball_uniform", 20_000, 2.0, 13).numpy() / 2
    norm = np.linalg.norm(points, axis=1)
    assert norm.max() <= 1
    assert stats.kstest(norm**3, "uniform").pvalue > 0.01  # the volume within a radius grows with its cube
    for axis in range(3):  # Archimedes: the height of a uniform direction is uniform
        assert stats.kstest(points[:, axis] / norm, stats.uniform(-1, 2).cdf).pvalue > 0.01
    assert np.abs(np.corrcoef(np.c_[points, norm].T)[~np.eye(4, dtype=bool)]).max() < 0.03


def test_random_points_follow_from_their_seed_alone():
    torch.manual_seed(1)
    first = basis("ball_uniform", 100, 1.0, 13)
    torch.manual_seed(2)
    assert torch.equal(basis("ball_uniform", 100, 1.0, 13), first)
    assert torch.equal(basis("ball_uniform", 40, 1.0, 13), first[:40])
    assert not torch.equal(basis("ball_uniform", 100, 1.0, 14), first)


def test_a_grid_is_that_of_three_loops():
    axis = [-1.5, -0.5, 0.5, 1.5]
    wanted = [[x, y, z] for x in axis for y in axis for z in axis]
    np.testing.assert_allclose(basis("grid", 64, 1.5, 13).numpy(), wanted, rtol=0, atol=1e-15)
    assert basis("grid", 1, 1.0, 13).tolist() == [[0, 0, 0]]


@pytest.mark.parametrize(
    "count, near", [(500, r"343 \(7³\) or points=512 \(8³\)"), (2, r"1 \(1³\) or points=8")]
)
def test_a_grid_that_is_no_cube_names_the_nearest_ones(count, near):
    with pytest.raises(ConfigError, match=f"got points={count}. Set points={near}"):
        basis("grid", count, 1.0, 13)
    with pytest.raises(ConfigError, match="a cubic number of points"):
        build_encoder(basis="grid", points=count)


ROW = math.sqrt(3) / 2
MOVES = {
    "ball_grid": [(1, 0, 0), (0, 1, 0), (0, 0, 1)],
    # within a layer, and to the next layer but one, which lies straight above
    "hexagonal": [(1, 0, 0), (0.5, ROW, 0), (-0.5, ROW, 0), (0, 0, 2 * math.sqrt(2 / 3))],
}
NEIGHBOURS = {"ball_grid": 6, "hexagonal": 12}
VOLUME = {"ball_grid": 1.0, "hexagonal": 1 / math.sqrt(2)}


@pytest.mark.parametrize("count", [*range(1, 40), 512, 1000])
@pytest.mark.parametrize("strategy", MOVES)
def test_exactly_as_many_points_of_a_lattice_lie_in_the_ball(strategy, count):
    points = basis(strategy, count, 3.0, 13).numpy() / 3
    assert points.shape == (count, 3)
    assert np.linalg.norm(points, axis=1).max() < 1
    if count == 1:
        return
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    distance[np.diag_indices(count)] = math.inf
    edge = distance.min()
    # every lattice point that is one step from a chosen point and lies in the ball is chosen too
    for move in MOVES[strategy]:
        for sign in (1, -1):
            for other in points + sign * edge * np.array(move):
                in_ball = np.linalg.norm(points - other, axis=1).min() < 1e-9
                assert in_ball or np.linalg.norm(other) >= 1 - 1e-9
    if count >= 512:
        assert count * VOLUME[strategy] * edge**3 == pytest.approx(4 / 3 * math.pi, rel=0.05)
        inner = np.linalg.norm(points, axis=1) < 1 - 1.001 * edge
        assert set((np.abs(distance - edge) < 1e-9).sum(1)[inner]) == {NEIGHBOURS[strategy]}


# The features


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("normalise", ["unit_ball", "robust"])
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_features_agree_with_loops(strategy, normalise, dtype):
    lengths = [30, 1, 7]
    clouds = batch_of(lengths, len(COLUMNS), dtype)
    points = basis(strategy, 27, 1.0, 13).to(dtype)
    wanted = ["normal", "distance", "echo", "delta", "color", "z"]
    encoded = encode(clouds, prepare_basis(points), wanted, normalise, COLUMNS)
    assert list(encoded.features) == wanted
    local = normalise_clouds(clouds, normalise).clouds
    for number, length in enumerate(lengths):
        cloud = local[number, :length].double().numpy()
        distance, delta, index = by_hand(cloud, points.double().numpy())
        np.testing.assert_array_equal(encoded.index[number].numpy(), index)
        limit = 2.5e-7 if dtype == torch.float32 else 1e-14
        np.testing.assert_allclose(encoded.features["distance"][number].numpy(), distance, rtol=0, atol=limit)
        np.testing.assert_allclose(encoded.features["delta"][number].numpy(), delta, rtol=0, atol=limit)
        for feature, places in {"color": [3, 4, 5], "normal": [6, 7, 8], "echo": 9, "z": 2}.items():
            np.testing.assert_array_equal(encoded.features[feature][number].numpy(), cloud[index][:, places])
    assert all(feature.dtype == dtype for feature in encoded.features.values())


coordinate = st.floats(-1, 1, width=32)
WILD = st.one_of(
    st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=1, max_size=20),
    st.integers(1, 20).map(lambda count: [(0.3, -0.2, 0.7)] * count),  # all at one position
    st.lists(coordinate, min_size=1, max_size=20).map(
        lambda along: [(t, 2 * t, -t) for t in along]
    ),  # on a line
    st.integers(1, 20).map(lambda count: [(1e6, 0.0, 0.0), *[(t / count, 0.5, -0.1) for t in range(count)]]),
    st.lists(st.tuples(*[st.sampled_from([-1.0, 0.0, 1.0])] * 3), min_size=1, max_size=40),  # duplicates
)


@given(
    WILD,
    st.sampled_from([1e-8, 1.0, 1e8]),
    st.sampled_from([0.0, 1e3]),
    st.sampled_from(STRATEGIES),
    st.sampled_from([1, 8, 64]),
    st.sampled_from(["unit_ball", "robust"]),
    st.sampled_from(DTYPES),
)
@settings(max_examples=150, deadline=None)
def test_any_cloud_is_encoded_as_by_hand_and_decoded(cloud, scale, offset, strategy, count, normalise, dtype):
    clouds = ((torch.tensor(cloud, dtype=torch.float64) + offset) * scale).to(dtype)[None]
    points = basis(strategy, count, 1.0, 13).to(dtype)
    encoded = encode(clouds, prepare_basis(points), ["distance", "delta"], normalise)
    local = normalise_clouds(clouds, normalise).clouds[0].double().numpy()
    distance, _, _ = by_hand(local, points.double().numpy())
    size = max(1.0, np.abs(local).max())  # the largest norm with far outliers
    limit = 2.5e-7 if dtype == torch.float32 else 1e-14
    np.testing.assert_allclose(encoded.features["distance"][0].numpy(), distance, rtol=0, atol=limit * size)
    length = encoded.features["delta"][0].double().norm(dim=-1).numpy()
    np.testing.assert_allclose(length, distance, rtol=0, atol=limit * size)
    back = decode(encoded)[0].double()
    index = encoded.index[0]
    place = limit * float(encoded.scale[0]) * size + 4e-16 * float(clouds.abs().max())
    assert (back - clouds[0, index].double()).abs().max() <= max(place, 1e-7 * float(clouds.abs().max()))


def test_equally_near_points_give_the_first():
    clouds = torch.tensor([[[1.0, 0, 0], [0, 1, 0], [1, 0, 0], [-1, 0, 0], [0, -1, 0], [0, 1, 0]]])
    encoded = encode(clouds, prepare_basis(torch.zeros(1, 3)), ["delta"], "none")
    assert encoded.index.tolist() == [[0]]
    assert encoded.features["delta"].tolist() == [[[1, 0, 0]]]


def test_only_what_is_asked_for_is_computed(monkeypatch):
    clouds, basis_points = batch_of([9, 12]), prepare_basis(basis("ball_uniform", 8, 1.0, 13))
    gathered = []
    gather_rows = encoding._gather_rows
    monkeypatch.setattr(
        encoding,
        "_gather_rows",
        lambda rows, index: gathered.append(rows.shape[2]) or gather_rows(rows, index),
    )
    assert list(encode(clouds, basis_points).features) == ["distance"]
    assert gathered == []
    assert list(encode(clouds, basis_points, ["delta"]).features) == ["delta"]
    assert gathered == [3]


def test_a_gradient_changes_no_bit_of_the_features():
    clouds, basis_points = batch_of([9, 12]), prepare_basis(basis("ball_uniform", 30, 1.0, 13))
    plain = encode(clouds, basis_points, ["distance", "delta"])
    traced = encode(clouds.clone().requires_grad_(), basis_points, ["distance", "delta"])
    for feature in plain.features:
        assert traced.features[feature].requires_grad
        assert torch.equal(plain.features[feature], traced.features[feature])


@pytest.mark.parametrize("rotation_invariant", [False, True])
@pytest.mark.parametrize("normalise", ["unit_ball", "robust"])
def test_gradients_agree_with_finite_differences(normalise, rotation_invariant):
    basis_points = prepare_basis(basis("ball_uniform", 6, 1.0, 13))

    def features(clouds):
        wanted = ["distance", "delta", "color", "normal"]
        encoded = encode(
            clouds, basis_points, wanted, normalise, COLUMNS, rotation_invariant=rotation_invariant
        )
        return channels(encoded)

    clouds = pad([numbers(7, 10, seed=3), numbers(7, 10, seed=4)]).requires_grad_()
    assert torch.autograd.gradcheck(features, (clouds,), eps=1e-7, atol=1e-5)


@pytest.mark.parametrize("cloud", [torch.ones(1, 5, 3), torch.tensor([[[-1.0, 0, 0], [0, 0, 0], [1, 0, 0]]])])
def test_gradients_of_degenerate_clouds_are_finite(cloud):
    basis_points = prepare_basis(torch.zeros(1, 3))  # the basis point coincides with a point
    clouds = cloud.clone().requires_grad_()
    encoded = encode(clouds, basis_points, ["distance", "delta"], rotation_invariant=True)
    channels(encoded).sum().backward()
    assert clouds.grad is not None
    assert clouds.grad.isfinite().all()


# The way back


@pytest.mark.parametrize("rotation_invariant", [False, True])
@pytest.mark.parametrize("dtype", DTYPES)
def test_deltas_lead_back_to_points_of_the_cloud(dtype, rotation_invariant):
    clouds = batch_of([30, 3], dtype=dtype) * 100
    basis_points = prepare_basis(basis("ball_uniform", 40, 1.0, 13).to(dtype))
    encoded = encode(clouds, basis_points, ["delta"], rotation_invariant=rotation_invariant)
    points = decode(encoded)
    assert points.dtype == dtype
    limit = 20 * torch.finfo(dtype).eps * float(clouds.nan_to_num().abs().max())
    wanted = torch.stack([cloud[index] for cloud, index in zip(clouds, encoded.index, strict=True)])
    torch.testing.assert_close(points, wanted, rtol=0, atol=limit)
    once = decode(encoded, unique=True)
    for number, cloud in enumerate(clouds):
        places = np.unique(encoded.index[number].numpy())
        assert sizes(once)[number] == len(places)
        torch.testing.assert_close(once[number, : len(places)], cloud[places], rtol=0, atol=limit)


def test_distances_alone_do_not_lead_back():
    encoded = encode(batch_of([5]), prepare_basis(basis("grid", 8, 1.0, 13)))
    with pytest.raises(UserError, match=r"encoding of distance .* features=\[delta\]"):
        decode(encoded)


def test_single_points_are_joined_with_their_cloud_and_do_not_depend_on_its_place():
    clouds = batch_of([30, 12])
    basis_points = prepare_basis(basis("ball_uniform", 16, 1.0, 13))
    points = clouds[:, :12]
    encoded = encode(clouds, basis_points, ["distance", "delta"])
    joined = per_point(encoded, points)
    assert joined.shape == (2, 12, 4 * 16 + 3)
    torch.testing.assert_close(joined[..., -3:], normalise_clouds(clouds, "unit_ball").clouds[:, :12])
    assert torch.equal(joined[:, 5, :-3], channels(encoded).flatten(1))
    moved = per_point(encode(clouds * 7 - 3, basis_points, ["distance", "delta"]), points * 7 - 3)
    torch.testing.assert_close(moved, joined, rtol=0, atol=1e-12)
    turn = torch.from_numpy(Rotation.random(rng=5).as_matrix())
    unrotated = per_point(encode(clouds, basis_points, rotation_invariant=True), points)
    rotated = per_point(encode(clouds @ turn, basis_points, rotation_invariant=True), points @ turn)
    torch.testing.assert_close(unrotated, rotated, rtol=0, atol=1e-10)


# Rotations


def rotate(cloud, seed):
    """Return rotated coordinates and normals."""
    turn = torch.from_numpy(Rotation.random(rng=seed).as_matrix()).to(cloud.dtype)
    return torch.cat([cloud[..., :3] @ turn, cloud[..., 3:6], cloud[..., 6:9] @ turn, cloud[..., 9:]], -1)


def encode_invariant(clouds, basis_points):
    features = ["distance", "delta", "normal", "color"]
    return channels(encode(clouds, basis_points, features, "unit_ball", COLUMNS, rotation_invariant=True))


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_rotation_changes_nothing_where_that_is_asked_for(dtype):
    stretch = torch.tensor([3.0, 2, 1, *[1] * 7], dtype=dtype)
    clouds = (numbers(8, 500, 10).to(dtype).abs() - 0.3) * stretch
    basis_points = prepare_basis(basis("ball_uniform", 64, 1.0, 13).to(dtype))
    wanted = encode_invariant(clouds, basis_points)
    for seed in range(5):
        features = encode_invariant(rotate(clouds, seed), basis_points)
        # if rounding makes another point the nearest, all features except the distance jump
        same = (features - wanted).abs().amax(1) <= (1e-5 if dtype == torch.float32 else 1e-12)
        assert same.double().mean() > (0.995 if dtype == torch.float32 else 1 - 1e-9)
        torch.testing.assert_close(
            features[:, 0], wanted[:, 0], rtol=0, atol=1e-5 if dtype == torch.float32 else 1e-12
        )
    plain = channels(encode(clouds, basis_points)) - channels(encode(rotate(clouds, 0), basis_points))
    assert plain.abs().max() > 0.1


@pytest.mark.parametrize("planes", [1, 2, 3])
def test_mirror_planes_do_no_harm(planes):
    cloud = (numbers(200, 10).abs() - 0.3) * torch.tensor([3.0, 2, 1, *[1] * 7], dtype=torch.float64)
    for axis in range(planes):
        mirror = torch.ones(10, dtype=torch.float64)
        mirror[[axis, 6 + axis]] = -1
        cloud = torch.cat([cloud, cloud * mirror])
    basis_points = prepare_basis(basis("ball_uniform", 64, 1.0, 13))
    wanted = encode_invariant(cloud[None], basis_points)[:, 0]
    for seed in range(10):
        features = encode_invariant(rotate(cloud[None], seed), basis_points)[:, 0]
        torch.testing.assert_close(features, wanted, rtol=0, atol=1e-10)


def test_a_mirrored_cloud_is_another():
    cloud = numbers(1, 300, 10).abs() * torch.tensor([3.0, 2, 1, *[1] * 7], dtype=torch.float64)
    basis_points = prepare_basis(basis("ball_uniform", 64, 1.0, 13))
    mirrored = cloud * torch.tensor([-1.0, *[1] * 9], dtype=torch.float64)
    assert (encode_invariant(mirrored, basis_points) - encode_invariant(cloud, basis_points))[
        :, 0
    ].abs().max() > 0.05


def shape(name, seed=0):
    """Return 300 points; they have no mirror plane unless `name` is a shape with one."""
    cloud = (numbers(300, 3, seed=seed).abs() - 0.3) * torch.tensor([3.0, 2, 1], dtype=torch.float64)
    kind, _, thickness = name.partition(" ")
    if kind in ("bar", "even bar"):
        cloud[:, 1:] = 0
    if kind == "sheet":
        cloud[:, 2] *= float(thickness or 0)
    if kind == "tilted":  # in a plane that is not along the axes, so that rounding matters
        cloud[:, 2] = 0.3 * cloud[:, 0] - 0.7 * cloud[:, 1]
    for axis in (0,) if kind.startswith("even") else (0, 1) if kind == "twice-even" else ():
        cloud = torch.cat([cloud, cloud * (1 - 2.0 * torch.eye(3, dtype=torch.float64)[axis])])
    if kind in ("even-sheet", "twice-even"):
        cloud[:, 2] *= float(thickness or 0)
    return cloud


# Flat means thinner than 3e-5 of the length: the two sides of such an even sheet are not distinguished.
FLAT = ["sheet", "sheet 1e-9", "sheet 1e-7", "sheet 1e-6", "tilted", "bar"]
EVEN = [
    "even-bar",
    "even-sheet",
    "even-sheet 1e-6",
    "twice-even",
    "twice-even 1e-6",
    "even-solid",
    "twice-even 1",
]
THICK = ["sheet 2e-4", "sheet 1e-3", "sheet 1e-2", "solid", "even-sheet 1e-2"]


def rotations(count, seed):
    return torch.from_numpy(Rotation.random(count, rng=seed).as_matrix())


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", FLAT + EVEN + THICK)
def test_no_rotation_of_any_shape_changes_its_code(name, seed, dtype):
    cloud = shape(name, seed)
    turned = torch.cat([cloud[None], cloud @ rotations(100, seed)]).to(dtype)
    basis_points = prepare_basis(basis("ball_uniform", 64, 1.0, 13).to(dtype))
    distances = encode(turned, basis_points, rotation_invariant=True).features["distance"]
    limit = 1e-5 if dtype == torch.float32 or name in ("even-sheet 1e-6", "twice-even 1e-6") else 1e-10
    torch.testing.assert_close(distances, distances[:1].expand_as(distances), rtol=0, atol=limit)


def copies(group, count, stretch=(1.0, 1.0, 1.0), mirrored=False):
    """Return points that a group of rotations maps to each other; with `mirrored` also the reflection x → -x."""
    points = (numbers(count, 3).abs() - 0.3) * torch.tensor(stretch, dtype=torch.float64)
    turns = torch.from_numpy(Rotation.create_group(group).as_matrix())
    cloud = torch.cat([points @ turn.T for turn in turns])
    return torch.cat([cloud, -cloud]) if mirrored else cloud


def lattice(stretch):
    """Return a ball of lattice points, stretched to an ellipsoid."""
    axis = torch.linspace(-1, 1, 9, dtype=torch.float64)
    points = torch.cartesian_prod(axis, axis, axis)
    return points[points.norm(dim=1) <= 1 + 1e-9] * torch.tensor(stretch, dtype=torch.float64)


CORNERS = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3)
SYMMETRIC = {
    "cube": CORNERS,
    "lattice in a cube": torch.cartesian_prod(*[torch.linspace(-1, 1, 6, dtype=torch.float64)] * 3),
    "octahedron": torch.cat([torch.eye(3), -torch.eye(3)]).double(),
    "tetrahedron": CORNERS[CORNERS.prod(1) > 0],
    "square": CORNERS[CORNERS[:, 2] > 0] * torch.tensor([1.0, 1, 0]).double(),
    "ball": lattice((1, 1, 1)),
    "spheroid": lattice((2, 1, 1)),
    "flat spheroid": lattice((2, 2, 1)),
    "ellipsoid": lattice((3, 2, 1)),
    "x → -x": copies("C1", 100, (3, 2, 1), mirrored=True),
    "a half turn": copies("C2", 20, (1, 2, 3)),
    "a third of a turn": copies("C3", 20, (1, 1, 3)),
    "a dihedral group": copies("D4", 20),
    "turns of a tetrahedron": copies("T", 5),
    "turns of a cube": copies("O", 7),
    "turns of a cube, x → -x": copies("O", 7, mirrored=True),
    "turns of an icosahedron": copies("I", 4),
}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", SYMMETRIC)
def test_symmetric_clouds_have_one_code_whatever_their_rotation(name, dtype):
    """Check clouds whose second or third moments determine no frame, with points in any order."""
    cloud = SYMMETRIC[name]
    turned = torch.cat([cloud[None], cloud @ rotations(30, 1)]).to(dtype)
    order = torch.randperm(len(cloud), generator=torch.Generator().manual_seed(0))
    basis_points = prepare_basis(basis("ball_uniform", 64, 1.0, 13).to(dtype))
    encoded = encode(torch.cat([turned, turned[:, order]]), basis_points, rotation_invariant=True)
    assert encoded.frame is not None
    torch.testing.assert_close(torch.linalg.det(encoded.frame), torch.ones(62).double())
    distance = encoded.features["distance"]
    limit = 1e-5 if dtype == torch.float32 else 1e-12
    torch.testing.assert_close(distance, distance[:1].expand_as(distance), rtol=0, atol=limit)


@pytest.mark.parametrize("name", FLAT + EVEN + THICK)
def test_a_mirror_image_is_another_shape_where_no_rotation_leads_to_it(name):
    cloud = shape(name)
    basis_points = prepare_basis(basis("ball_uniform", 64, 1.0, 13))
    for axis in range(3):
        mirrored = cloud * (1 - 2.0 * torch.eye(3, dtype=torch.float64)[axis])
        both = torch.stack([cloud, mirrored @ rotations(1, axis)[0]])
        plain, other = encode(both, basis_points, rotation_invariant=True).features["distance"]
        if name in THICK and not name.startswith("even"):
            thickness = float(name.partition(" ")[2] or 1)
            assert (plain - other).abs().max() > 0.05 * thickness
        else:  # up to the thickness, which is at most 1e-6 of the extent of a flat cloud
            torch.testing.assert_close(plain, other, rtol=0, atol=1e-5)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", ["solid", "sheet", "bar", "even-solid"])
@pytest.mark.parametrize("radius", [1.0, 5.0])
@pytest.mark.parametrize("norm", [0.1, 0.99, 1.0, 1.01, 1.5, 1.8])
@pytest.mark.parametrize("far", [0, 20])
def test_a_cloud_that_was_normalised_before_has_a_frame_whatever_its_norms(far, norm, radius, name, dtype):
    """Check clouds on a shell of radius `norm`, inside and outside the unit ball, with and without outliers."""
    cloud = shape(name)
    cloud = cloud * norm * radius / cloud.norm(dim=1, keepdim=True)
    outliers = torch.tensor([[1e3, -2e3, 5e3]], dtype=torch.float64).expand(far, 3)
    whole = torch.cat([cloud, outliers])
    clouds = torch.cat([whole[None], whole @ rotations(20, 1)]).to(dtype)
    basis_points = prepare_basis(basis("ball_uniform", 64, radius, 13).to(dtype))
    encoded = encode(clouds, basis_points, normalise="none", rotation_invariant=True)
    assert encoded.frame is not None
    lengths = (clouds[:, :300].double() @ encoded.frame).square().sum(1)
    assert (
        lengths.diff(dim=1) <= 1e-6 * lengths[:, :1]
    ).all()  # the longest axis of the shell alone is first
    distance = encoded.features["distance"]
    limit = (1e-5 if dtype == torch.float32 else 1e-10) * radius
    torch.testing.assert_close(distance, distance[:1].expand_as(distance), rtol=0, atol=limit)


@pytest.mark.parametrize("name", ["solid", "even-solid", "sheet", "sheet 1e-6", "tilted", "even-sheet"])
def test_frames_have_derivatives_of_second_order(name):
    cloud = shape(name)[::40]
    clouds = normalise_clouds(torch.stack([cloud, cloud @ rotations(1, 2)[0]]), "unit_ball").clouds
    clouds = (0.99 * clouds).requires_grad_()
    sign = frame(clouds.detach())

    def axes(clouds):  # noise decides the sign normal to a mirror plane
        frames = frame(clouds)
        return frames * (frames.detach() * sign).sum(1, keepdim=True).sign()

    assert torch.autograd.gradcheck(axes, (clouds,), eps=1e-7, atol=1e-5)
    assert torch.autograd.gradgradcheck(axes, (clouds,), eps=1e-7, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("normalise", ["unit_ball", "robust", "none"])
def test_codes_have_derivatives_of_second_order(normalise):
    basis_points = prepare_basis(basis("ball_uniform", 4, 1.0, 13))

    def features(clouds):
        encoded = encode(clouds, basis_points, ["distance", "delta"], normalise, rotation_invariant=True)
        return channels(encoded)

    clouds = pad([0.3 * numbers(6, 3, seed=3), 0.3 * numbers(7, 3, seed=4)]).requires_grad_()
    assert torch.autograd.gradgradcheck(features, (clouds,), eps=1e-7, atol=1e-4, rtol=1e-3)


def test_outliers_turn_no_frame_of_a_robust_encoding():
    cloud = numbers(1, 300, 3).abs() * torch.tensor([3.0, 2, 1], dtype=torch.float64)
    cloud = cloud / cloud.norm(dim=-1).median()
    cloud = cloud[:, cloud[0].norm(dim=-1) < 1.5]
    far = torch.cat([cloud, torch.tensor([[[1e3, -2e3, 5e3]] * 20], dtype=torch.float64)], 1)
    basis_points = prepare_basis(basis("ball_uniform", 64, 1.0, 13))
    frames = [
        encode(some, basis_points, normalise="robust", rotation_invariant=True).frame for some in (cloud, far)
    ]
    torch.testing.assert_close(frames[0], frames[1], rtol=0, atol=1e-12)


# The encoder


def test_channels_come_one_after_the_other_and_x_is_slowest():
    clouds = batch_of([30, 12])
    encoder = build_encoder(basis="grid", points=8, features=["delta", "distance"]).double()
    grid = encoder(clouds)
    assert grid.shape == (2, *encoder.output_shape) == (2, 4, 2, 2, 2)
    encoded = encode(clouds, encoder.prepared_basis(), ["delta", "distance"])
    for number in range(8):
        x, y, z = number // 4, number // 2 % 2, number % 2
        assert encoder.basis[number].tolist() == [2 * x - 1, 2 * y - 1, 2 * z - 1]
        assert torch.equal(grid[:, :3, x, y, z], encoded.features["delta"][:, number])
        assert torch.equal(grid[:, 3, x, y, z], encoded.features["distance"][:, number])
    flat = build_encoder(points=8, features=["distance", "delta"]).double()
    assert flat.output_shape == (32,)
    wanted = encode(clouds, flat.prepared_basis(), ["distance", "delta"]).features
    assert torch.equal(flat(clouds)[:, :8], wanted["distance"])
    assert torch.equal(flat(clouds)[:, 8:].unflatten(1, (3, 8)), wanted["delta"].mT)


@pytest.mark.parametrize("lengths", [[300, 300], [1], [30, 12]])
def test_distances_alone_have_the_bits_of_encode(lengths):
    encoder, clouds = build_encoder(points=100), batch_of(lengths, dtype=torch.float32)
    quick = encode_distances(clouds, encoder.prepared_basis())
    assert (quick is None) == (len(set(lengths)) > 1)  # padding is left to `encode`
    assert torch.equal(encoder(clouds), encode(clouds, encoder.prepared_basis()).features["distance"])
    if quick is not None:
        assert torch.equal(quick, encoder(clouds))
        clouds[-1, 0, 1] = math.inf
        with pytest.raises(DataError, match=r"holds inf in column 1 of point 0"):
            encoder(clouds)


def test_the_basis_is_stored_and_followed_when_it_is_loaded_cast_or_copied():
    clouds = batch_of([30, 12], dtype=torch.float32)
    encoder, other = build_encoder(points=16), build_encoder(points=16, basis_seed=14)
    assert set(encoder.state_dict()) == {"basis"}
    assert encoder.fixed
    assert not list(encoder.parameters())
    before = other(clouds)
    other.load_state_dict(encoder.state_dict())
    assert not torch.equal(other(clouds), before)
    assert torch.equal(other(clouds), encoder(clouds))
    assert torch.equal(copy.deepcopy(other)(clouds), encoder(clouds))
    double = encoder.double()(clouds.double())
    assert double.dtype == torch.float64
    torch.testing.assert_close(double, other(clouds).double(), rtol=0, atol=5e-7)
    with torch.inference_mode():
        assert torch.equal(build_encoder(points=16)(clouds), other(clouds))


def test_a_basis_is_prepared_once_and_anew_when_its_numbers_change_in_place():
    clouds, encoder = batch_of([30]), build_encoder(points=16)
    first = encoder(clouds)
    assert encoder.prepared_basis() is encoder.prepared_basis()
    encoder.basis.data.mul_(0.5)  # autograd's version counter does not see this change
    halved = build_encoder(points=16, radius=0.5)(clouds)
    torch.testing.assert_close(encoder(clouds), halved, rtol=0, atol=1e-6)
    assert not torch.equal(encoder(clouds), first)


def test_the_runs_seed_has_no_part_in_it():
    clouds = batch_of([30])
    torch.manual_seed(1)
    first = build_encoder()(clouds)
    torch.manual_seed(2)
    assert torch.equal(build_encoder()(clouds), first)


def test_features_that_are_not_there_are_refused():
    with pytest.raises(
        ConfigError, match=r"'color' requires a column 'red' of the clouds, whose columns are not named"
    ):
        build_encoder(features=["color"])
    with pytest.raises(ConfigError, match=r"'nromal' requires .* are x, y, z, red.* Did you mean 'normal'\?"):
        build_encoder((40, 10), COLUMNS, features=["nromal"])
    with pytest.raises(ConfigError, match="names a feature twice"):
        build_encoder(features=["distance", "distance"])
    with pytest.raises(ConfigError, match="requires a column 'normal_y'"):
        encode(
            batch_of([5], 4),
            prepare_basis(basis("grid", 8, 1.0, 13)),
            ["normal_x"],
            columns=("x", "y", "z", "normal_x"),
            rotation_invariant=True,
        )


@pytest.mark.parametrize(
    "config",
    [
        {"points": 0},
        {"radius": 0},
        {"radius": math.inf},
        {"features": []},
        {"basis": "cube"},
        {"basis_seed": -1},
    ],
)
def test_a_config_out_of_range_is_refused(config):
    with pytest.raises(ConfigError, match=r"encoder\."):
        build_encoder(**config)


@pytest.mark.parametrize("factor", [1e8, 1e-8])
def test_clouds_that_were_not_normalised_are_refused_by_none(factor):
    clouds = normalise_clouds(batch_of([30, 12]), "unit_ball").clouds
    encoder = build_encoder(normalise="none").double()
    torch.testing.assert_close(encoder(clouds), build_encoder().double()(clouds), rtol=0, atol=1e-6)
    with pytest.raises(
        DataError, match=r"Cloud 0 of the batch extends to .* encoder bps with normalise=none"
    ):
        encoder(clouds * factor)
