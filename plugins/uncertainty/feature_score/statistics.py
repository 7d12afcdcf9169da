"""Statistics of the features of training samples: class means, shared covariance with shrinkage, nearest neighbours.

The squared Mahalanobis distance of features f from a class c is (f - μ_c)ᵀ Σ⁻¹ (f - μ_c), with the mean μ_c of each
class and the covariance Σ that all classes share (Lee et al. 2018). Σ⁻¹ is stored as a matrix W with WᵀW = Σ⁻¹.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

Parts = Callable[[], Iterator[tuple[Tensor, Tensor]]]
"""Function that yields, batch by batch, the features (batch, feature) and the class numbers (batch,) of samples."""
SEED = 53
"""Seed of the random choice of samples among which neighbours are searched."""
ENTRIES = 2**24
"""Largest number of differences of features that are computed at once in the search of neighbours."""

EXACT = "donot_use_mm_for_euclid_dist"
"""Argument of `torch.cdist` that forbids products of matrices, which would lose the digits of small distances."""


class Clusters(NamedTuple):
    """Mean of each class, and the shared covariance.

    Attributes:
        means: mean features of each class, (class, feature) float64; 0 for a class without samples.
        counts: number of samples of each class, (class,) int64.
        whitening: W with WᵀW = Σ⁻¹, (feature, feature) float64.
        shrinkage: share of the multiple of the identity in Σ.
        covariance: Σ, (feature, feature) float64.
    """

    means: Tensor
    counts: Tensor
    whitening: Tensor
    shrinkage: float
    covariance: Tensor


def fit_clusters(parts: Parts, classes: int, shrinkage: float | None) -> Clusters:
    """Return class means and the shared covariance of the features, from two passes over the samples.

    The covariance is Σ = (1 - s) S + s (tr S / D) I. S = 1/N Σ_n (f_n - μ_c(n))(f_n - μ_c(n))ᵀ is the empirical
    covariance within classes (Lee et al. 2018, eq. 1), s the shrinkage, and D the number of features.

    Args:
        parts: the samples.
        classes: number of classes.
        shrinkage: s; None for the estimate of smallest expected squared error (Ledoit & Wolf 2004, eq. 14).
    """
    sums, counts = torch.zeros(0), torch.zeros(classes, dtype=torch.int64)
    for features, label in parts():
        if not len(sums):
            sums = features.new_zeros(classes, features.shape[1], dtype=torch.float64)
            counts = counts.to(features.device)
        sums.index_add_(0, label, features.double())
        counts += torch.bincount(label, minlength=classes)
    means = sums / counts.clamp(min=1).unsqueeze(1)
    count, size = int(counts.sum()), means.shape[1]
    scatter, fourth = means.new_zeros(size, size), 0.0
    for features, label in parts():
        residual = features.double() - means[label]
        scatter += residual.T @ residual
        fourth += residual.square().sum(1).square().sum().item()
    empirical = scatter / count
    share = ledoit_wolf_share(empirical, fourth, count) if shrinkage is None else shrinkage
    identity = torch.eye(size, dtype=empirical.dtype, device=empirical.device)
    covariance = (1 - share) * empirical + share * empirical.diagonal().mean() * identity
    return Clusters(means, counts, whiten(empirical, share), share, covariance)


def merge_clusters(clusters: Clusters) -> Clusters:
    """Return the mean and the covariance of all classes together, as one class, by the law of total covariance.

    With the mean μ_c of the n_c samples of each class, and the mean μ of all N samples, the covariance is Σ + Σ_c n_c/N
    (μ_c - μ)(μ_c - μ)ᵀ. If Σ has no shrinkage, this is the empirical covariance of all samples, as in Ren et al. 2021.
    Otherwise it contains the shrinkage of Σ, and none is added. A second, different shrinkage would make one of the two
    distances many times the other in directions in which the training samples hardly vary, whatever the classes are.
    """
    shares = clusters.counts.to(clusters.means) / clusters.counts.sum()
    mean = shares @ clusters.means
    differences = clusters.means - mean
    between = (differences.T * shares) @ differences
    whole = clusters.covariance + between
    counts = clusters.counts.sum().reshape(1)
    return Clusters(mean.unsqueeze(0), counts, whiten(whole, 0.0), clusters.shrinkage, whole)


def ledoit_wolf_share(empirical: Float[Tensor, "feature feature"], fourth: float, count: int) -> float:
    """Return the shrinkage b²/d² of Ledoit & Wolf 2004 (eq. 14), between 0 and 1.

    d² = |S - m I|² and b² = min(d², 1/N² Σ_n |x_n x_nᵀ - S|²), where Σ_n |x_n x_nᵀ - S|² = Σ_n |x_n|⁴ - N |S|². m is
    the mean of the diagonal of S, and |·| the Frobenius norm.

    Args:
        empirical: S, the covariance of the centred samples x_n.
        fourth: sum of |x_n|⁴ over the samples.
        count: N.
    """
    size = len(empirical)
    middle = empirical.diagonal().mean()
    dispersion = (empirical.square().sum() - size * middle.square()).item()
    noise = (fourth - count * empirical.square().sum().item()) / count**2
    return min(max(noise, 0.0), dispersion) / dispersion if dispersion > 0 else 0.0


def whiten(empirical: Float[Tensor, "feature feature"], share: float) -> Float[Tensor, "feature feature"]:
    """Return W with WᵀW = Σ⁻¹ for Σ = (1 - s) S + s (tr S / D) I.

    Eigenvalues of Σ below its rounding error are raised to this error. If all features are constant, W is the identity,
    and distances are Euclidean.

    Args:
        empirical: empirical covariance S of D features.
        share: shrinkage s.
    """
    values, vectors = torch.linalg.eigh(empirical)
    values = (1 - share) * values + share * values.mean()
    if not values[-1] > 0:
        return torch.eye(len(values), dtype=values.dtype, device=values.device)
    floor = len(values) * torch.finfo(values.dtype).eps * values[-1]
    return (vectors / values.clamp(min=floor).sqrt()).T


def mahalanobis(
    features: Float[Tensor, "batch feature"],
    means: Float[Tensor, "class feature"],
    counts: Int[Tensor, "class"],
    whitening: Float[Tensor, "feature feature"],
) -> Float[Tensor, "batch"]:
    """Return the squared Mahalanobis distance of features from the nearest class, float64 (Lee et al. 2018, eq. 2).

    Classes without samples are left out; without any sample, the distances are 0. `means`, `counts` and `whitening` (W
    with WᵀW = Σ⁻¹) are fields of `Clusters`.
    """
    present = means[counts > 0]
    if not len(present):
        return features.new_zeros(len(features), dtype=torch.float64)
    centre = present.mean(0)
    own, centres = (features.double() - centre) @ whitening.T, (present - centre) @ whitening.T
    return torch.cdist(own, centres, compute_mode=EXACT).square().amin(1)


def choose_samples(parts: Parts, most: int) -> Float[Tensor, "sample feature"]:
    """Return the features of all samples, or of `most` random ones if there are more, in their order.

    The random choice depends only on the number of samples.
    """
    count = sum(len(features) for features, _ in parts())
    order = torch.randperm(count, generator=torch.Generator().manual_seed(SEED))
    mask = torch.zeros(count, dtype=torch.bool)
    mask[order[:most]] = True
    chosen, start = [], 0
    for features, _ in parts():
        part = mask[start : start + len(features)].to(features.device)
        chosen.append(features[part])
        start += len(features)
    return torch.cat(chosen)


def neighbour_distance(
    features: Float[Tensor, "batch feature"], samples: Float[Tensor, "sample feature"], neighbours: int
) -> Float[Tensor, "batch"]:
    """Return the Euclidean distance to the k-th nearest sample, float64 (Sun et al. 2022, eq. 3).

    Args:
        features: features of the inputs.
        samples: features among which neighbours are searched.
        neighbours: k.
    """
    rows = max(1, ENTRIES // max(1, samples.numel()))
    parts = [
        torch.cdist(part, samples.double(), compute_mode=EXACT).kthvalue(neighbours, dim=1).values
        for part in features.double().split(rows)
    ]
    return torch.cat(parts)


def energy(logits: Float[Tensor, "batch class"]) -> Float[Tensor, "batch"]:
    """Return the energy -log Σ_k exp l_k of logits l, nats, float64 (Liu et al. 2020, eq. 4 with T = 1)."""
    return -torch.logsumexp(logits.double(), -1)


def to_unit_length(features: Float[Tensor, "batch feature"]) -> Float[Tensor, "batch feature"]:
    """Return features divided by their Euclidean norm; features of 0 stay 0."""
    return features / features.norm(dim=1, keepdim=True).clamp(min=torch.finfo(features.dtype).tiny)
