"""PointNet (Qi et al. 2017), for classification."""

from typing import Annotated, Literal

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn

from plugins.encoder.point_sets.layers import layers
from plugins.encoder.point_sets.point_sets import ALL_POINTS, CloudNetwork, Reading
from plugins.encoder.point_sets.pooled import largest_after

Width = Annotated[int, Field(gt=0)]
LOCAL = 2
"""Number of layers that every point passes before its features are transformed."""


class PointNet(CloudNetwork):
    """Network that passes every point through the same layers and takes the maximum of each channel over the cloud.

    "full" also predicts two matrices from the cloud: a 3 × 3 matrix that every point is multiplied by, and a matrix
    that the features of every point are multiplied by after two layers. The paper adds a term to the loss that keeps
    the second matrix near a rotation. An encoder has no loss, so this term is left out here. "vanilla" has no such
    matrices. Every layer has batch norm and ReLU. Neither the order of the points nor padding changes the features.

    Args:
        input_shape: (points, columns).
        variant: "full" or "vanilla".
        point_widths: number of outputs of each layer that every point passes; the networks that predict the matrices
            have all of these layers but the first two.
        widths: number of outputs of each layer after the maximum; the last is the length of the features.
        dropout: probability of dropping an output of the last layer.
        reading: the part of the clouds that is read; the first matrix changes only x, y, z.
    """

    bibtex = "qi2017pointnet"

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        variant: Literal["full", "vanilla"] = "full",
        point_widths: Annotated[list[Width], Field(min_length=LOCAL + 1)] = [64, 64, 64, 128, 1024],  # noqa: B006 - never written
        widths: Annotated[list[Width], Field(min_length=1)] = [512, 256],  # noqa: B006
        dropout: Annotated[float, Field(ge=0, lt=1)] = 0.3,
        reading: Reading = ALL_POINTS,
    ) -> None:
        super().__init__(input_shape, "encoder pointnet", reading)
        after = point_widths[LOCAL:]
        full = variant == "full"
        self.input_matrix = Matrix(3, after, widths) if full else None
        self.local = layers(self.columns, point_widths[:LOCAL])
        self.feature_matrix = Matrix(point_widths[LOCAL - 1], after, widths) if full else None
        self.deep = layers(point_widths[LOCAL - 1], after)
        self.whole = layers(after[-1], widths)
        self.dropout = nn.Dropout(dropout)
        self.output_shape = (widths[-1],)

    def encode(
        self, values: Float[Tensor, "point columns"], counts: Int[Tensor, "batch"]
    ) -> Float[Tensor, "batch length"]:
        if self.input_matrix is not None:
            transformed = multiply_by_matrices(
                values[:, :3], self.input_matrix(values[:, :3], counts), counts
            )
            values = torch.cat([transformed, values[:, 3:]], 1)
        values = self.local(values)
        if self.feature_matrix is not None:
            values = multiply_by_matrices(values, self.feature_matrix(values, counts), counts)
        return self.dropout(self.whole(largest_after(self.deep, values, counts)))


class Matrix(nn.Module):
    """A square matrix that a small PointNet predicts from a cloud; it is near the identity before training.

    Args:
        size: number of rows and of columns of the matrix, and length of a point's vector.
        point_widths: number of outputs of each layer that every point passes.
        widths: number of outputs of each layer after the maximum.
    """

    def __init__(self, size: int, point_widths: list[int], widths: list[int]) -> None:
        super().__init__()
        self.size = size
        self.each = layers(size, point_widths)
        self.whole = layers(point_widths[-1], widths)
        self.entries = nn.Linear(widths[-1], size * size)
        with (
            torch.no_grad()
        ):  # small, not 0 as in the paper, so that the layers before have a gradient from the first step
            self.entries.weight.mul_(0.01)
            self.entries.bias.copy_(torch.eye(size).flatten())

    def forward(
        self, values: Float[Tensor, "point size"], counts: Int[Tensor, "batch"]
    ) -> Float[Tensor, "batch size size"]:
        """Return the matrix of each cloud.

        Args:
            values: concatenated points of all clouds.
            counts: number of points of each cloud.
        """
        entries = self.entries(self.whole(largest_after(self.each, values, counts)))
        return entries.unflatten(1, (self.size, self.size))


def multiply_by_matrices(
    values: Float[Tensor, "point size"],
    matrices: Float[Tensor, "batch size size"],
    counts: Int[Tensor, "batch"],
) -> Float[Tensor, "point size"]:
    """Return every point times the matrix of its cloud.

    Args:
        values: concatenated points of all clouds.
        matrices: matrix of each cloud.
        counts: number of points of each cloud.
    """
    if torch.compiler.is_exporting():
        return (values.unflatten(0, (counts.shape[0], -1)) @ matrices).flatten(0, 1)
    parts = zip(values.split(counts.tolist()), matrices, strict=True)
    return torch.cat([values[:0], *(part @ matrix for part, matrix in parts)])
