"""Tests of the posterior against Bayesian linear regression, Hessians of the loss, and sums over all weights."""

import math

import pytest
import torch
from scipy import optimize
from torch import nn

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from framework.model import FrozenFrontEnd, Model
from framework.target import Target
from framework.uncertainty import reading_training
from plugins.uncertainty.laplace.posterior import (
    Eigen,
    collect,
    draw_deviations,
    fisher_of_raw,
    log_probs_and_scores,
    most_likely_precision,
)
from plugins.uncertainty.laplace.wrapper import Laplace

REAL, CLASSES = Target("real", ("x",)), Target("class", ("a", "b", "c"))


def model(head, target=REAL, length=3, encoders=()):
    torch.manual_seed(0)
    built = [build("encoder", resolve("encoder", part), input_shape=(length,)) for part in encoders]
    return Model(built, build("density_head", resolve("density_head", head), target=target), (length,))


def linear_data(dtype, count=60):
    generator = torch.Generator().manual_seed(1)
    inputs = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    noise = torch.randn(count, 1, generator=generator, dtype=torch.float64)
    target = inputs @ torch.tensor([[1.0], [-2.0], [0.5]], dtype=torch.float64) + 0.3 + 0.7 * noise
    return inputs.to(dtype), target.to(dtype)


def ones_appended(inputs):
    return torch.cat([inputs, torch.ones_like(inputs[:, :1])], 1).double()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("covariance", ["full", "kronecker"])
def test_a_linear_model_of_fixed_variance_has_the_posterior_of_bayesian_linear_regression(covariance, dtype):
    """Compare with the closed form (Bishop 2006, eq. 3.53-3.59); one raw parameter makes the Kronecker form exact."""
    inputs, target = linear_data(dtype)
    inner = model({"name": "gaussian", "scale": "fixed"}).to(dtype)
    phi = ones_appended(inputs)
    with torch.no_grad():  # the weights of highest likelihood
        best = torch.linalg.lstsq(phi, target.double()).solution
        inner.projection.weight.copy_(best[:3].T)
        inner.projection.bias.copy_(best[3])
    wrapper = Laplace(lambda: inner, covariance=covariance, samples=4000).eval().to(dtype)
    wrapper.calibrate([{"input": inputs, "target": target}])
    variance = inner(inputs).stddev[0, 0].double().item() ** 2
    precision = wrapper.precision.item()
    posterior = torch.linalg.inv(phi.T @ phi / variance + precision * torch.eye(4, dtype=torch.float64))
    new = 3 * torch.randn(5, 3, generator=torch.Generator().manual_seed(2), dtype=dtype)
    with torch.no_grad():
        density = wrapper(new)
    wide = ones_appended(new)
    mean, spread = wide @ best, variance + (wide @ posterior * wide).sum(1, keepdim=True)
    torch.testing.assert_close(density.mean.double(), mean, rtol=0, atol=1e-4)
    torch.testing.assert_close(density.variance.double(), spread, rtol=0.05, atol=0)

    def evidence(logarithm):
        """Return the log marginal likelihood of targets in the prior's predictive normal density, nats."""
        covariance = phi @ phi.T / math.exp(logarithm) + variance * torch.eye(60, dtype=torch.float64)
        normal = torch.distributions.MultivariateNormal(torch.zeros(60, dtype=torch.float64), covariance)
        return normal.log_prob(target[:, 0].double()).item()

    # the weights of highest likelihood are not those of highest posterior, so the evidence is Laplace's approximation
    log_precision = optimize.minimize_scalar(
        lambda point: -evidence(point), bounds=(-5, 5), method="bounded"
    ).x
    assert math.log(precision) == pytest.approx(log_precision, abs=0.05)


def test_the_information_of_a_classifier_is_the_hessian_of_its_loss():
    inner = model("categorical", CLASSES).double()
    inputs = torch.randn(20, 3, dtype=torch.float64)
    label = torch.arange(20) % 3
    weight = torch.cat([inner.projection.weight, inner.projection.bias[:, None]], 1).detach()

    def loss(flat):
        return nn.functional.cross_entropy(ones_appended(inputs) @ flat.view(3, 4).T, label, reduction="sum")

    hessian = torch.autograd.functional.hessian(loss, weight.flatten())
    wrapper = Laplace(lambda: inner).eval().double()
    wrapper.calibrate(
        [
            {"input": part, "target": labels}
            for part, labels in zip(inputs.split(8), label.split(8), strict=True)
        ]
    )
    vectors = wrapper.get_buffer("vectors0")
    torch.testing.assert_close(vectors * wrapper.eigenvalues @ vectors.T, hessian, rtol=1e-9, atol=1e-9)
    diagonal = Laplace(lambda: inner, covariance="diagonal").eval().double()
    diagonal.calibrate([{"input": inputs, "target": label}])
    torch.testing.assert_close(diagonal.eigenvalues, hessian.diagonal(), rtol=1e-9, atol=1e-9)


def test_the_information_of_a_normal_density_of_predicted_variance():
    """Compare with 1/σ² for the mean, and 2 (d log σ / d raw)² for the raw parameter of the spread."""
    head = build("density_head", resolve("density_head", "gaussian"), target=REAL)
    raw = torch.tensor([[0.3, -0.4]], dtype=torch.float64).expand(4000, 2)
    torch.manual_seed(0)
    information = fisher_of_raw(head, raw).mean(0)
    leaf = raw[:1].clone().requires_grad_()
    (slope,) = torch.autograd.grad(head(leaf).stddev.log().sum(), leaf)
    wanted = torch.diag(torch.stack([head(raw[:1]).stddev[0, 0] ** -2, 2 * slope[0, 1] ** 2]))
    torch.testing.assert_close(information, wanted.detach(), rtol=0.03, atol=0.02 * wanted.max().item())


def test_the_prior_precision_maximises_the_marginal_likelihood():
    values = torch.tensor([0.0, 1e-6, 0.2, 3.0, 500.0], dtype=torch.float64)
    identity = torch.eye(5, dtype=torch.float64)

    def log_evidence(log_precision, square):
        precision = math.exp(log_precision)
        log_determinant = torch.logdet(torch.diag(values) + precision * identity).item()
        return (5 * log_precision - precision * square - log_determinant) / 2

    for square in (1e-3, 0.7, 40.0):
        log_precision = math.log(most_likely_precision(values, square))
        best = optimize.minimize_scalar(
            lambda point, square=square: -log_evidence(point, square),
            bounds=(-25, 25),
            method="bounded",
            options={"xatol": 1e-9},
        ).x
        assert log_precision == pytest.approx(best, abs=1e-4)


@pytest.mark.parametrize("extreme, bound", [((torch.zeros(3), 1.0), 1e-12), ((torch.ones(3), 0.0), 1e12)])
def test_precisions_without_a_maximum_stop_at_a_bound(extreme, bound):
    precision = most_likely_precision(*extreme)
    assert math.isfinite(precision) and (precision < bound if bound < 1 else precision > bound)


@pytest.mark.parametrize("covariance", ["full", "kronecker", "diagonal"])
def test_the_covariance_of_draws_is_the_inverse_of_information_and_prior(covariance):
    generator = torch.Generator().manual_seed(3)
    features = torch.randn(30, 4, generator=generator, dtype=torch.float64)
    root = torch.randn(30, 2, 2, generator=generator, dtype=torch.float64)
    fisher = root @ root.mT
    eigen, count = collect([(features[:10], fisher[:10]), (features[10:], fisher[10:])], covariance)
    full = sum(torch.kron(one, torch.outer(phi, phi)) for one, phi in zip(fisher, features, strict=True))
    wanted = {
        "full": full,
        "kronecker": torch.kron(fisher.mean(0), features.T @ features),
        "diagonal": torch.diag(full.diagonal()),
    }[covariance]
    precision = torch.tensor(0.3, dtype=torch.float64)
    # unit vectors instead of noise give the columns of a root of the covariance
    columns = draw_deviations(eigen, precision, torch.eye(8, dtype=torch.float64), (2, 4)).flatten(1)
    inverse = torch.linalg.inv(wanted + precision * torch.eye(8, dtype=torch.float64))
    torch.testing.assert_close(columns.T @ columns, inverse, rtol=1e-8, atol=1e-10)
    assert count == 30 and isinstance(eigen, Eigen)


def test_a_sharp_prior_gives_the_model_and_more_samples_the_same_mean():
    inputs, target = linear_data(torch.float32)
    inner = model("gaussian", encoders=({"name": "mlp", "widths": [16]},)).eval()
    sharp = Laplace(lambda: inner, prior_precision=1e12).eval()
    sharp.calibrate([{"input": inputs, "target": target}])
    broad = Laplace(lambda: inner, prior_precision=1e-2).eval()
    broad.calibrate([{"input": inputs, "target": target}])
    with torch.no_grad():
        alone = inner(inputs)
        torch.testing.assert_close(sharp(inputs).mean, alone.mean, rtol=0, atol=1e-4)
        torch.testing.assert_close(sharp(inputs).log_prob(target), alone.log_prob(target), rtol=0, atol=1e-3)
        for samples in (2, 10):
            broad.samples = samples
            torch.testing.assert_close(broad(inputs).mean, alone.mean, rtol=1e-4, atol=1e-4)
        assert (broad(inputs).variance > alone.variance).all()


def test_the_training_split_is_read_through_fixed_encoders():
    inputs, target = linear_data(torch.float32)
    inner = model({"name": "gaussian", "scale": "fixed"})
    wrapper = Laplace(lambda: inner, prior_precision=1.0)

    class Doubling(nn.Module):
        def forward(self, inputs):
            return 2 * inputs

    front = FrozenFrontEnd([], wrapper)
    front.encoders.append(Doubling())
    validation = [{"input": inputs[:20], "target": target[:20]}]
    with reading_training(front.eval(), [{"input": inputs, "target": target}] * 2):
        front.calibrate(validation)
    assert wrapper.training_split is None and "120 samples" in wrapper.remark
    phi = ones_appended(2 * inputs)
    variance = inner(inputs).stddev[0, 0].double().item() ** 2
    vectors = wrapper.get_buffer("vectors0")
    information = vectors * wrapper.eigenvalues @ vectors.T
    torch.testing.assert_close(information, 2 * phi.T @ phi / variance, rtol=1e-5, atol=1e-4)


def test_models_without_one_final_linear_layer_are_refused():
    inner = model("gaussian")
    with pytest.raises(ConfigError, match=r"Put laplace first: uncertainty=\[laplace,\.\.\.\]"):
        Laplace(lambda: build("uncertainty", resolve("uncertainty", "temperature"), model=lambda: inner))
    with pytest.raises(ConfigError, match="has no such layer"):
        Laplace(lambda: model("extra_trees"))
    wide = model("gaussian", length=2000)
    with pytest.raises(ConfigError, match=r"has 4,002 weights.*Set covariance to kronecker or diagonal"):
        Laplace(lambda: wide)
    wrapper = Laplace(lambda: inner)
    wrapper.samples = 0
    with pytest.raises(ConfigError, match="samples is 0, expected 1 or more"):
        wrapper(torch.zeros(2, 3))


@pytest.mark.parametrize(
    "config", [{"prior_precision": 0.0}, {"prior_precision": "best"}, {"covariance": "none"}]
)
def test_a_config_out_of_range_is_refused(config):
    with pytest.raises(ConfigError, match=r"uncertainty\."):
        resolve("uncertainty", {"name": "laplace", **config})


def test_deviations_do_not_depend_on_the_signs_or_the_order_of_eigenvectors():
    generator = torch.Generator().manual_seed(5)
    root = torch.randn(6, 6, generator=generator, dtype=torch.float64)
    values, vectors = torch.linalg.eigh(root @ root.T)
    factors = [torch.linalg.eigh(part @ part.T) for part in (root[:2, :2], root[:3, :3])]
    noise = torch.randn(4, 6, generator=generator, dtype=torch.float64)
    precision = torch.tensor(0.3, dtype=torch.float64)
    (raw_values, raws), (feature_values, features) = factors
    product = torch.outer(raw_values, feature_values)
    pairs = (
        (Eigen(values, (vectors,)), Eigen(values.flip(0), (-vectors.flip(1),))),
        (
            Eigen(product.flatten(), (raws, features)),
            Eigen(product.flip(0).flatten(), (-raws.flip(1), features * torch.tensor([1.0, -1.0, 1.0]))),
        ),
    )
    for eigen, same in pairs:
        torch.testing.assert_close(
            draw_deviations(eigen, precision, noise, (2, 3)), draw_deviations(same, precision, noise, (2, 3))
        )


@pytest.mark.parametrize("accepts_more_dimensions", [True, False])
def test_scores_of_several_targets_are_those_of_each_target(accepts_more_dimensions):
    head = build("density_head", resolve("density_head", "gaussian"), target=REAL)
    generator = torch.Generator().manual_seed(6)
    raw = torch.randn(5, 2, generator=generator)
    targets = torch.randn(4, 5, 1, generator=generator)

    def density_of(raw):
        if not accepts_more_dimensions and raw.dim() > 2:
            raw = raw[0] + 1  # another density, of another shape
        return head(raw)

    logs, scores = log_probs_and_scores(density_of, raw, targets)
    for number, target in enumerate(targets):
        leaf = raw.clone().requires_grad_()
        log_prob = head(leaf).log_prob(target)
        (expected,) = torch.autograd.grad(log_prob.sum(), leaf)
        torch.testing.assert_close(logs[number], log_prob)
        torch.testing.assert_close(scores[:, number], expected.double())
