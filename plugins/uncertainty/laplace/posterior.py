"""Gaussian posterior of the weights of a linear layer: Fisher information, precision of the prior, draws.

The layer maps features φ, to which a 1 is appended if it has a bias, to raw parameters W φ. With the prior N(0, I/λ) of
each weight and the Fisher information H of all training samples, the Laplace approximation of the posterior is
N(W*, (H + λ I)⁻¹) around the trained weights W* (Daxberger et al. 2021). All three forms of H are stored by
their eigenvalues and eigenvectors, so that any λ can be used afterwards.
"""

import math
from collections.abc import Callable, Iterable
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions import Distribution

from framework.errors import UserError

Covariance = Literal["full", "kronecker", "diagonal"]
DRAWS = 32
"""Number of targets per training sample that are drawn for the Fisher information, if it has no closed form."""
LARGEST_EXPONENT = 30.0
"""Largest |log λ| of the precision λ of the prior."""
STEPS = 80
"""Number of halvings of the interval of log λ, after which its length is below the rounding error of float64."""


class Eigen(NamedTuple):
    """Fisher information of the weights (raw, feature), by eigenvalues and eigenvectors.

    Attributes:
        values: eigenvalues, (raw · feature,) float64, at least 0; the diagonal itself for a diagonal matrix.
        vectors: the eigenvectors as columns: one matrix for "full"; the matrices (raw, raw) and (feature, feature) of
            the two Kronecker factors for "kronecker"; none for "diagonal".
    """

    values: Tensor
    vectors: tuple[Tensor, ...]


def fisher_of_raw(
    density_of: Callable[[Tensor], Distribution], raw: Float[Tensor, "batch raw"]
) -> Float[Tensor, "batch raw raw"]:
    """Return the Fisher information of the raw parameters of each sample, float64.

    It is E[g gᵀ] over targets y of the predicted density, with the score g = ∇ log p(y | raw). Where the raw parameters
    are natural parameters, the information equals the generalised Gauss-Newton matrix (Martens 2020). The information
    is positive semi-definite for every density. For classes, the expectation is a sum over all classes. If the Hessian
    of -log p is the same for all y, as for a normal density of fixed variance, the expectation is this Hessian. For any
    other density, it is a mean over DRAWS draws of y.

    Args:
        density_of: function from raw parameters to densities of batch_shape (batch,).
        raw: raw parameters.

    Raises:
        UserError: a score is not finite.
    """
    with torch.enable_grad():
        leaf = raw.detach().clone().requires_grad_()
        density = density_of(leaf)
        if density.has_enumerate_support:
            targets = list(density.enumerate_support())
        else:
            with torch.no_grad():
                targets = [density.sample() for _ in range(DRAWS)]
            constant = _constant_hessian(density, leaf, targets)
            if constant is not None:
                return constant
        logs, scores = log_probs_and_scores(density_of, raw, torch.stack(targets))
    if not scores.isfinite().all():
        row = int((~scores.isfinite()).flatten(1).any(1).nonzero()[0])
        raise UserError(
            "uncertainty laplace: the gradient of the log-density in the raw parameters is not finite for sample "
            f"{row} of a training batch. Check this sample and the training, which may have diverged."
        )
    if density.has_enumerate_support:
        weights = logs.detach().double().exp().T
    else:
        weights = scores.new_full(scores.shape[:2], 1 / DRAWS)
    return torch.einsum("bt,bti,btj->bij", weights, scores, scores)


def log_probs_and_scores(
    density_of: Callable[[Tensor], Distribution],
    raw: Float[Tensor, "batch raw"],
    targets: Float[Tensor, "target batch ..."] | Int[Tensor, "target batch ..."],
) -> tuple[Float[Tensor, "target batch"], Float[Tensor, "batch target raw"]]:
    """Return log p(y | raw), and the scores ∇ log p(y | raw), float64, for several targets y of each sample.

    All targets are evaluated in one pass if `density_of` accepts raw parameters of shape (target, batch, raw). If it
    does not, or if its results for the first target then differ, each target is evaluated in a pass of its own.

    Args:
        density_of: function from raw parameters to densities of batch_shape (batch,).
        raw: raw parameters.
        targets: targets y.
    """
    leaf = raw.detach().clone().requires_grad_()
    density = density_of(leaf)
    first_log = density.log_prob(targets[0])
    (first_score,) = torch.autograd.grad(first_log.sum(), leaf, retain_graph=True)
    copies = raw.detach().expand(len(targets), *raw.shape).clone().requires_grad_()
    try:
        logs = density_of(copies).log_prob(targets)
        (scores,) = torch.autograd.grad(logs.sum(), copies)
    except (RuntimeError, ValueError, IndexError):  # a model that accepts no further dimension
        logs, scores = first_log.unsqueeze(0), first_score.unsqueeze(0)
    rounding = 1e-3 * first_score.abs().sum().item() / max(1, first_score.numel())
    agrees = logs.shape == targets.shape[:2] and torch.allclose(
        scores[0], first_score, rtol=1e-3, atol=rounding, equal_nan=True
    )
    if not agrees:
        logs = torch.stack([density.log_prob(target) for target in targets])
        scores = torch.stack([torch.autograd.grad(log.sum(), leaf, retain_graph=True)[0] for log in logs])
    return logs, scores.transpose(0, 1).double()


def _constant_hessian(
    density: Distribution, leaf: Float[Tensor, "batch raw"], targets: list[Tensor]
) -> Float[Tensor, "batch raw raw"] | None:
    """Return the Hessian of -log p with respect to the raw parameters if two targets have the same one; None otherwise.

    The result is also None if the Hessian is not positive semi-definite or cannot be computed.

    Args:
        density: density whose raw parameters are `leaf`.
        leaf: raw parameters, with gradient.
        targets: targets, of which the first two are compared.
    """
    hessians = []
    try:
        for target in targets[:2]:
            (score,) = torch.autograd.grad(density.log_prob(target).sum(), leaf, create_graph=True)
            if not score.requires_grad:
                return None
            rows = [torch.autograd.grad(part, leaf, retain_graph=True)[0] for part in score.sum(0).unbind()]
            hessians.append(-torch.stack(rows, 1).double())
    except RuntimeError:  # a density without second derivatives
        return None
    first, second = hessians
    largest = first.abs().amax((1, 2), keepdim=True)
    equal = ((first - second).abs() <= 1e-5 * largest).all() and first.isfinite().all()
    if not equal or (torch.linalg.eigvalsh(first) < -1e-5 * largest.squeeze(-1)).any():
        return None
    return first


def collect(
    parts: Iterable[tuple[Tensor, Tensor]],
    covariance: Covariance,
) -> tuple[Eigen, int]:
    """Return the eigenvalues and eigenvectors of the Fisher information of the weights, and the number of samples.

    The information is H = Σ_n Λ_n ⊗ φ_n φ_nᵀ (Kristiadi, Hein & Hennig 2020). "diagonal" keeps its diagonal;
    "kronecker" approximates it by (Σ_n Λ_n / N) ⊗ (Σ_n φ_n φ_nᵀ) (Martens & Grosse 2015).

    Args:
        parts: features φ, (batch, feature), and Fisher information Λ of the raw parameters, (batch, raw, raw), batch by
            batch, float64.
        covariance: form of the matrix.
    """
    count = 0
    sums: list[Tensor] = []
    for features, fisher in parts:
        count += len(features)
        if covariance == "full":
            size = fisher.shape[1] * features.shape[1]
            outer = torch.einsum("nij,na,nb->iajb", fisher, features, features)
            new = [outer.reshape(size, size)]
        elif covariance == "kronecker":
            new = [fisher.sum(0), features.T @ features]
        else:
            new = [torch.einsum("nii,na->ia", fisher, features.square()).flatten()]
        sums = [total + part for total, part in zip(sums, new, strict=True)] if sums else new
    if covariance == "diagonal":
        return Eigen(sums[0], ()), count
    if covariance == "kronecker":
        sums[0] = sums[0] / count
    values, vectors = zip(*(torch.linalg.eigh(matrix) for matrix in sums), strict=True)
    positive = [part.clamp(min=0) for part in values]
    spectrum = positive[0] if covariance == "full" else torch.outer(*positive).flatten()
    return Eigen(spectrum, tuple(vectors)), count


def most_likely_precision(eigenvalues: Float[Tensor, "weight"], square: float) -> float:
    """Return the precision λ of the prior for which the marginal likelihood of the training data is highest.

    The marginal likelihood is computed by the Laplace approximation. Its terms that depend on λ are, for P weights, P/2
    log λ - λ/2 |W*|² - 1/2 log det(H + λ I). Their derivative with respect to log λ is (γ - λ |W*|²) / 2, with the
    number γ = Σ h/(h + λ) of determined weights (MacKay 1992). The derivative decreases in λ, so its only zero is found
    by bisection. λ is bounded by e^±LARGEST_EXPONENT.

    Args:
        eigenvalues: eigenvalues h of the Fisher information H of the weights.
        square: |W*|², the sum of the squared weights.
    """
    low, high = -LARGEST_EXPONENT, LARGEST_EXPONENT
    for _ in range(STEPS):
        middle = (low + high) / 2
        precision = math.exp(middle)
        if (eigenvalues / (eigenvalues + precision)).sum().item() > precision * square:
            low = middle
        else:
            high = middle
    return math.exp((low + high) / 2)


def draw_deviations(
    eigen: Eigen, precision: Tensor, noise: Float[Tensor, "sample weight"], shape: tuple[int, int]
) -> Float[Tensor, "sample raw feature"]:
    """Return random deviations of the weights from their mean, with the covariance (H + λ I)⁻¹.

    The deviations are the symmetric root of the covariance times the noise. This root is a continuous function of H and
    does not depend on the signs of the eigenvectors. An H that differs only by rounding, because it comes from another
    machine or from the samples in another order, therefore gives nearly the same deviations.

    Args:
        eigen: Fisher information H of the weights.
        precision: precision λ of the prior, 0-dimensional.
        noise: standard normal numbers.
        shape: shape (raw, feature) of the weights.
    """
    root = (eigen.values + precision).sqrt()
    if not eigen.vectors:
        return (noise / root).unflatten(1, shape)
    if len(eigen.vectors) == 1:
        (vectors,) = eigen.vectors
        return (noise @ vectors / root @ vectors.T).unflatten(1, shape)
    raws, features = eigen.vectors
    aligned = raws.T @ noise.unflatten(1, shape) @ features
    return raws @ (aligned / root.unflatten(0, shape)) @ features.T
