import math
from functools import partial

import mpmath
import numpy as np
import pytest
import torch
from scipy import stats

from framework.configuration.schema import build, resolve
from framework.distributions.density import Mixture, circular_grid
from framework.distributions.protocol import marginal, median, pick
from framework.errors import ConfigError
from framework.geometry import aligned_rotations as functions
from framework.geometry import quaternions
from framework.geometry.rotation import viewpoint_rotation
from framework.heads import angle_marginals, peak_quadrature
from framework.heads.rotations import grown_matrix
from framework.heads.viewpoints import Angle
from framework.target import Target
from plugins.density_head.matrix_fisher.density import MatrixFisher
from plugins.density_head.matrix_fisher.head import LARGEST_PARAMETER
from plugins.density_head.matrix_fisher.rows import TARGET, log_constant

FALLS = (0, 1e-12, 1e-3, 0.5, 3, 20, 43.9, 44.1, 300, 1e4, 1e8, 1e12, 1e16)
AROUND = (0, 1e-30, 1e-8, 1e-3, 0.5, 3, 20, 50, 1e3, 1e6, 1e12, 1e20)
PARAMETERS = {
    "F = 0": np.zeros((3, 3)),
    "equal": 2 * np.eye(3),
    "equal, s3 < 0": np.diag([2.0, 2.0, -2.0]),
    "rank one": np.diag([3.0, 0.0, 0.0]),
    "two equal": np.diag([1.0, 4.0, 1.0]),
    "generic": np.array([[0.5, -1.25, 0.75], [2.0, 0.125, -0.5], [0.25, 1.5, -1.0]]),
}


def double(numbers):
    return torch.as_tensor(numbers, dtype=torch.float64)


def random_rotations(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    turn = torch.randn(count, 4, dtype=torch.float64, generator=generator)
    turn = turn / turn.norm(dim=-1, keepdim=True)
    return quaternions.matrix_less_identity(turn) + torch.eye(3).double()


def chart(points=72):
    """Return azimuth, elevation and tilt (point, point, point, 3), and weights of ∫ da de dt (point, 1).

    The weights are spectrally exact.
    """
    turn = (torch.arange(points).double() / points * 2 - 1) * math.pi
    nodes, weights = np.polynomial.legendre.leggauss(points)
    axes = torch.meshgrid(turn, double(nodes) * math.pi / 2, turn, indexing="ij")
    return torch.stack(axes, -1), double(weights)[:, None] * math.pi / 2 * (2 * math.pi / points) ** 2


def build_head(config="matrix_fisher", target=TARGET):
    return build("density_head", resolve("density_head", config), target=target)


# ---- quaternions -----------------------------------------------------------------------------------------


def test_quaternions_are_the_rotations_of_viewpoints():
    torch.manual_seed(0)
    angles = 5 * torch.randn(500, 3).double()
    rotation, turn = viewpoint_rotation(angles), quaternions.of_viewpoint(angles)
    identity = torch.eye(3).double()
    torch.testing.assert_close(
        quaternions.matrix_less_identity(turn) + identity, rotation, rtol=0, atol=4e-15
    )
    torch.testing.assert_close(
        (quaternions.of_matrix(rotation) * turn).sum(-1).abs(), torch.ones(500).double()
    )
    back = quaternions.to_viewpoint(turn)
    torch.testing.assert_close(viewpoint_rotation(back), rotation, rtol=0, atol=8e-15)
    assert back[:, 1].abs().max() <= math.pi / 2
    assert back[:, [0, 2]].abs().max() <= math.pi
    first, second = turn[:250], turn[250:]
    product = quaternions.matrix_less_identity(quaternions.product(first, second)) + identity
    torch.testing.assert_close(product, rotation[:250] @ rotation[250:], rtol=0, atol=8e-15)


@pytest.mark.parametrize("angles", [[0, 0, 0], [1, math.pi / 2, 0.5], [1, -math.pi / 2, 0.5], [math.pi] * 3])
def test_viewpoints_at_the_poles_and_borders_turn_back(angles):
    rotation = viewpoint_rotation(double(angles))
    for turn in (quaternions.of_viewpoint(double(angles)), quaternions.of_matrix(rotation)):
        back = quaternions.to_viewpoint(turn)
        assert back[1].abs() <= math.pi / 2
        torch.testing.assert_close(viewpoint_rotation(back), rotation, rtol=0, atol=4e-15)


# ---- the normalising constant and its derivatives ----------------------------------------------------------


def test_height_agrees_with_another_quadrature_of_another_pairing():
    falls = [
        (smallest, middle, largest)
        for i, smallest in enumerate(FALLS)
        for j, middle in enumerate(FALLS[i:], i)
        for largest in FALLS[j:]
    ]
    heights = -functions.log_height(double(falls))
    reference = double([log_constant(*map(float, row)) for row in falls])
    error = (heights - reference).abs() / reference.abs().clamp(min=1)
    assert error.max() < 1e-12, falls[error.argmax()]


@pytest.mark.parametrize("fall", AROUND)
def test_height_agrees_with_closed_forms(fall):
    with mpmath.workdps(40):
        exact = mpmath.mpf(fall)
        # Kummer's functions of an axis about which all is symmetric (Mardia & Jupp 2000, 9.6.2)
        references = {
            (fall, fall, fall): mpmath.hyp1f1(1.5, 2, -exact),
            (0, 0, fall): mpmath.hyp1f1(0.5, 2, -exact),
            (0, fall, fall): -mpmath.expm1(-exact) / exact if fall else mpmath.mpf(1),
        }
    for falls, constant in references.items():
        for dtype in (torch.float32, torch.float64):
            height = -functions.log_height(torch.tensor(falls, dtype=dtype))
            if dtype == torch.float64 or float(torch.tensor(fall, dtype=dtype)) == fall:
                assert height.item() == pytest.approx(float(mpmath.log(constant)), rel=1e-12, abs=1e-14)


@pytest.mark.parametrize("fall", AROUND)
def test_moments_agree_with_closed_forms(fall):
    with mpmath.workdps(40):
        kummer = [mpmath.hyp1f1(mpmath.mpf(3) / 2 + n, 2 + n, -mpmath.mpf(fall)) for n in range(3)]
        second, fourth = kummer[1] / kummer[0] / 4, kummer[2] / kummer[0] * 5 / 8  # E q₁², E (1 - q₀²)²
    falls = double([fall] * 3)
    torch.testing.assert_close(
        functions.second_moments(falls), double([float(second)] * 3), rtol=1e-12, atol=0
    )
    moments = functions.fourth_moments(falls)
    torch.testing.assert_close(moments[1:, 1:].sum(), double(float(fourth)), rtol=1e-12, atol=0)
    torch.testing.assert_close(moments.sum(), double(1.0), rtol=1e-12, atol=0)
    product_moment = double(float(fourth)) / 15  # symmetric: E qᵢ⁴ = 3 E qᵢ²qⱼ²
    torch.testing.assert_close(
        moments[1:, 1:], product_moment * (1 + 2 * torch.eye(3).double()), rtol=1e-11, atol=0
    )


def test_height_beyond_1e12_and_of_nothing():
    falls = double([[1e30, 1e30, 1e30], [0, 1e24, 1e30], [0, 0, 1e30]])
    # Laplace's method: exact to 1/λ
    wanted = [-0.5 * math.log(math.pi) - 1.5 * math.log(1e30), -0.5 * math.log(1e54), None]
    heights = -functions.log_height(falls)
    assert heights[:2].tolist() == pytest.approx(wanted[:2], rel=1e-13)
    assert heights.isfinite().all()
    assert functions.log_height(torch.zeros(0, 3)).shape == (0,)


@pytest.mark.parametrize("name", PARAMETERS)
def test_mean_rotation_and_constant_agree_with_brute_force(name):
    parameter = double(PARAMETERS[name])
    angles, weight = chart(48)
    rotations = viewpoint_rotation(angles)
    weight = weight * torch.cos(angles[..., 1]) / (8 * math.pi**2)
    terms = weight * (rotations * parameter).sum((-2, -1)).exp()
    frame = functions.align(parameter)
    trace = functions.align(parameter).falls.sum() / 4
    assert (trace - functions.log_height(frame.falls)).item() == pytest.approx(
        terms.sum().log().item(), abs=1e-13
    )
    mean = (terms[..., None, None] * rotations).sum((0, 1, 2)) / terms.sum()
    torch.testing.assert_close(functions.mean_rotation(parameter), mean, rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", PARAMETERS)
def test_first_and_second_derivatives_agree_with_finite_differences(name):
    angles = double([[0.4, -0.9, 2.0], [3.0, 1.2, -1.0]]).requires_grad_()
    parameter = double(PARAMETERS[name]).requires_grad_()

    def log_prob(angles, parameter):
        return functions.log_prob(quaternions.of_viewpoint(angles), parameter)

    assert torch.autograd.gradcheck(log_prob, (angles, parameter))
    assert torch.autograd.gradgradcheck(log_prob, (angles, parameter))
    assert torch.autograd.gradcheck(functions.mean_rotation, parameter)


@pytest.mark.parametrize("concentration", [1e3, 1e6, 1e12, 1e20])
def test_gradient_of_a_concentrated_density_keeps_its_digits(concentration):
    parameter = (concentration * torch.eye(3).double()).requires_grad_()
    identity = double([1.0, 0, 0, 0])
    (gradient,) = torch.autograd.grad(functions.log_prob(identity, parameter), parameter)
    with mpmath.workdps(40):
        fall = 4 * mpmath.mpf(concentration)
        second = mpmath.hyp1f1(2.5, 3, -fall) / mpmath.hyp1f1(1.5, 2, -fall) / 4
    # I - E R = 2 (E q₂² + E q₃²) on the diagonal
    torch.testing.assert_close(gradient, 4 * float(second) * torch.eye(3).double(), rtol=1e-12, atol=0)


def test_third_derivatives_are_refused():
    parameter = torch.eye(3).double().requires_grad_()
    with pytest.raises(RuntimeError, match=r"no third derivative.*create_graph"):
        torch.autograd.grad(functions.mean_rotation(parameter).sum(), parameter, create_graph=True)


# ---- the density -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PARAMETERS)
def test_integral_marginals_and_entropies_agree_with_brute_force(name):
    density = MatrixFisher(double(PARAMETERS[name]))
    angles, weight = chart()
    log_density = density.log_prob(angles)
    mass = log_density.exp() * weight
    assert mass.sum().item() == pytest.approx(1, abs=1e-12)
    surprise = -(mass * log_density).sum().item()
    assert density.entropy().item() == pytest.approx(surprise, abs=5e-6)  # log cos e bends at the poles
    node_weights = weight[:, 0]
    step = 2 * math.pi / len(node_weights)
    for index, axis, length in (
        (0, angles[:, 0, 0, 0], step),
        (1, angles[0, :, 0, 1], node_weights / step**2),
    ):
        other_angles = [number for number in range(3) if number != index]
        wanted = mass.sum(other_angles) / length
        probabilities = marginal(density, index).log_prob(axis[:, None]).exp()
        torch.testing.assert_close(probabilities, wanted, rtol=1e-9, atol=1e-11)
        per_angle = -(wanted * length * wanted.log()).sum().item()
        limit = 1e-7 if index == 0 else 5e-6
        assert marginal(density, index).entropy().item() == pytest.approx(per_angle, abs=limit)
    probabilities = marginal(density, 2).log_prob(angles[0, 0, :, 2, None]).exp()
    torch.testing.assert_close(probabilities, mass.sum((0, 1)) / step, rtol=1e-9, atol=1e-11)


def test_uniform_rotations_have_the_entropy_of_the_chart():
    density = MatrixFisher(torch.zeros(3, 3).double())
    wanted = math.log(8 * math.pi**2) + 1 - math.log(2)
    assert density.entropy().item() == pytest.approx(wanted, abs=2e-6)
    assert density.log_prob(double([1.0, 0.3, 2.0])).item() == pytest.approx(
        math.log(math.cos(0.3) / (8 * math.pi**2)), rel=1e-14
    )


@pytest.mark.parametrize(
    "concentration",
    [1e8, pytest.param(1e4, marks=pytest.mark.slow), pytest.param(1e12, marks=pytest.mark.slow)],
)
def test_concentrated_densities_are_normal(concentration):
    viewpoint = double([2.0, 0.6, -1.0])
    density = MatrixFisher(concentration * viewpoint_rotation(viewpoint))
    torch.testing.assert_close(density.mode, viewpoint, rtol=0, atol=1e-14)
    # small rotations have variance 1/(2s) about each axis; cos e da de dt is their volume
    entropy = 0.5 * math.log(math.pi * math.e / concentration)
    limit = 5 / concentration + 2e-6
    assert density.entropy().item() == pytest.approx(3 * entropy - math.log(math.cos(0.6)), abs=limit)
    for index, spread in ((0, 1 / math.cos(0.6)), (1, 1.0), (2, 1 / math.cos(0.6))):
        alone = marginal(density, index)
        assert alone.entropy().item() == pytest.approx(entropy + math.log(spread), abs=5 * limit)
        assert alone.mode.item() == pytest.approx(viewpoint[index].item(), abs=2 / concentration + 1e-8)
        deviation = spread / math.sqrt(2 * concentration)
        offsets = double([-2.0, 0.0, 1.0])
        log_prob = alone.log_prob((viewpoint[index] + deviation * offsets)[:, None])
        wanted = -offsets.square() / 2 - math.log(deviation * math.sqrt(2 * math.pi))
        torch.testing.assert_close(log_prob, wanted, rtol=0, atol=10 / math.sqrt(concentration) + 1e-8)


@pytest.mark.parametrize("concentration", [1e-3, 1.0, 1e2, 1e4])
def test_the_mode_of_an_angle_is_its_highest_place(concentration):
    """Compare the mode for ranks 0 to 3 with a fine grid that is finer about its own highest point.

    For rank one the angle has two narrow peaks, of which only one is near the likeliest rotation's.
    """
    left, right = random_rotations(2, seed=3)
    shapes = [(0, 0, 0), (1, 0, 0), (1, 0.6, 0), (1, 0.5, 0.1), (1, 0.6, -0.6)]
    parameters = [left @ torch.diag(concentration * double(shape)) @ right.T for shape in shapes]
    density = MatrixFisher(torch.stack(parameters))
    for index, most in enumerate((math.pi, math.pi / 2, math.pi)):
        alone = Angle(density, index, density.frame)
        count = 801 if concentration > 1e3 else 201
        grid = torch.linspace(-most, most, count).double()
        coarse = alone.log_prob(grid[:, None, None].expand(-1, len(shapes), 1))
        around = 2 * most / count * torch.linspace(-1, 1, 41).double()
        fine = alone.log_prob((grid[coarse.argmax(0)] + around[:, None]).unsqueeze(-1))
        highest = torch.maximum(coarse.amax(0), fine.amax(0))
        assert (alone.log_prob(alone.mode) >= highest - 1e-3).all()


@pytest.mark.parametrize("concentration", [0.0, 3.0, 1e3, 1e6])
@pytest.mark.parametrize("shape", [(1, 0, 0), (1, 0.6, -0.6), (1, 0.5, 0.1)])
def test_marginals_of_ridges_and_flat_directions_integrate_to_one(concentration, shape):
    left, right = random_rotations(2, seed=3)
    density = MatrixFisher(left @ torch.diag(concentration * double(shape)) @ right.T)
    for index, most in enumerate((math.pi, math.pi / 2, math.pi)):
        alone = Angle(density, index, density.frame)
        points, weights = peak_quadrature.nodes(
            lambda angle, alone=alone: alone.log_prob(angle[:, None]),
            -most,
            most,
            torch.zeros(()),
            index != 1,
        )
        assert (weights * alone.log_prob(points[:, None]).exp()).sum().item() == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize(
    "index, count",
    [
        pytest.param(index, count, marks=() if place % 3 == index else pytest.mark.slow)
        for place, count in enumerate(angle_marginals.FEW)
        for index in range(3)
    ],
)
def test_few_nodes_do_up_to_their_bound(index, count, monkeypatch):
    """Check the bound itself, for peaks, ridges and flat directions, wherever they lie and far from them too."""
    bound = angle_marginals.FEW[count]
    falls = double([[1, 1, 1], [0.5, 1, 1], [0.01, 1, 1], [0.4, 0.6, 1], [0, 1, 1]]) * bound * (1 - 1e-9)
    shapes = torch.diag_embed(falls.sum(-1, keepdim=True) / 4 - falls / 2)
    rotations = torch.stack([random_rotations(len(shapes), seed) for seed in range(9)])
    density = MatrixFisher(rotations @ shapes @ random_rotations(len(shapes), 10))
    torch.testing.assert_close(density.frame.falls, falls.expand(9, -1, -1))
    reach = math.pi / 2 - 0.02 if index == 1 else math.pi
    places = torch.linspace(-reach, reach, 31).double()[:, None, None, None].expand(-1, 9, len(shapes), 1)
    log_prob = marginal(density, index).log_prob(places)
    monkeypatch.setattr(angle_marginals, "FEW", {1500: 1e9})
    torch.testing.assert_close(log_prob, marginal(density, index).log_prob(places), rtol=0, atol=5e-12)


@pytest.mark.parametrize("name", [*PARAMETERS, "concentrated", "ring"])
def test_samples_follow_the_density(name):
    torch.manual_seed(5)
    left, right = random_rotations(2, seed=1)
    more = {"concentrated": double([3e5, 1e5, 2e4]), "ring": double([800.0, 500.0, -500.0])}
    parameter = left @ torch.diag(more[name]) @ right.T if name in more else double(PARAMETERS[name])
    density = MatrixFisher(parameter)
    count = 20_000
    samples = density.sample((count,))
    assert samples[:, 1].abs().max() <= math.pi / 2
    assert samples[:, [0, 2]].abs().max() <= math.pi
    rotations = viewpoint_rotation(samples)
    deviation = (rotations.mean(0) - density.mean_rotation) / rotations.std(0) * count**0.5
    assert deviation.abs().max() < 4.5
    surprise = -density.log_prob(samples)
    error = (surprise.mean() - density.entropy()) / (surprise.std() + 1e-9) * count**0.5
    assert error.abs() < 4.5
    for index in range(3):
        sorted_ = samples[:, index].sort().values
        # the distribution function between neighbouring hundredths of the samples, by Gauss-Legendre
        marks = torch.cat([sorted_[:1], sorted_[100::200], sorted_[-1:]])
        nodes, weights = (double(numbers) for numbers in np.polynomial.legendre.leggauss(12))
        middle, half = (marks[1:] + marks[:-1]) / 2, (marks[1:] - marks[:-1]) / 2
        inside = marginal(density, index).log_prob((middle[:, None] + half[:, None] * nodes)[..., None]).exp()
        below = ((inside * weights).sum(-1) * half).cumsum(0)
        rank = torch.searchsorted(sorted_, marks[1:]).double() / count
        # Kolmogorov's distance, 1.95/√n at 0.1 %
        assert (below - rank).abs().max() < 1.95 / count**0.5 + 1e-3, index


@pytest.mark.parametrize("fall", [1e6, 1e12, 1e24])
def test_samples_of_concentrated_densities_are_normal(fall):
    torch.manual_seed(2)
    aligned = functions.sample(double([fall, 3 * fall, 1e3 * fall]).expand(20_000, 3))
    scaled = aligned[:, 1:] * (2 * double([fall, 3 * fall, 1e3 * fall])).sqrt() * aligned[:, :1].sign()
    for number in scaled.T:
        assert stats.kstest(number.numpy(), "norm").pvalue > 1e-3
        assert len(number.unique()) == 20_000


@pytest.mark.parametrize(
    "falls", [(0, 0, 0), (0, 0, 1e30), (0, 1e30, 1e30), (1e30,) * 3, (0, 0, 4), (5, 5, 5), (1, 1e4, 1e12)]
)
def test_more_than_44_percent_of_proposals_are_accepted(falls, monkeypatch):
    torch.manual_seed(0)
    monkeypatch.setattr(functions, "SAMPLING_ROUNDS", 1)
    proposals = []
    propose = functions._propose
    monkeypatch.setattr(
        functions, "_propose", lambda *arguments: proposals.append(propose(*arguments)) or proposals[-1]
    )
    functions.sample(double(falls).expand(20_000, 3))
    assert (~proposals[0][1]).double().mean() > 0.44


def test_sampling_ends_whatever_it_is_given():
    assert functions.sample(double([[math.nan] * 3, [0, 1, math.inf]])).shape == (2, 4)
    assert functions.sample(torch.zeros(0, 2, 3)).shape == (0, 2, 4)


def test_no_sampled_rotation_is_likelier_than_the_mode():
    torch.manual_seed(0)
    density = MatrixFisher(torch.stack([double(numbers) for numbers in PARAMETERS.values()]))
    value = torch.cat([density.mode[None], density.sample((2000,))])
    of_rotation = functions.log_prob(quaternions.of_viewpoint(value), density.parameter)
    assert (of_rotation[0] >= of_rotation[1:] - 1e-12).all()


def test_an_elevation_outside_the_chart_is_the_same_rotation_inside():
    torch.manual_seed(0)
    density = MatrixFisher(3 * torch.randn(20, 3, 3).double())
    azimuth, elevation, tilt = torch.randn(3, 20).double()
    inside = torch.stack([azimuth, elevation, tilt], -1)
    outside = torch.stack([azimuth + math.pi, math.pi - elevation, tilt + math.pi], -1)
    torch.testing.assert_close(density.log_prob(outside), density.log_prob(inside), rtol=1e-13, atol=1e-13)
    alone = marginal(density, 1)
    torch.testing.assert_close(alone.log_prob(outside[:, 1:2]), alone.log_prob(inside[:, 1:2]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_poles_are_finite(dtype):
    value = torch.tensor([[1.0, math.pi / 2, 0.5], [1.0, -math.pi / 2, 0.5]], dtype=dtype, requires_grad=True)
    parameter = (5 * torch.eye(3, dtype=dtype)).requires_grad_()
    log_prob = MatrixFisher(parameter).log_prob(value)
    gradients = torch.autograd.grad(log_prob.sum(), (value, parameter))
    assert log_prob.isfinite().all()
    assert all(gradient.isfinite().all() for gradient in gradients)


@pytest.mark.parametrize("batch", [(), (2,), (3, 2), (0,)])
def test_marginals_of_any_batch(batch):
    density = MatrixFisher(torch.randn(*batch, 3, 3))
    for index in range(3):
        alone = marginal(density, index)
        assert alone.log_prob(torch.zeros(4, *batch, 1)).shape == (4, *batch)
        assert alone.log_prob(torch.zeros(4, *batch, 1)).dtype == torch.float32
        assert alone.sample((5,)).shape == (5, *batch, 1)
        assert alone.mode.shape == (*batch, 1)
        assert alone.entropy().shape == batch
    _, log_density = circular_grid(marginal(density, 0))
    torch.testing.assert_close(log_density.exp().mean(0) * 2 * math.pi, torch.ones(batch), rtol=1e-5, atol=0)


def test_picked_components_are_those_at_the_index():
    density = MatrixFisher(torch.randn(2, 4, 3, 3))
    index = torch.tensor([[0, 3], [2, 1], [1, 1]])
    picked = pick(density, index)
    assert picked.batch_shape == (3, 2)
    for sample, row in np.ndindex(3, 2):
        assert torch.equal(picked.parameter[sample, row], density.parameter[row, index[sample, row]])


# ---- the head ------------------------------------------------------------------------------------------------


def test_components_of_a_mixture_start_at_rotations_that_are_far_apart():
    torch.manual_seed(0)
    config = {"name": "mixture", "components": 24, "component": {"name": "matrix_fisher"}}
    first, second = build_head(config), build_head(config)
    offsets = first.spread.detach()
    torch.testing.assert_close(offsets.square().mean(), torch.tensor(1.0))
    modes = viewpoint_rotation(first(torch.zeros(1, first.size)).components.mode[0])
    torch.testing.assert_close(modes.flatten(1) * math.sqrt(3), offsets, atol=1e-5, rtol=1e-5)
    cosines = (modes[:, None] * modes[None]).sum((-2, -1)) / 2 - 1 / 2
    assert cosines.fill_diagonal_(-1).max().acos().rad2deg() > 80
    assert not torch.allclose(
        offsets, second.spread, atol=0.1
    )  # members of an ensemble start at different rotations


def test_the_grown_matrix_is_smooth_at_zero_and_bounded():
    grow = partial(grown_matrix, largest=LARGEST_PARAMETER)
    zero = torch.zeros(3, 3).double().requires_grad_()
    jacobian = torch.autograd.functional.jacobian(grow, zero)
    torch.testing.assert_close(jacobian.reshape(9, 9), torch.eye(9).double(), rtol=0, atol=0)
    for size in (1.0, 30.0, 2e3, 3e3, 1e38, 1.7e308):
        raw = torch.full((3, 3), size, dtype=torch.float64 if size > 1e38 else torch.float32)
        parameter = grow(raw)
        assert parameter.norm() <= LARGEST_PARAMETER * (1 + 1e-12)
        norm = min(3 * size, 1e6)
        wanted = min(norm * (1 + norm**2 / 16) ** 1.5, LARGEST_PARAMETER)
        assert parameter.norm().item() == pytest.approx(wanted, rel=1e-6)
    generic = torch.randn(3, 3).double().requires_grad_()
    assert torch.autograd.gradcheck(grow, generic)


MIXED = {"name": "mixture", "components": 3, "component": {"name": "matrix_fisher"}}


def test_a_mixture_of_matrix_fishers():
    torch.manual_seed(0)
    head = build_head(MIXED).double().eval()
    raw = (0.3 * torch.randn(4, head.size).double()).requires_grad_()
    density = head(raw)
    assert isinstance(density, Mixture)
    angles, weight = chart(48)
    with torch.no_grad():
        log_density = density.log_prob(angles.unsqueeze(-2).expand(48, 48, 48, 4, 3))
        parts = MatrixFisher(density.components.parameter.movedim(1, 0))
        component_log_prob = torch.stack(
            [parts.log_prob(angles[1, 2, 3].expand(4, 3))[k] for k in range(3)], -1
        )
        torch.testing.assert_close(
            log_density[1, 2, 3], torch.logsumexp(density.log_weights + component_log_prob, -1)
        )
        torch.testing.assert_close(
            (log_density.exp() * weight[..., None]).sum((0, 1, 2)), torch.ones(4).double()
        )
        samples = density.sample((4000,))
        surprise = -density.log_prob(samples)
        assert ((surprise.mean(0) - density.entropy()).abs() < 5 * surprise.std(0) / 1000**0.5).all()
        alone = marginal(density, 0)
        turn, log_prob = circular_grid(alone, 48)
        assert torch.equal(turn, turn.sort().values)
        wanted = (log_density.exp() * weight[..., None]).sum((1, 2)) / (2 * math.pi / 48)
        torch.testing.assert_close(log_prob.exp(), wanted, rtol=1e-6, atol=1e-8)
        assert alone.entropy().isfinite().all()
        assert median(density, 100).shape == density.mode.shape == (4, 3)
    head.loss(raw, samples[0]).sum().backward()
    assert raw.grad.isfinite().all()


@pytest.mark.parametrize("names", [("azimuth",), ("tilt", "azimuth", "elevation"), ("x", "y", "z")])
def test_other_angles_are_refused(names):
    with pytest.raises(ConfigError, match=rf"matrix_fisher.*azimuth, elevation, tilt.*{', '.join(names)}"):
        build_head(target=Target("angle", names))


@pytest.mark.parametrize("kind", ["real", "class"])
def test_other_targets_are_refused(kind):
    with pytest.raises(ConfigError, match=f"matrix_fisher.*'{kind}'"):
        build_head(target=Target(kind, ("azimuth", "elevation", "tilt")))
