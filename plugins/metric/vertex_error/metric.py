"""Mean, median and 95th percentile of the distance between predicted and true vertices."""

from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from framework.errors import ConfigError, DataError
from framework.metric import Metric
from framework.prediction import Prediction
from framework.target import Target

BINS, LOWEST, HIGHEST = 2_000, 1e-4, 1e4
"""Of the histogram of distances, centimetres: equal steps of the logarithm, 0.9 % each."""


class VertexError(Metric):
    """Euclidean distance between predicted and true vertices, centimetres (thesis §6.5.2).

    The target is x, y, z of each vertex in turn; a batch's "scale" (batch,), metres per unit of the target, leads to
    centimetres. Each body's mean over its vertices is averaged over bodies, with its standard error; median and 95th
    percentile are those of all vertices of all bodies, from a histogram and so to 1 %.

    Raises:
        ConfigError: the target is no vertices.
        DataError: a batch has no "scale".
    """

    bibtex = """@inproceedings{bogo2014faust,
  title = {{FAUST}: Dataset and Evaluation for {3D} Mesh Registration},
  author = {Bogo, Federica and Romero, Javier and Loper, Matthew and Black, Michael J.},
  booktitle = {IEEE Conference on Computer Vision and Pattern Recognition (CVPR)},
  year = {2014}
}"""
    columns: ClassVar[dict[str, str]] = {
        "vertex_error_cm": "vertex error cm",
        "vertex_error_median_cm": "median cm",
        "vertex_error_95_cm": "95 % cm",
    }
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = dict.fromkeys(columns, "lower")
    count: Tensor
    total: Tensor
    squares: Tensor
    histogram: Tensor

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("real", by="metric vertex_error")
        if len(target.names) % 3:
            raise ConfigError(
                f"metric vertex_error reads x, y, z of every vertex, but the target has {len(target.names)} numbers. "
                "Choose data whose target is a mesh, or leave this metric out."
            )
        zero = torch.zeros((), dtype=torch.float64)
        for name in ("count", "total", "squares"):
            self.add_state(name, zero.clone(), dist_reduce_fx="sum")
        self.add_state("histogram", torch.zeros(BINS, dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, prediction: Prediction) -> None:
        if "scale" not in prediction.batch:
            raise DataError(
                'metric vertex_error reads "scale", metres per unit of the target, which this data set does not give. '
                "Leave this metric out."
            )
        distance = distances(prediction.point, prediction.target, prediction.batch["scale"])
        each = distance.mean(1)
        self.count += len(each)
        self.total += each.sum()
        self.squares += each.square().sum()
        self.histogram += torch.bincount(bins(distance).flatten(), minlength=BINS)

    def compute(self) -> dict[str, Tensor]:
        mean = self.total / self.count
        spread = (self.squares / self.count - mean.square()).clamp(min=0)  # (n - 1)/n of the sample variance
        return {
            "vertex_error_cm": mean,
            "vertex_error_cm_sem": (spread / (self.count - 1).clamp(min=0)).sqrt(),
            "vertex_error_median_cm": quantile(self.histogram, 0.5),
            "vertex_error_95_cm": quantile(self.histogram, 0.95),
        }


def distances(
    point: Float[Tensor, "batch number"], target: Float[Tensor, "batch number"], scale: Float[Tensor, "batch"]
) -> Float[Tensor, "batch vertex"]:
    """Of each vertex, centimetres, float64."""
    gap = (point.double() - target.double()).unflatten(1, (-1, 3))
    return 100 * scale.double()[:, None] * torch.linalg.vector_norm(gap, dim=-1)


def bins(distance: Float[Tensor, "batch vertex"]) -> Tensor:
    """The bin of each; what is nearer or further than the histogram reaches is in the first or last; NaN too."""
    place = (distance.clamp(min=LOWEST) / LOWEST).log() * (
        BINS / torch.tensor(HIGHEST / LOWEST).double().log()
    )
    return place.nan_to_num(BINS).clamp(0, BINS - 1).long()


def quantile(histogram: Float[Tensor, "bins"], share: float) -> Float[Tensor, ""]:
    """The middle of the bin below whose upper end this share of all lies; 0 of the first bin, NaN of nothing."""
    total = histogram.sum()
    place = torch.searchsorted(histogram.cumsum(0), share * total).clamp(max=BINS - 1)
    middle = LOWEST * (HIGHEST / LOWEST) ** ((place.double() + 0.5) / BINS)
    return torch.where(total > 0, middle.where(place > 0, 0), torch.nan)
