import numpy as np
import pytest
import scipy.linalg
import torch

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from framework.geometry.clouds import pad
from plugins.encoder.bps.basis import basis
from plugins.encoder.bps.selection import candidate_count, covariance, pivots, select


def correlated_columns(rows, columns, seed=0):
    """Return rows of a Gaussian whose columns are mixtures of each other with unequal variances, float64."""
    generator = np.random.default_rng(seed)
    return torch.from_numpy(
        generator.normal(size=(rows, columns)) @ generator.normal(size=(columns, columns)) + 1e3
    )


def clouds_of(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    stretch = torch.rand(count, 1, 3, generator=generator) + 0.1
    return torch.randn(count, 100, 3, generator=generator) * stretch


def build_encoder(**config):
    return build(
        "encoder",
        resolve("encoder", {"name": "bps", "basis": "selected", **config}),
        input_shape=(100, 3),
        input_columns=(),
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [1, 7, 3000])
def test_the_covariance_of_batches_is_that_of_numpy(size, dtype):
    rows = correlated_columns(3000, 12).to(dtype)
    expected = np.cov(rows.double().numpy(), rowvar=False, bias=True)
    np.testing.assert_allclose(covariance(rows.split(size)), expected, rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize(("rows", "columns", "count"), [(200, 30, 30), (200, 30, 8), (20, 50, 19)])
def test_the_pivots_are_those_of_scipys_qr_factorisation(rows, columns, count):
    matrix = correlated_columns(rows, columns)
    centred = (matrix - matrix.mean(0)).numpy()
    expected = scipy.linalg.qr(centred, mode="r", pivoting=True)[1][:count]
    np.testing.assert_array_equal(pivots(covariance([matrix]), count), expected)


def test_few_clouds_are_explained_by_few_points_and_the_first_others_fill_up():
    matrix = correlated_columns(6, 40)  # rank 5 after centring
    first = pivots(covariance([matrix]), 20)
    assert len(first) == 5
    chosen = select([matrix], 20)
    assert chosen[:5].tolist() == first.tolist()
    others = [index for index in range(40) if index not in first]
    assert chosen[5:].tolist() == others[:15]


def test_columns_without_variance_give_the_first_candidates():
    assert select([torch.ones(9, 8)], 3).tolist() == [0, 1, 2]
    assert select([torch.rand(1, 8)], 3).tolist() == [0, 1, 2]


def test_the_chosen_basis_explains_distances_from_other_points_better_than_random_bases():
    clouds = clouds_of(400)
    wanted = build_encoder(basis="ball_uniform", points=200, basis_seed=5)(clouds).double()
    wanted = wanted - wanted.mean(0)

    def residual(encoder):
        features = encoder(clouds).double()
        features = features - features.mean(0)
        return (wanted - features @ torch.linalg.lstsq(features, wanted).solution).square().mean()

    chosen = build_encoder(points=12)
    chosen.fit_inputs(clouds.split(64))
    random = [build_encoder(basis="ball_uniform", points=12, basis_seed=seed) for seed in range(20, 30)]
    assert residual(chosen) < min(map(residual, random))


@pytest.mark.parametrize(
    "config", [{}, {"normalise": "robust"}, {"rotation_invariant": True}, {"radius": 1.5}]
)
def test_chosen_points_are_candidates_and_a_smaller_set_is_the_beginning_of_a_larger_one(config):
    clouds = clouds_of(60)
    large, small = build_encoder(points=20, **config), build_encoder(points=5, **config)
    for encoder in (large, small):
        encoder.fit_inputs(clouds.split(16))
    assert torch.equal(large.basis[:5], small.basis)
    candidates = basis("ball_uniform", candidate_count(20), config.get("radius", 1.0), 13).float()
    distances = torch.cdist(large.basis.double(), candidates.double())
    assert (distances.min(1).values == 0).all()
    assert len(large.basis.unique(dim=0)) == 20


def test_batches_of_padded_clouds_and_their_order_do_not_matter():
    clouds = [cloud[: 40 + 10 * (number % 7)] for number, cloud in enumerate(clouds_of(50))]
    encoders = build_encoder(points=8), build_encoder(points=8)
    encoders[0].fit_inputs([pad(clouds)])
    encoders[1].fit_inputs([pad(clouds[30:]), pad(clouds[:30])])
    assert torch.equal(encoders[0].basis, encoders[1].basis)


def test_the_chosen_basis_is_stored_and_searched():
    clouds = clouds_of(30)
    encoder, other = build_encoder(points=8), build_encoder(points=8)
    before = encoder(clouds)
    encoder.fit_inputs([clouds])
    assert not torch.equal(encoder(clouds), before)
    other.load_state_dict(encoder.state_dict())
    assert torch.equal(other(clouds), encoder(clouds))


def test_more_points_than_can_be_chosen_are_refused():
    with pytest.raises(ConfigError, match=r"at most 2048 basis points, but got points=2049"):
        build_encoder(points=2049)
