"""Tests of mixtures, marginals, medians and quadratures that belong to no single method."""

import math
from typing import ClassVar

import pytest
import torch
from torch.distributions import Distribution, Independent, Normal, constraints

from framework.distributions.circular import circular
from framework.distributions.density import Mixture, circular_entropy, circular_grid
from framework.distributions.protocol import marginal, median, pick
from framework.errors import UserError


def normals(*shape: int) -> Independent:
    generator = torch.Generator().manual_seed(5)
    mean = torch.randn(*shape, generator=generator, dtype=torch.float64)
    return Independent(Normal(mean, mean.exp()), 1)


class Cardioid(Distribution):
    """Cardioid density (1 + 2ρ cos φ) / 2π, a reference on the circle with a closed-form series for the entropy."""

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}
    support = circular

    def __init__(self, rho: torch.Tensor) -> None:
        self.rho = rho
        super().__init__(rho.shape, torch.Size((1,)), validate_args=False)

    @property
    def mode(self) -> torch.Tensor:
        return torch.zeros(*self.rho.shape, 1, dtype=self.rho.dtype)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> torch.Tensor:
        """Return zeros of the right shape, since these tests read only the shape."""
        return torch.zeros(*sample_shape, *self.rho.shape, 1, dtype=self.rho.dtype)

    def log_prob(self, value: torch.Tensor) -> torch.Tensor:
        return torch.log1p(2 * self.rho * value[..., 0].cos()) - math.log(2 * math.pi)


def test_mixture_of_one_is_its_component_to_the_last_bit() -> None:
    component = normals(4, 1, 3)
    mixture = Mixture(torch.full((4, 1), -7.3, dtype=torch.float64), component)
    value = torch.randn(11, 4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.equal(mixture.log_prob(value), component.log_prob(value[:, :, None]).squeeze(-1))
    assert torch.equal(mixture.entropy(), component.entropy().squeeze(-1))
    assert torch.equal(mixture.mode, component.base_dist.loc.squeeze(1))
    torch.manual_seed(3)
    drawn = mixture.sample((5,))
    torch.manual_seed(3)
    assert torch.equal(drawn, component.sample((5,)).squeeze(2))


def test_mixture_log_prob_is_the_logarithm_of_the_weighted_sum() -> None:
    component = normals(2, 3, 1)
    weights = torch.tensor([[0.2, 0.5, 0.3], [1.0, 0.0, 0.0]], dtype=torch.float64)
    mixture = Mixture(weights.log(), component)
    value = torch.tensor([[0.3], [-1.2]], dtype=torch.float64)
    for row in range(2):
        total = math.fsum(
            weights[row, k].item()
            * math.exp(
                Normal(component.base_dist.loc[row, k, 0], component.base_dist.scale[row, k, 0])
                .log_prob(value[row, 0])
                .item()
            )
            for k in range(3)
        )
        assert mixture.log_prob(value)[row].item() == pytest.approx(math.log(total), rel=1e-13)


def test_a_distant_target_keeps_a_finite_log_density() -> None:
    mixture = Mixture(
        torch.zeros(1, 3), Independent(Normal(torch.zeros(1, 3, 1), torch.full((1, 3, 1), 1e-3)), 1)
    )
    assert mixture.log_prob(torch.tensor([[100.0]])).isfinite().all()


def test_samples_come_in_the_proportions_of_the_weights() -> None:
    torch.manual_seed(0)
    component = Independent(Normal(torch.tensor([[[-10.0], [10.0]]]), torch.ones(1, 2, 1)), 1)
    drawn = Mixture(torch.tensor([[0.3, 0.7]]).log(), component).sample((20000,))
    share = (drawn > 0).double().mean().item()
    assert abs(share - 0.7) < 4 * math.sqrt(0.21 / 20000)


def test_a_component_is_picked_for_each_sample_and_batch() -> None:
    component = Independent(Normal(torch.arange(12.0).reshape(2, 3, 2), torch.full((2, 3, 2), 1e-6)), 1)
    index = torch.tensor([[0, 2], [1, 1], [2, 0], [0, 0]])
    wanted = torch.stack([component.base_dist.loc[[0, 1], row] for row in index])
    for picked in (pick(component, index), pick.dispatch(object)(component, index)):
        assert picked.batch_shape == (4, 2)
        torch.testing.assert_close(picked.sample(), wanted, rtol=0, atol=1e-4)


@pytest.mark.parametrize("sample_shape", [(), (2,), (3, 2)])
@pytest.mark.parametrize("inner", [1, 4])
def test_of_mixtures_in_a_mixture_only_what_is_drawn_is_computed(
    sample_shape: tuple[int, ...], inner: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(0)
    batch, outer = 2, 3
    places = torch.arange(float(batch * outer * inner)).reshape(batch, outer, inner, 1)
    component = Independent(Normal(places, torch.full_like(places, 1e-6)), 1)
    log_weights = torch.randn(batch, outer, inner).log_softmax(-1)
    log_weights[0, 1, 0] = -math.inf if inner > 1 else 0.0
    mixtures = Mixture(log_weights, component)
    index = torch.tensor([[1, 2], [0, 0], [1, 1]]).repeat(1000, 1)
    computed = []
    drawn = Normal.sample
    monkeypatch.setattr(
        Normal,
        "sample",
        lambda self, shape=(): computed.append(shape.numel() * self.loc.numel()) or drawn(self, shape),
    )
    found = pick(mixtures, index).sample(sample_shape)
    assert found.shape == (*sample_shape, *index.shape, 1)
    assert sum(computed) == found.numel()
    which = found.round().long().squeeze(-1).reshape(-1, *index.shape)
    row, of_outer, of_inner = which // (outer * inner), which // inner % outer, which % inner
    assert torch.equal(row, torch.arange(batch).expand_as(row))
    assert torch.equal(of_outer, index.expand_as(of_outer))
    for number in torch.unique(row * outer + of_outer):
        mine = of_inner[(row * outer + of_outer) == number]
        shares = torch.bincount(mine, minlength=inner) / len(mine)
        wanted = mixtures.log_weights.reshape(-1, inner)[number].exp()
        assert ((shares - wanted).abs() <= 5 * (wanted * (1 - wanted) / len(mine)).sqrt()).all()


def test_monte_carlo_entropy_agrees_with_quadrature() -> None:
    torch.manual_seed(0)
    component = Independent(
        Normal(
            torch.tensor([[[-1.0], [2.0]]], dtype=torch.float64), torch.ones(1, 2, 1, dtype=torch.float64)
        ),
        1,
    )
    mixture = Mixture(torch.tensor([[0.5, 0.5]], dtype=torch.float64).log(), component)
    grid = torch.linspace(-12, 12, 20001, dtype=torch.float64)[:, None, None]
    log_density = mixture.log_prob(grid)
    wanted = -(log_density.exp() * log_density).sum().item() * 24 / 20000
    assert mixture.entropy().item() == pytest.approx(wanted, abs=0.1)


@pytest.mark.parametrize("rho", [0.0, 0.2, 0.45])
def test_circular_entropy_is_that_of_adaptive_quadrature(rho: float) -> None:
    from scipy.integrate import quad

    def integrand(angle: float) -> float:
        density = (1 + 2 * rho * math.cos(angle)) / (2 * math.pi)
        return -density * math.log(density)

    wanted = quad(integrand, -math.pi, math.pi, epsabs=1e-12)[0]
    found = circular_entropy(Cardioid(torch.tensor([rho], dtype=torch.float64)))
    assert found.item() == pytest.approx(wanted, abs=1e-10)


def test_circular_grid_wants_one_angle() -> None:
    with pytest.raises(ValueError, match="one angle"):
        circular_grid(normals(2, 3))


def test_marginal_of_independent_normals_is_one_of_them() -> None:
    component = normals(4, 3)
    value = torch.randn(4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    total = sum(marginal(component, i).log_prob(value[:, i : i + 1]) for i in range(3))
    torch.testing.assert_close(total, component.log_prob(value), rtol=1e-14, atol=0)


def test_marginal_of_an_unknown_density_says_what_to_do() -> None:
    with pytest.raises(UserError, match="Register one"):
        marginal(torch.distributions.Dirichlet(torch.ones(3)), 0)


def test_median_on_the_line_is_the_sample_median() -> None:
    torch.manual_seed(3)
    found = median(normals(2, 1), 20001)
    torch.testing.assert_close(found, normals(2, 1).base_dist.loc, rtol=0, atol=0.05)


def test_weights_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="do not fit"):
        Mixture(torch.zeros(4, 2), normals(4, 3, 1))
