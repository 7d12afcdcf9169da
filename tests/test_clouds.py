"""Batches of point clouds against loops in NumPy."""

import math

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from framework.errors import DataError
from framework.geometry.clouds import (
    LOOSE,
    REACH,
    _composed,
    cell_centres,
    denormalise_clouds,
    normalise_clouds,
    pad,
    require_normalised,
    sizes,
)

DTYPES = [torch.float32, torch.float64]
NAN, INF = math.nan, math.inf


def cloud(count, columns=3, seed=0, dtype=torch.float64):
    return torch.randn(count, columns, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def unit_ball(points):
    """Return one cloud normalised by eq. 6.2, in long double."""
    points = points.astype(np.longdouble)
    local = points - points.sum(0) / len(points)
    largest = max(np.sqrt((point**2).sum()) for point in local)
    return local / (largest or 1), points.sum(0) / len(points), largest or 1


def robust(points):
    """The same of the points within REACH median distances of the medians (of an even number the lower one)."""
    lower = (len(points) - 1) // 2
    middle = np.array([np.sort(column)[lower] for column in points.T])
    distance = np.array([np.sqrt(((point - middle) ** 2).sum()) for point in points])
    typical = np.sort(distance)[lower]
    kept = points[distance <= REACH * typical] if typical > 0 else points
    _, centre, scale = unit_ball(kept)
    return (points - centre) / scale, centre, scale


REFERENCES = {"unit_ball": unit_ball, "robust": robust}


def test_sizes_are_those_before_the_padding():
    batch = pad([cloud(4), cloud(1), cloud(7)])
    assert batch.shape == (3, 7, 3)
    assert sizes(batch).tolist() == [4, 1, 7]
    assert sizes(batch[:, :, :]).dtype == torch.int64
    assert sizes(cloud(6)[None].expand(2, 6, 3)).tolist() == [6, 6]
    assert sizes(torch.zeros(0, 5, 3)).shape == sizes(torch.zeros(0, 0, 4)).shape == (0,)


def test_a_sum_that_overflows_is_no_bad_point():
    assert sizes(torch.full((2, 3, 3), 3e38)).tolist() == [3, 3]


@given(
    st.lists(st.integers(1, 9), min_size=1, max_size=5),
    st.integers(3, 6),
    st.data(),
)
@settings(max_examples=60, deadline=None)
def test_a_bad_number_is_named_wherever_it_stands(lengths, columns, data):
    batch = pad([cloud(length, columns) for length in lengths])
    assert sizes(batch).tolist() == lengths
    which = data.draw(st.integers(0, len(lengths) - 1))
    point = data.draw(st.integers(0, lengths[which] - 1))
    column = data.draw(st.integers(0, columns - 1))
    number = data.draw(st.sampled_from([NAN, INF, -INF]))
    batch[which, point, column] = number
    with pytest.raises(
        DataError, match=f"Cloud {which} .* holds {number} in column {column} of point {point};"
    ):
        sizes(batch)


def test_rows_of_nan_within_a_cloud_are_bad_points_and_at_its_end_padding():
    batch = pad([cloud(5), cloud(3)])
    batch[0, 2] = NAN
    with pytest.raises(DataError, match=r"Cloud 0 .* of point 2;"):
        sizes(batch)


@pytest.mark.parametrize("batch", [torch.zeros(2, 0, 3), pad([cloud(2), cloud(2) * NAN])], ids=["0", "NaN"])
def test_an_empty_cloud_is_refused(batch):
    with pytest.raises(DataError, match=r"Cloud \d of the batch has no point"):
        sizes(batch)


@pytest.mark.parametrize(
    "batch",
    [torch.zeros(4, 3), torch.zeros(1, 4, 2), torch.zeros(1, 4, 3).int(), torch.zeros(1, 4, 3).half()],
)
def test_what_is_no_batch_of_clouds_is_refused(batch):
    with pytest.raises(DataError, match=r"expected \(batch, points, columns\) of float32 or float64"):
        sizes(batch)


@pytest.mark.parametrize("clouds", [[], [cloud(2), cloud(2, 4)], [torch.zeros(3)]])
def test_clouds_that_do_not_fit_together_are_refused(clouds):
    with pytest.raises(DataError, match="do not form a batch"):
        pad(clouds)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("how", REFERENCES)
def test_normalisation_agrees_with_loops(how, dtype):
    lengths = [40, 1, 2, 17]
    parts = [cloud(length, 5, seed).to(dtype) * 3 + 10 for seed, length in enumerate(lengths)]
    batch = pad(parts)
    found = normalise_clouds(batch, how)
    assert found.clouds.dtype == dtype
    torch.testing.assert_close(found.clouds[..., 3:], batch[..., 3:], rtol=0, atol=0, equal_nan=True)
    for number, length in enumerate(lengths):
        local, centre, scale = REFERENCES[how](parts[number][:, :3].double().numpy())
        assert found.clouds[number, length:].isnan().all()
        limit = 1e-14 if dtype == torch.float64 else 1e-7
        np.testing.assert_allclose(found.clouds[number, :length, :3].numpy(), local, rtol=0, atol=limit)
        np.testing.assert_allclose(found.centre[number].numpy(), centre.astype(float), rtol=1e-14)
        np.testing.assert_allclose(found.scale[number].item(), float(scale), rtol=1e-13)
    back = denormalise_clouds(found.clouds, found.centre, found.scale)
    torch.testing.assert_close(back, batch, rtol=2 * torch.finfo(dtype).eps, atol=0, equal_nan=True)


coordinates = st.floats(-1, 1, width=32)


@given(
    st.lists(st.tuples(coordinates, coordinates, coordinates), min_size=1, max_size=12),
    st.sampled_from([1e-30, 1e-8, 1.0, 1e8, 1e30]),
    st.sampled_from([0.0, 1.0, 1e8]),
    st.sampled_from(["unit_ball", "robust"]),
    st.sampled_from(DTYPES),
)
@example([(1.0, 0.0, 0.0), (2.0**-52, 0.0, 0.0), (0.0, 0.0, 0.0)], 1e-30, 0.0, "robust", torch.float64)
@settings(max_examples=150, deadline=None)
def test_wild_clouds_are_normalised_and_come_back(points, scale, offset, how, dtype):
    batch = ((torch.tensor(points, dtype=torch.float64) + offset) * scale).to(dtype)[None]
    found = normalise_clouds(batch, how)
    local, _, _ = REFERENCES[how](batch[0].double().numpy())
    assert found.clouds.isfinite().all()
    limit = (
        1e-7 if dtype == torch.float32 else 1e-8
    )  # of float64 at 1e8 from the origin the reference loses digits
    np.testing.assert_allclose(found.clouds[0].double().numpy(), local.astype(float), rtol=1e-6, atol=limit)
    if how == "unit_ball":
        assert found.clouds.norm(dim=-1).max().item() <= 1 + 1e-6
    back = denormalise_clouds(found.clouds, found.centre, found.scale)
    torch.testing.assert_close(
        back, batch, rtol=2e-7 if dtype == torch.float32 else 4e-16, atol=batch.abs().max().item() * 2e-7
    )


@pytest.mark.parametrize("how", ["unit_ball", "robust"])
@pytest.mark.parametrize("place", [0.1, 1e8, 1e-8, -3e30])
@pytest.mark.parametrize("dtype", DTYPES)
def test_points_in_one_place_go_to_the_origin_and_come_back(place, dtype, how):
    batch = torch.full((1, 7, 3), place, dtype=dtype)
    found = normalise_clouds(batch, how)
    assert (found.clouds == 0).all()
    assert found.scale.item() == 1
    assert torch.equal(denormalise_clouds(found.clouds, found.centre, found.scale), batch)


@given(st.floats(0.01, 0.3), st.floats(8, 1e6), st.integers(0, 99))
@settings(max_examples=60, deadline=None)
def test_far_outliers_shift_nothing_of_robust(share, distance, seed):
    clean = cloud(200, seed=seed)
    clean = clean / clean.norm(dim=-1, keepdim=True)
    count = int(share / (1 - share) * len(clean)) + 1
    far = torch.tensor([distance, 0.3, -0.2]) + cloud(count, seed=seed + 1) * 0.1  # all on one side
    wanted, found = (
        normalise_clouds(clean[None], "robust"),
        normalise_clouds(torch.cat([clean, far])[None], "robust"),
    )
    torch.testing.assert_close(found.clouds[:, :200], wanted.clouds, rtol=0, atol=1e-12)
    moved = normalise_clouds(torch.cat([clean, far])[None], "unit_ball").scale - wanted.scale
    assert moved.item() > 1  # eq. 6.2 is shifted


def test_robust_is_eq_6_2_where_nothing_is_far():
    batch = pad([cloud(500), torch.rand(300, 3, dtype=torch.float64)])
    batch[0, :500] /= batch[0, :500].norm(dim=-1, keepdim=True)
    # the centre is a mean of up to 500 numbers of at most 1, summed in two orders: each errs by log2(500) half units of
    # rounding (Higham 2002, §4.2), the subtraction, the norm and the division by a few more
    limit = (math.log2(500) + 4) * torch.finfo(torch.float64).eps
    for found, wanted in zip(
        normalise_clouds(batch, "robust"), normalise_clouds(batch, "unit_ball"), strict=True
    ):
        torch.testing.assert_close(found, wanted, rtol=0, atol=limit, equal_nan=True)


@pytest.mark.parametrize("dtype", DTYPES)
def test_compiled_and_composed_agree_and_a_gradient_changes_no_bit(dtype):
    batch = pad([cloud(50, 4) * 3 + 2, cloud(1, 4), cloud(20, 4).T.contiguous().T]).to(dtype)
    plain = normalise_clouds(batch, "unit_ball")
    for found, other in zip(plain, _composed(batch, "unit_ball", sizes(batch)), strict=True):
        limit = 4 * torch.finfo(dtype).eps
        torch.testing.assert_close(found, other, rtol=limit, atol=limit, equal_nan=True)
    for found, traced in zip(
        plain, normalise_clouds(batch.clone().requires_grad_(), "unit_ball"), strict=True
    ):
        assert traced.requires_grad
        torch.testing.assert_close(found, traced.detach(), rtol=0, atol=0, equal_nan=True)
    torch.testing.assert_close(
        normalise_clouds(batch.mT.contiguous().mT, "unit_ball").clouds,
        plain.clouds,
        rtol=0,
        atol=0,
        equal_nan=True,
    )


def test_none_leaves_clouds_alone():
    batch = pad([cloud(3), cloud(5)]) * 1e6
    found = normalise_clouds(batch, "none")
    assert found.clouds is batch
    assert (found.centre == 0).all()
    assert (found.scale == 1).all()


@pytest.mark.parametrize("how", ["unit_ball", "robust"])
def test_the_gradient_agrees_with_finite_differences_and_padding_has_none(how):
    batch = pad([cloud(6, 4), cloud(4, 4, seed=1), torch.ones(3, 4, dtype=torch.float64)]).requires_grad_()
    weights = torch.randn(batch.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))

    def total(clouds):
        return normalise_clouds(clouds, how).clouds.nan_to_num(0).mul(weights)[:2].sum()

    (gradient,) = torch.autograd.grad(total(batch), batch)
    assert (gradient[0, 6:] == 0).all()
    assert (gradient[1, 4:] == 0).all()
    with torch.no_grad():
        for place in np.ndindex(2, 4, 4):
            step = torch.zeros_like(batch)
            step[place] = 1e-6
            numeric = (total(batch + step) - total(batch - step)) / 2e-6
            assert gradient[place].item() == pytest.approx(numeric.item(), abs=1e-7)


def test_the_gradient_of_points_in_one_place_is_finite():
    batch = torch.ones(1, 5, 3, requires_grad=True)
    normalise_clouds(batch, "unit_ball").clouds.sum().backward()
    assert batch.grad is not None
    assert batch.grad.isfinite().all()


def test_what_exceeds_float64_is_refused():
    with pytest.raises(DataError, match="Cloud 1 of the batch is so large"):
        normalise_clouds(torch.stack([cloud(4), cloud(4) * 1e200]), "unit_ball")


def test_clouds_that_were_not_normalised_are_refused():
    good = cloud(50)
    good /= good.norm(dim=-1).max()
    batch = pad([good, good[:7] * 0, good * 1.9, good * 0.02])
    require_normalised(batch, 1.0, sizes(batch), by="a grid")
    for factor, reach in ((10, "10"), (1e8, r"1e\+08"), (0.005, "0.005"), (1e-8, "1e-08")):
        batch = pad([good[:9], good * factor])
        with pytest.raises(
            DataError, match=rf"Cloud 1 of the batch extends to {reach} .* a grid with normalise=none"
        ):
            require_normalised(batch, 1.0, sizes(batch), by="a grid")
    require_normalised(torch.zeros(0, 0, 3), 1.0, torch.zeros(0), by="a grid")
    assert LOOSE == 2


def test_a_minority_of_far_outliers_is_no_sign_of_clouds_that_were_not_normalised():
    good = cloud(50)
    good /= good.norm(dim=-1).max()
    strays = torch.cat([good, good[:20] * 1e6])
    batch = pad([strays, good[:9]])
    require_normalised(batch, 1.0, sizes(batch), by="a grid")
    batch = pad([good, torch.cat([good[:10], good[:20] * 1e6])])
    with pytest.raises(DataError, match="Cloud 1 of the batch extends to"):
        require_normalised(batch, 1.0, sizes(batch), by="a grid")


def test_cells_are_those_of_the_cube_x_slowest():
    side = 5
    wanted = [
        [-1 + (2 * i + 1) / side, -1 + (2 * j + 1) / side, -1 + (2 * k + 1) / side]
        for i in range(side)
        for j in range(side)
        for k in range(side)
    ]
    np.testing.assert_allclose(cell_centres(side).numpy(), wanted, rtol=0, atol=1e-15)
    assert cell_centres(1).tolist() == [[0, 0, 0]]
