"""Point-NN: features of a cloud from sines and cosines, farthest points and neighbours (Zhang et al. 2023, §3.1)."""

from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.nn.functional import gelu

from framework.encoder import Encoder
from framework.geometry.clouds import Normalisation, normalise_clouds, require_clouds, sizes
from framework.geometry.farthest import farthest

AXES = 3
LEAST = 1e-5
"""Constant that is added to standard deviations before they divide, so that equal points give no division by 0."""


class PointNN(Encoder):
    """Features of clouds that need no training: positional encodings, pooled over neighbours in several stages.

    Each point begins with the sines and cosines of its coordinates (`positional_encoding`). Each stage chooses half of
    the points, which are as far as possible from each other, and describes each of them by its neighbours: the
    neighbours' features relative to its own, its own features, and the encoding of the neighbours' relative positions.
    The maximum plus the mean over the neighbours are its new features. The maximum plus the mean over the points of the
    last stage are the features of the cloud, (width · 2^stages,).

    Relative features, and relative positions, are divided by the standard deviation of all of them in the cloud. The
    paper divides by the standard deviation over a batch of clouds; here the features of a cloud do not depend on other
    clouds. Columns after x, y, z are not read. Neither the order of the points nor padding changes the features, unless
    distances are equal.

    Args:
        input_shape: (points, columns) of the largest cloud; coordinates in the first three columns.
        points: number of points that are read, in the order of `framework.geometry.farthest`; all if a cloud has fewer.
        width: number of features of a point before the first stage, a multiple of 6.
        stages: number of stages.
        neighbours: number of neighbours of a point in each stage; all points if there are fewer.
        frequency: α, the highest angular frequency, radians per unit of the normalised cloud.
        base: β; the D angular frequencies of an encoding are α / β^(d/D) for d = 0, …, D - 1.
        normalise: "unit_ball", "robust" or "none" (`framework.geometry.clouds.normalise_clouds`), applied to the whole
            cloud.

    Raises:
        ConfigError: the input is not a cloud.
    """

    fixed = True
    bibtex = "zhang2023parameter"

    # More than eight parameters: each keyword is a config key that a user sets alone.
    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        points: Annotated[int, Field(gt=0, le=100_000)] = 1024,
        width: Annotated[int, Field(gt=0, le=3072, multiple_of=6)] = 72,
        stages: Annotated[int, Field(ge=1, le=8)] = 4,
        neighbours: Annotated[int, Field(gt=0, le=1024)] = 90,
        frequency: Annotated[float, Field(gt=0, le=1e6)] = 1000.0,
        base: Annotated[float, Field(ge=1, le=1e6)] = 100.0,
        normalise: Normalisation = "unit_ball",
    ) -> None:
        super().__init__()
        require_clouds(input_shape, by="encoder point_nn")
        self.points, self.width, self.stages, self.neighbours = points, width, stages, neighbours
        self.frequency, self.base = frequency, base
        self.normalise: Normalisation = normalise
        self.output_shape = (width * 2**stages,)

    def forward(self, inputs: Float[Tensor, "batch points columns"]) -> Float[Tensor, "batch length"]:
        """Return the features of the clouds."""
        counts = sizes(inputs)
        clouds = normalise_clouds(inputs, self.normalise, counts).clouds[..., :AXES]
        order = farthest(clouds, counts, min(self.points, clouds.shape[1]))
        features = [
            self._encode(cloud[index[:count]])
            for cloud, index, count in zip(clouds, order, counts.tolist(), strict=True)
        ]
        return torch.stack(features) if features else inputs.new_zeros(0, *self.output_shape)

    def _encode(self, positions: Float[Tensor, "point 3"]) -> Float[Tensor, "length"]:
        """Return the features of one cloud, whose points are in the order of `farthest`."""
        features = positional_encoding(positions, self.width, self.frequency, self.base)
        for _ in range(self.stages):
            positions, features = self._pool(positions, features)
        return _summary(features, 0)

    def _pool(
        self, positions: Float[Tensor, "point 3"], features: Float[Tensor, "point length"]
    ) -> tuple[Float[Tensor, "centroid 3"], Float[Tensor, "centroid double"]]:
        """Return the first half of the points, with features from their neighbours.

        The first points in the order of `farthest` are as far as possible from each other.
        """
        count = max(len(positions) // 2, 1)
        centroids, own = positions[:count], features[:count]
        distance = torch.cdist(
            centroids.detach(), positions.detach(), compute_mode="donot_use_mm_for_euclid_dist"
        )
        near = distance.topk(min(self.neighbours, len(positions)), largest=False).indices
        offset = _standardised(positions[near] - centroids.unsqueeze(1))
        relative = _standardised(features[near] - own.unsqueeze(1))
        joined = torch.cat([relative, own.unsqueeze(1).expand_as(relative)], -1)
        encoding = positional_encoding(offset, joined.shape[-1], self.frequency, self.base)
        return centroids, gelu(_summary((joined + encoding) * encoding, 1))


def positional_encoding(
    positions: Float[Tensor, "*shape 3"], length: int, frequency: float, base: float
) -> Float[Tensor, "*shape length"]:
    """Return sines and cosines of coordinates: sin(α x / β^(d/D)) and cos(α x / β^(d/D)) for D = length/6 (eq. 4, 5).

    α is `frequency`, β is `base` and d = 0, …, D - 1. For each axis, sine and cosine of one frequency follow each
    other.
    """
    number = length // (2 * AXES)
    power = torch.arange(number, dtype=positions.dtype, device=positions.device) / number
    phase = positions.unsqueeze(-1) * (frequency / base**power)
    return torch.stack([phase.sin(), phase.cos()], -1).flatten(-3)


def _standardised(offsets: Tensor) -> Tensor:
    """Return differences divided by the standard deviation of all of them."""
    return offsets / (offsets.std(correction=0) + LEAST)


def _summary(features: Tensor, dim: int) -> Tensor:
    return features.amax(dim) + features.mean(dim)
