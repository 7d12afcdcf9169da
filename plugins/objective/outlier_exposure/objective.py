"""Outlier exposure: a penalty on the difference between predicted densities of outliers and a uniform density."""

from typing import Annotated, Literal

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor
from torch.distributions import Distribution
from torch.utils.data import DataLoader

from framework.calibration.module_flags import BATCH_NORM, set_flag
from framework.data import Batch, Data
from framework.datasets.fields import as_batch
from framework.errors import ConfigError
from framework.model import Predictor, independent_penalty
from framework.objective import Objective
from framework.uncertainty import own_batches, rows_per_model
from plugins.objective.outlier_exposure.divergence import from_uniform, to_ignorance, to_uniform


class OutlierExposure(Objective):
    """A penalty on the divergence of predicted densities p of outliers from a uniform density u (thesis eq. 2.21).

    The penalty is the weight times the mean over outliers of a divergence, nats, which is 0 for p = u. For classes,
    "entropy" is KL(p ‖ u) = log K - H(p), which is eq. 2.21 plus a constant without gradient. "cross_entropy" is
    KL(u ‖ p), whose gradient does not vanish if p is certain of a class. For angles and reals the divergence is
    KL(u ‖ p), estimated without bias from a few targets sampled from u. "auto" is "entropy" for classes, and
    "cross_entropy" for other targets.

    Outliers are either samples of the training split of other data, with the augmentation of that data, or uniform
    random numbers. Each step draws new outliers, with replacement, from torch's global generator. Batch norm treats
    outliers as in a test: it normalises them by the running moments of the training data, and does not update these
    moments.

    Args:
        weight: factor λ of the penalty.
        outliers: data from which outliers are drawn; the constructor prepares it.
        low, high: range of uniform random numbers, in the units of the inputs; 0 and 1 for images.
        count: number of outliers of a training step. None: the number of samples that one model sees in a step; this
            is the batch size, divided by the number of members if each member of an ensemble has its own samples.
        clearance: smallest Euclidean distance, in the inputs' unit, of an outlier from every input of the batch; nearer
            outliers are left out, because uniform random numbers also fall among the training data, where a uniform
            density would be wrong. 0 keeps all outliers.
        divergence: "auto", "entropy" or "cross_entropy".
        prior_scale: standard deviation of u for a real number, in the target's units.

    Raises:
        ConfigError: both or neither of `outliers` and (`low`, `high`) are set, or the range is empty. In training:
            outliers have another shape than the inputs, or "entropy" is chosen for a density that is not over classes.
        DataError: `outliers.prepare` fails.
    """

    bibtex = "hendrycks2019deep, hein2019why"

    def __init__(
        self,
        *,
        weight: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0,
        outliers: Data | None = None,
        low: Annotated[float, Field(allow_inf_nan=False)] | None = None,
        high: Annotated[float, Field(allow_inf_nan=False)] | None = None,
        count: Annotated[int, Field(gt=0)] | None = None,
        clearance: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0,
        divergence: Literal["auto", "entropy", "cross_entropy"] = "auto",
        prior_scale: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 3.0,
    ) -> None:
        super().__init__()
        self.box = uniform_range(low, high, other=outliers is not None)
        self.weight = weight
        self.outliers = outliers
        self.count = count
        self.clearance = clearance
        self.divergence = divergence
        self.prior_scale = prior_scale
        if outliers is not None:
            outliers.prepare()
            self.split = outliers.splits().train

    def forward(self, predictor: Predictor, batch: Batch) -> Float[Tensor, ""]:
        """Return the weighted penalty of a batch."""
        inputs = batch["input"]
        count = rows_per_model(predictor, len(inputs)) if self.count is None else self.count
        outliers = self._uniform(inputs, count) if self.outliers is None else self._draw(inputs, count)
        if self.clearance > 0:
            outliers = outliers[far_from(outliers, inputs, self.clearance)]
        with set_flag(predictor, BATCH_NORM, "training", False), own_batches(predictor, False):
            divergences = independent_penalty(self._divergences(predictor.training_densities(outliers)))
        return self.weight * divergences.sum() / max(1, len(outliers))  # without outliers the penalty is 0

    def _divergences(self, density: Distribution) -> Float[Tensor, "batch *member"]:
        """Return the divergence of each outlier and member, nats."""
        if density.has_enumerate_support:
            return to_uniform(density) if self.divergence == "cross_entropy" else from_uniform(density)
        if self.divergence == "entropy":
            raise ConfigError(
                "objective.outlier_exposure.divergence=entropy is for classes, but the density is over "
                f"{density.event_shape[0]} continuous numbers. Choose cross_entropy or auto."
            )
        return to_ignorance(density, self.prior_scale)

    def _uniform(self, inputs: Tensor, count: int) -> Tensor:
        low, high = self.box
        dtype = inputs.dtype if inputs.is_floating_point() else torch.get_default_dtype()
        return low + (high - low) * torch.rand(count, *inputs.shape[1:], dtype=dtype, device=inputs.device)

    def _draw(self, inputs: Tensor, count: int) -> Tensor:
        assert self.outliers is not None
        shape, wanted = tuple(self.outliers.input_shape), tuple(inputs.shape[1:])
        if shape != wanted:
            raise ConfigError(
                f"objective.outlier_exposure.outliers has inputs of shape {shape}, but the data has inputs of shape "
                f"{wanted}. Both shapes must be equal: change the size of the inputs of one of them."
            )
        if count == 0:
            return inputs
        index = torch.randint(len(self.split), (count,)).tolist()  # pyright: ignore[reportArgumentType]
        # a loader of one batch also handles data sets that fetch many items at once
        loader = DataLoader(
            self.split, batch_sampler=[index], collate_fn=as_batch, generator=torch.Generator()
        )
        batch = {name: field.to(inputs.device) for name, field in next(iter(loader)).items()}
        return self.outliers.augment(batch)["input"]


def far_from(
    outliers: Float[Tensor, "outlier *input"], inputs: Tensor, clearance: float
) -> Bool[Tensor, "outlier"]:
    """Return for each outlier whether its Euclidean distance to every input is at least `clearance`.

    Images of type uint8 are converted to 0…1 first.
    """
    if len(inputs) == 0 or len(outliers) == 0:
        return torch.ones(len(outliers), dtype=torch.bool, device=outliers.device)
    outlier_rows, input_rows = (
        rows.flatten(1).float() / 255 if rows.dtype == torch.uint8 else rows.flatten(1)
        for rows in (outliers, inputs)
    )
    # products of matrices, torch's default for many rows, would lose the digits of small distances
    distances = torch.cdist(
        outlier_rows, input_rows.to(outlier_rows), compute_mode="donot_use_mm_for_euclid_dist"
    )
    return distances.amin(1) >= clearance


def uniform_range(low: float | None, high: float | None, *, other: bool) -> tuple[float, float]:
    """Return the range (low, high) of uniform random outliers, or (NaN, NaN) if the outliers come from a data set.

    `other` says whether a data set of outliers is set.

    Raises:
        ConfigError: both a range and a data set are given, or neither, or the range is empty.
    """
    bounds = [number for number in (low, high) if number is not None]
    if other and not bounds:
        return torch.nan, torch.nan
    if other or low is None or high is None:
        settings = " and ".join(
            [f"{name} = {value:g}" for name, value in (("low", low), ("high", high)) if value is not None]
            + ["outliers"] * other
        )
        raise ConfigError(
            f"objective.outlier_exposure got {settings or 'no source of outliers'}. Set either outliers to another "
            "data set, such as outliers={name: ..., ...}, or low and high to the range of uniform numbers (0 and 1 for "
            "images)."
        )
    if not low < high:
        raise ConfigError(
            f"objective.outlier_exposure.low is {low:g} and high is {high:g}, but low must be below high. Swap them."
        )
    return low, high
