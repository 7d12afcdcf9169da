"""Deep Sets (Zaheer et al. 2017), in the form for point clouds."""

from typing import Annotated, Literal

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn

from framework.encoder import Encoder
from framework.geometry.clouds import Normalisation
from plugins.encoder.point_sets.point_sets import Reading, columns_read, largest, over_points, to_points

Width = Annotated[int, Field(gt=0)]
ACTIVATION = {"tanh": nn.Tanh, "elu": nn.ELU}


class DeepSets(Encoder):
    """Equivariant layers on each point's difference from the maximum over its cloud, then a maximum over the cloud.

    The layer is x ↦ σ(β + (x - 1 max x) Γ), which the paper uses on clouds. The features do not depend on the order of
    the points or on padding. They do not depend on a value that all points have in common either, such as a shift of
    the cloud.

    Args:
        input_shape: (points, columns).
        channels: outputs of each equivariant layer.
        widths: outputs of each layer after the maximum; the last is the length of the features.
        activation: σ.
        dropout: probability of dropping a number before and after each layer that follows the maximum.
        points: largest number of points that are read of a cloud, the first ones; None for all. 100 is the thesis's
            "micro".
        normalise: as of framework.geometry.clouds.normalise_clouds.
        attributes: whether columns after x, y, z are read too.

    Raises:
        ConfigError: the input is no cloud, or has no attributes to read.
    """

    bibtex = "zaheer2017deep"  # noqa: E501

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        channels: Annotated[list[Width], Field(min_length=1)] = [256, 256, 256],  # noqa: B006 - never written
        widths: Annotated[list[Width], Field(min_length=1)] = [256],  # noqa: B006
        activation: Literal["tanh", "elu"] = "tanh",
        dropout: Annotated[float, Field(ge=0, lt=1)] = 0.5,
        points: Annotated[int, Field(gt=0)] | None = None,
        normalise: Normalisation = "unit_ball",
        attributes: bool = False,
    ) -> None:
        super().__init__()
        columns = columns_read(input_shape, "encoder deepsets", attributes)
        self.reading = Reading(columns, points, normalise)
        lengths = [columns, *channels]
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

    def forward(self, inputs: Tensor) -> Float[Tensor, "batch length"]:
        """Return the features of the clouds."""
        dtype = next(self.parameters()).dtype
        return over_points(self._described, inputs, self.reading, dtype, training=self.training)

    def _described(
        self, values: Float[Tensor, "point columns"], counts: Int[Tensor, "batch"]
    ) -> Float[Tensor, "batch length"]:
        if torch.is_grad_enabled() and values.device.type == "cpu":
            rows, counts = self._attaining(values, counts)
            values = values.index_select(0, rows)
        *others, final = self.equivariant
        for layer in others:
            values = self.activation(layer(below_largest(values, counts)))  # Zaheer et al. 2017, §4.2
        # σ is increasing, so that it may be applied after the maximum
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
        found = []
        for part in values.split(counts.tolist()):  # the numbers of one cloud stay in a CPU's cache
            most, index = part.mT.max(1, keepdim=True)
            columns, chosen = part.mT, [index]
            for layer in self.equivariant:
                weight, bias = layer.get_parameter("weight"), layer.get_parameter("bias")
                columns = torch.addmm(bias.unsqueeze(1), weight, columns - most)
                columns = columns if layer is final else self.activation(columns)
                most, index = columns.max(1, keepdim=True)
                chosen.append(index)
            found.append(torch.cat(chosen).unique())
        start = (counts.cumsum(0) - counts).tolist()
        rows = torch.cat([counts[:0], *(first + index for first, index in zip(start, found, strict=True))])
        return rows, counts.new_tensor([len(index) for index in found])


def below_largest(
    values: Float[Tensor, "point channels"], counts: Int[Tensor, "batch"]
) -> Float[Tensor, "point channels"]:
    """Return x - 1 max x, with the maximum over each cloud."""
    return values - to_points(largest(values, counts), counts)
