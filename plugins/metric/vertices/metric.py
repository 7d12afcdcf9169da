"""Distances between predicted and true vertices, and errors of the correspondences that predicted meshes give."""

from collections.abc import Mapping
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics.utilities import dim_zero_cat

from framework.errors import ConfigError, DataError
from framework.geometry.clouds import denormalise_clouds
from framework.metric import Directions, Mean, Metric
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.vertices.correspondence import correspondence

BINS, LOWEST, HIGHEST = 2_000, 1e-4, 1e4
"""Number of bins and limits (centimetres) of the histogram of distances.

The upper edge of each bin is 0.9 % above its lower edge.
"""
FAUST = "bogo2014faust"


class VertexError(Mean):
    """Euclidean distance between predicted and true vertices, centimetres (thesis §6.5.2).

    The target holds x, y, z of the first vertex, then of the second, and so on. The batch field "scale" (batch,), in
    metres per unit of the target, converts distances to centimetres. The reported mean is the mean over bodies of the
    mean over a body's vertices; its standard error is over bodies. Median and 95th percentile are over all vertices of
    all bodies. Both are computed from a histogram and are therefore exact to 1 %.

    Raises:
        ConfigError: the target is not made of vertices.
        DataError: a batch has no "scale".
    """

    bibtex = FAUST
    columns: ClassVar[dict[str, str]] = {
        "vertex_error_cm": "vertex error cm",
        "vertex_error_median_cm": "median cm",
        "vertex_error_95_cm": "95 % cm",
    }
    better: ClassVar[Directions] = dict.fromkeys(columns, "lower")
    histogram: Tensor

    def __init__(self, target: Target) -> None:
        super().__init__()
        require_vertices(target, "vertex_error")
        self.start()
        self.add_state("histogram", torch.zeros(BINS, dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, prediction: Prediction) -> None:
        (scale,) = fields(prediction, "vertex_error", {"scale": "metres per unit of the target"})
        distance = distances(prediction.point, prediction.target, scale)
        self.add_samples(distance.mean(1))
        self.histogram += torch.bincount(bins(distance).flatten(), minlength=BINS)

    def compute(self) -> dict[str, Tensor]:
        mean, error = self.mean_and_error()
        return {
            "vertex_error_cm": mean,
            "vertex_error_cm_sem": error,
            "vertex_error_median_cm": quantile(self.histogram, 0.5),
            "vertex_error_95_cm": quantile(self.histogram, 0.95),
        }


class CorrespondenceError(Metric):
    """Error of the correspondences between test scans that the predicted meshes give, centimetres (thesis Table 6.4).

    A point of one scan is assigned to the nearest vertex of this scan's predicted mesh; the same vertex of another
    scan's mesh is its predicted position there (`correspondence`). `intra_cm` is the mean over ordered pairs of scans
    of the same person, and `inter_cm` over those of two people. The target is the true registration. The metric holds
    every predicted and true mesh until the end.

    Raises:
        ConfigError: the target is not made of vertices.
        DataError: a batch has no "centre", "scale" or "subject".
    """

    bibtex = FAUST
    columns: ClassVar[dict[str, str]] = {"intra_cm": "intra cm", "inter_cm": "inter cm"}
    better: ClassVar[Directions] = dict.fromkeys(columns, "lower")
    registered: list[Tensor]
    truth: list[Tensor]
    subject: list[Tensor]

    def __init__(self, target: Target) -> None:
        super().__init__()
        require_vertices(target, "correspondence")
        for name in ("registered", "truth", "subject"):
            self.add_state(name, [], dist_reduce_fx="cat")

    def update(self, prediction: Prediction) -> None:
        meanings = {
            "centre": "metres",
            "scale": "metres per unit of the target",
            "subject": "number of the person on each scan",
        }
        centre, scale, subject = fields(prediction, "correspondence", meanings)
        for name, mesh in (("registered", prediction.point), ("truth", prediction.target)):
            getattr(self, name).append(denormalise_clouds(mesh.unflatten(1, (-1, 3)), centre, scale))
        self.subject.append(subject)

    def compute(self) -> dict[str, Tensor]:
        if not sum(map(len, self.subject)):
            return dict.fromkeys(self.columns, torch.tensor(torch.nan))
        parts = (dim_zero_cat(state) for state in (self.truth, self.registered, self.subject))
        return correspondence(*parts)._asdict()


def require_vertices(target: Target, name: str) -> None:
    """Check that a target can hold x, y, z of every vertex; `name` is the name of the metric in the message.

    Raises:
        ConfigError: the target is not real-valued, or its number of values is not a multiple of 3.
    """
    target.require("real", by=f"metric {name}")
    if len(target.names) % 3:
        raise ConfigError(
            f"metric {name} requires x, y, z of every vertex, but the target has {len(target.names)} numbers. "
            "Choose data whose target is a mesh, or leave this metric out."
        )


def fields(prediction: Prediction, name: str, meanings: Mapping[str, str]) -> list[Tensor]:
    """Return the batch fields that a metric reads, in the order of `meanings`.

    Args:
        prediction: the prediction whose batch is read.
        name: name of the metric, for the message.
        meanings: field name → its meaning, for the message.

    Raises:
        DataError: the batch lacks a field.
    """
    for field, meaning in meanings.items():
        if field not in prediction.batch:
            raise DataError(
                f"metric {name} requires the batch field {field!r} ({meaning}), which this data set does not provide. "
                "Choose data with this field (such as faust), or leave this metric out."
            )
    return [prediction.batch[field] for field in meanings]


def distances(
    point: Float[Tensor, "batch number"], target: Float[Tensor, "batch number"], scale: Float[Tensor, "batch"]
) -> Float[Tensor, "batch vertex"]:
    """Return the distance of each predicted vertex from the true one, centimetres, float64.

    `scale` holds the metres per unit of the target, for each sample.
    """
    gap = (point.double() - target.double()).unflatten(1, (-1, 3))
    return 100 * scale.double()[:, None] * torch.linalg.vector_norm(gap, dim=-1)


def bins(distance: Float[Tensor, "batch vertex"]) -> Tensor:
    """Return the histogram bin of each distance.

    Distances beyond the limits of the histogram belong to its first or last bin; NaN belongs to the last bin.
    """
    position = (distance.clamp(min=LOWEST) / LOWEST).log() * (
        BINS / torch.tensor(HIGHEST / LOWEST).double().log()
    )
    return position.nan_to_num(BINS).clamp(0, BINS - 1).long()


def quantile(histogram: Float[Tensor, "bins"], share: float) -> Float[Tensor, ""]:
    """Return the quantile `share` of the distances in a histogram, centimetres.

    It is the middle of the bin in which the cumulated share of distances reaches `share`; 0 if this is the first bin,
    and NaN if all bins are empty.
    """
    total = histogram.sum()
    index = torch.searchsorted(histogram.cumsum(0), share * total).clamp(max=BINS - 1)
    middle = LOWEST * (HIGHEST / LOWEST) ** ((index.double() + 0.5) / BINS)
    return torch.where(total > 0, middle.where(index > 0, 0), torch.nan)
