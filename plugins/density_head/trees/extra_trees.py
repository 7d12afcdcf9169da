"""Extremely randomised trees (Geurts et al. 2006) as a density head."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.distributions import Categorical, Distribution

from framework.density_head import DensityHead, Fitted
from framework.distributions.density import Mixture
from framework.distributions.normals import IndependentNormals
from framework.heads.parameters import require_validation
from framework.heads.unit import Unit
from framework.target import Target
from plugins.density_head.trees.forest import frequencies, leaves
from plugins.density_head.trees.heads_without_gradient import (
    FLOOR,
    WIDEST,
    load_any_shape,
    require_class_or_real,
    require_fitted,
    single,
    with_gradient_of_0,
)
from plugins.density_head.trees.stored_forest import require_forest

INTEGERS = ("feature", "branch", "root", "start", "label", "count")
ROUNDS = 200
"""Largest number of rounds of expectation maximisation, which ends when no variance changes by a millionth."""


class ExtraTreesHead(DensityHead, Fitted):
    """A forest of trees with random thresholds, fitted to all training samples at once (Geurts et al. 2006).

    For K classes and T trees, p_k = (T f_k + a) / (T + a K), where f_k is the share of class k in a sample's leaf,
    averaged over the trees, and a is `smoothing`. This is Laplace's rule on T votes: no class has probability 0, and
    the classes keep the order of f_k. For reals, the density is a mixture of one normal density for each tree. The mean
    of a tree's density is the mean of the training targets in the sample's leaf. All these densities have one common
    standard deviation, the width, for each number of the target. After the fit the width is the standard deviation of
    the training targets; `calibrate` fits it to the validation split by maximum likelihood. The output of the trees is
    piecewise constant in the features, and its gradient is 0.

    The forest is stored as flat arrays of integers and thresholds; scikit-learn grows it and is not needed to use it.

    Attributes:
        trees: number of trees that are used, counted from the first (a knob).

    Args:
        trees: number of trees that are grown.
        features: share of the features tried at each split; None for the square root of their number if the target is a
            class, and for all features if it is real-valued.
        leaf: smallest number of training samples of a leaf.
        depth: largest number of splits from root to leaf.
        smoothing: a; number of votes that every class has in addition.

    Raises:
        ConfigError: the target is an angle or an image.
        UserError: the head is used before it was fitted.
    """

    knobs: ClassVar[Mapping[str, tuple[int, ...]]] = {"trees": (1, 3, 10, 30, 100, 300)}
    bibtex = "geurts2006extremely"

    feature: Tensor
    threshold: Tensor
    branch: Tensor
    root: Tensor
    start: Tensor
    label: Tensor
    count: Tensor
    mean: Tensor
    width: Tensor
    read: Tensor

    def __init__(
        self,
        target: Target,
        *,
        trees: Annotated[int, Field(gt=0)] = 300,
        features: Annotated[float, Field(gt=0, le=1)] | None = None,
        leaf: Annotated[int, Field(gt=0)] = 1,
        depth: Annotated[int, Field(gt=0)] | None = None,
        smoothing: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0,
    ) -> None:
        super().__init__()
        require_class_or_real(target, by="density_head extra_trees")
        self.classes = len(target.names) if target.kind == "class" else 0
        self.trees = trees
        self.share, self.leaf, self.depth = features, leaf, depth
        self.smoothing = smoothing
        self.unit = Unit.of(target)
        self.numbers = 0 if self.classes else len(target.names)
        for name in INTEGERS:
            self.register_buffer(name, torch.zeros(0, dtype=torch.int32))
        self.register_buffer("threshold", torch.zeros(0))
        self.register_buffer("mean", torch.zeros(0, self.numbers, dtype=torch.float64))
        self.register_buffer("width", torch.ones(self.numbers, dtype=torch.float64))
        self.register_buffer("read", torch.zeros((), dtype=torch.int64))
        self.size = 0
        load_any_shape(self, ExtraTreesHead._require, ExtraTreesHead._open)

    def fit(self, features: Float[Tensor, "sample size"], target: Tensor, seed: int) -> None:
        """Grow the trees from all training samples."""
        from plugins.density_head.trees.growing import (
            grow_forest,
        )  # scikit-learn, which a stored forest does not need

        target = target if self.classes else self.unit.standardise(target.double())
        wanted = target.cpu().numpy()
        arrays = grow_forest(
            single(features).numpy(),
            wanted,
            classes=self.classes,
            trees=self.trees,
            share=self.share,
            leaf=self.leaf,
            depth=self.depth,
            seed=seed,
        )
        for name, array in arrays.items():
            setattr(self, name, torch.from_numpy(np.ascontiguousarray(array)).to(target.device))
        if not self.classes:
            self.width.copy_(target.std(0, correction=0).clamp(FLOOR, WIDEST))
        self.read.fill_(features.shape[1])
        self._open()

    def forward(self, raw: Float[Tensor, "*batch size"]) -> Distribution:
        """Return the density for raw parameters."""
        raw = require_fitted(raw, self.size, by="density_head extra_trees")
        batch = raw.shape[:-1]
        root = self.root[: max(1, self.trees)]
        feature, threshold, branch = map(array, (self.feature, self.threshold, self.branch))
        leaf = leaves(single(raw.reshape(-1, self.size)).numpy(), feature, threshold, branch, array(root))
        if self.classes:
            start, label, count = map(array, (self.start, self.label, self.count))
            share = frequencies(leaf, start, label, count, self.classes)
            votes = torch.from_numpy(share).to(raw).reshape(*batch, self.classes) * len(root)
            logits = (votes + self.smoothing).log()  # Categorical divides by their sum, T + a K
            return Categorical(logits=with_gradient_of_0(logits, raw), validate_args=False)
        means = self.mean[torch.from_numpy(leaf).long().to(self.mean.device)]  # (tree, sample, number)
        means = means.movedim(0, 1).to(raw).reshape(*batch, len(root), self.mean.shape[1])
        means = with_gradient_of_0(means, raw)
        mean, scale, _ = self.unit.to_target_unit(means, self.width.to(raw).expand_as(means))
        components = IndependentNormals(mean, scale)
        return Mixture(means.new_zeros(means.shape[:-1]), components)

    @torch.no_grad()
    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        """Fit the widths by maximum likelihood; do nothing for classes."""
        if self.classes:
            return
        require_validation(raw, "Widths are")
        density = self(raw.double())
        assert isinstance(density, Mixture)
        means, target = map(self.unit.standardise, (density.components.mean, target.double()))
        width = fit_width(target.unsqueeze(1) - means)  # of (sample, tree, number)
        self.width.copy_(width.clamp(max=WIDEST))

    def _require(self, arrays: Mapping[str, np.ndarray]) -> None:
        require_forest(arrays, self.classes, self.numbers)

    def _open(self, *_: Any) -> None:
        """Set `size` to the number of features that the loaded forest reads."""
        self.size = int(self.read)


def fit_width(residual: Float[Tensor, "sample tree number"]) -> Float[Tensor, "number"]:
    """Return widths σ that maximise Σ_i log (1/T) Σ_t Π_d N(residual_itd; 0, σ_d²), by expectation maximisation.

    i is the sample, t one of T trees, and d the number of the target. A round computes r_it = N(residual_it; 0, σ²) /
    Σ_s N(residual_is; 0, σ²), then σ_d² = mean_i Σ_t r_it residual_itd² (Dempster, Laird & Rubin 1977). A round never
    lowers the likelihood. The search starts from the largest useful width, at which all trees have similar weights.
    """
    squares = residual.square()
    variance = squares.mean((0, 1)).clamp(min=FLOOR**2)
    for _ in range(ROUNDS):
        share = (-(squares / (2 * variance)).sum(-1)).softmax(-1)
        before, variance = variance, (share.unsqueeze(-1) * squares).sum(1).mean(0).clamp(min=FLOOR**2)
        if bool(((variance / before).log().abs() < 1e-6).all()):
            break
    return variance.sqrt()


def array(tensor: Tensor) -> np.ndarray:
    """Return the tensor as a NumPy array."""
    return tensor.cpu().numpy()
