"""A penalty on densities of outliers that differ from a uniform density."""

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
    """A penalty for densities of outliers that differ from a uniform one (thesis eq. 2.21), for all kinds of target.

    The penalty is the weight times the mean over outliers of a divergence, nats, that is 0 for a density without
    information. For classes "entropy" is KL(p ‖ u) = log K - H(p): eq. 2.21 plus a constant, which has no gradient.
    "cross_entropy" is KL(u ‖ p), whose gradient does not vanish if p is certain of a class. For angles and reals it is
    KL(u ‖ p), estimated without bias from a few targets drawn from u. "auto" is the first for classes, and the second
    for others.

    Outliers are either the training split of other data, with that data's augmentation, or uniform numbers. Each step
    draws its own, with replacement, from torch's global generator. Batch norm treats them as in a test: it normalises
    them by the running moments of the training data, and does not update these.

    Args:
        weight: λ.
        outliers: data to draw from; prepared at once.
        low, high: the range of uniform numbers, in the units of the inputs; for images, 0 and 1.
        count: number of outliers of a step; None: the number of samples that the batch has for each model.
        clearance: outliers nearer than this to an input of the batch (Euclidean, in its units) are left out: uniform
            numbers also fall among the training data, where a uniform density costs likelihood. 0 keeps all.
        divergence: "auto", "entropy" or "cross_entropy".
        prior_scale: standard deviation of u for a real number, in the target's units.

    Raises:
        ConfigError: both or neither of `outliers` and (`low`, `high`), an empty range; and in training, outliers of
            another shape than the inputs, or "entropy" of a density that is not over classes.
        DataError: as `outliers.prepare`.
    """

    bibtex = """@inproceedings{hendrycks2019deep,
  author    = {Hendrycks, Dan and Mazeika, Mantas and Dietterich, Thomas},
  title     = {Deep Anomaly Detection with Outlier Exposure},
  booktitle = {International Conference on Learning Representations},
  year      = {2019}
}
@inproceedings{hein2019why,
  author    = {Hein, Matthias and Andriushchenko, Maksym and Bitterwolf, Julian},
  title     = {Why {ReLU} Networks Yield High-Confidence Predictions Far Away From the Training Data and How to Mitigate the Problem},
  booktitle = {IEEE/CVF Conference on Computer Vision and Pattern Recognition},
  year      = {2019}
}"""  # noqa: E501

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
        drawn = self._uniform(inputs, count) if self.outliers is None else self._drawn(inputs, count)
        if self.clearance > 0:
            drawn = drawn[clear_of(drawn, inputs, self.clearance)]
        with set_flag(predictor, BATCH_NORM, "training", False), own_batches(predictor, False):
            found = independent_penalty(self._divergences(predictor.training_densities(drawn)))
        return self.weight * found.sum() / max(1, len(drawn))  # no outliers, no penalty

    def _divergences(self, density: Distribution) -> Float[Tensor, "batch *member"]:
        """Return the divergence of each outlier and member, nats."""
        if density.has_enumerate_support:
            return to_uniform(density) if self.divergence == "cross_entropy" else from_uniform(density)
        if self.divergence == "entropy":
            raise ConfigError(
                "objective.outlier_exposure.divergence = 'entropy' is for classes, but the density is over "
                f"{density.event_shape[0]} continuous numbers. Choose 'cross_entropy' or 'auto'."
            )
        return to_ignorance(density, self.prior_scale)

    def _uniform(self, inputs: Tensor, count: int) -> Tensor:
        low, high = self.box
        dtype = inputs.dtype if inputs.is_floating_point() else torch.get_default_dtype()
        return low + (high - low) * torch.rand(count, *inputs.shape[1:], dtype=dtype, device=inputs.device)

    def _drawn(self, inputs: Tensor, count: int) -> Tensor:
        assert self.outliers is not None
        shape, wanted = tuple(self.outliers.input_shape), tuple(inputs.shape[1:])
        if shape != wanted:
            raise ConfigError(
                f"objective.outlier_exposure.outliers has inputs of shape {shape}, the data of shape {wanted}; wanted "
                "one shape. Set the size of either."
            )
        if count == 0:
            return inputs
        index = torch.randint(len(self.split), (count,)).tolist()  # pyright: ignore[reportArgumentType]
        # a loader of one batch: it handles data sets that fetch many items at once
        loader = DataLoader(
            self.split, batch_sampler=[index], collate_fn=as_batch, generator=torch.Generator()
        )
        batch = {name: field.to(inputs.device) for name, field in next(iter(loader)).items()}
        return self.outliers.augment(batch)["input"]


def clear_of(
    outliers: Float[Tensor, "outlier *input"], inputs: Tensor, clearance: float
) -> Bool[Tensor, "outlier"]:
    """Return which outliers are at least `clearance` away from every input; bytes are read as 0 to 1."""
    if len(inputs) == 0 or len(outliers) == 0:
        return torch.ones(len(outliers), dtype=torch.bool, device=outliers.device)
    some, others = (
        given.flatten(1).float() / 255 if given.dtype == torch.uint8 else given.flatten(1)
        for given in (outliers, inputs)
    )
    return torch.cdist(some, others.to(some)).amin(1) >= clearance


def uniform_range(low: float | None, high: float | None, *, other: bool) -> tuple[float, float]:
    """Return (low, high), or NaNs if there is another source of outliers.

    Raises:
        ConfigError: both sources or neither, or an empty range.
    """
    given = [number for number in (low, high) if number is not None]
    if other and not given:
        return torch.nan, torch.nan
    if other or low is None or high is None:
        came = " and ".join(
            [f"{name} = {value:g}" for name, value in (("low", low), ("high", high)) if value is not None]
            + ["outliers"] * other
        )
        raise ConfigError(
            f"objective.outlier_exposure got {came or 'no outliers'}; wanted either another data set, such as "
            "`outliers={name: ..., ...}`, or uniform numbers, `low` and `high` (0 and 1 for images)."
        )
    if not low < high:
        raise ConfigError(
            f"objective.outlier_exposure.low = {low:g} and high = {high:g}; wanted low below high. Swap them."
        )
    return low, high
