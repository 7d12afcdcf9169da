"""Deep Sets (Zaheer et al. 2017), in their variant for point clouds."""

from typing import Annotated, Literal

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn

from plugins.encoder.point_sets.point_sets import (
    ALL_POINTS,
    CloudNetwork,
    Reading,
    largest,
    repeat_for_points,
)

Width = Annotated[int, Field(gt=0)]
ACTIVATION = {"tanh": nn.Tanh, "elu": nn.ELU}


class DeepSets(CloudNetwork):
    """Equivariant layers on each point's difference from the maximum over its cloud, then a maximum over the cloud.

    The equivariant layer is x ↦ σ(β + (x - 1 max x) Γ), as in the paper's network for clouds. The rows of x are the
    points of a cloud, max x is the row of the columns' maxima, 1 is a column of ones, and β and Γ are the layer's bias
    and weight. The features do not depend on the order of the points or on padding. Adding the same vector to all
    points does not change the features either.

    Args:
        input_shape: (points, columns).
        channels: number of outputs of each equivariant layer.
        widths: number of outputs of each layer after the maximum; the last is the length of the features.
        activation: the function σ.
        dropout: probability of dropping a number before and after each layer that follows the maximum.
        reading: the part of the clouds that is read. With `points` = 100 the network is the one that the thesis calls
            "micro".
    """

    bibtex = "zaheer2017deep"

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        channels: Annotated[list[Width], Field(min_length=1)] = [256, 256, 256],  # noqa: B006 - never written
        widths: Annotated[list[Width], Field(min_length=1)] = [256],  # noqa: B006
        activation: Literal["tanh", "elu"] = "tanh",
        dropout: Annotated[float, Field(ge=0, lt=1)] = 0.5,
        reading: Reading = ALL_POINTS,
    ) -> None:
        super().__init__(input_shape, "encoder deepsets", reading)
        lengths = [self.columns, *channels]
        self.equivariant = nn.ModuleList(
            nn.Linear(before, after) for before, after in zip(lengths, channels, strict=False)
        )
        self.activation = ACTIVATION[activation]()
        after: list[nn.Module] = [nn.Dropout(dropout)]
        length = channels[-1]
        for width in widths:
            after += [nn.Linear(length, width), ACTIVATION[activation](), nn.Dropout(dropout)]
            length = width
        self.whole = nn.Sequential(*after)
        self.output_shape = (length,)

    def encode(
        self, values: Float[Tensor, "point columns"], counts: Int[Tensor, "batch"]
    ) -> Float[Tensor, "batch length"]:
        if torch.is_grad_enabled() and values.device.type == "cpu":
            rows, counts = self._attaining(values, counts)
            values = values.index_select(0, rows)
        *earlier, final = self.equivariant
        for layer in earlier:
            values = self.activation(layer(below_largest(values, counts)))  # Zaheer et al. 2017, §4.2
        # σ is increasing, so that it can be applied after the maximum
        return self.whole(self.activation(largest(final(below_largest(values, counts)), counts)))

    @torch.no_grad()
    def _attaining(
        self, values: Float[Tensor, "point columns"], counts: Int[Tensor, "batch"]
    ) -> tuple[Int[Tensor, "attaining"], Int[Tensor, "batch"]]:
        """Return the rows of the points that attain a maximum of any layer, and their number in each cloud.

        The network gives the same features for these points alone, and no other point has a gradient (PointNet's
        critical points: Qi et al. 2017, §4.3, theorem 2). Where several points attain a maximum, one is chosen.
        """
        *_, final = self.equivariant
        attaining_points = []
        for part in values.split(
            counts.tolist()
        ):  # one cloud at a time, so that its numbers stay in a CPU's cache
            most, index = part.mT.max(1, keepdim=True)
            columns, chosen = part.mT, [index]
            for layer in self.equivariant:
                weight, bias = layer.get_parameter("weight"), layer.get_parameter("bias")
                columns = torch.addmm(bias.unsqueeze(1), weight, columns - most)
                columns = columns if layer is final else self.activation(columns)
                most, index = columns.max(1, keepdim=True)
                chosen.append(index)
            attaining_points.append(torch.cat(chosen).unique())
        start = (counts.cumsum(0) - counts).tolist()
        rows = torch.cat(
            [counts[:0], *(first + index for first, index in zip(start, attaining_points, strict=True))]
        )
        return rows, counts.new_tensor([len(index) for index in attaining_points])


def below_largest(
    values: Float[Tensor, "point channels"], counts: Int[Tensor, "batch"]
) -> Float[Tensor, "point channels"]:
    """Return the values of each point minus the maximum of each channel over the points of its cloud.

    Args:
        values: values of the concatenated points of all clouds.
        counts: number of points of each cloud.
    """
    if torch.compiler.is_exporting():  # all clouds of a trace have equally many rows
        return (values.unflatten(0, (counts.shape[0], -1)) - largest(values, counts)[:, None]).flatten(0, 1)
    return values - repeat_for_points(largest(values, counts), counts)
