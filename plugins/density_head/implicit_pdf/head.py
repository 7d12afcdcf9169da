"""The implicit-PDF head: a network that reads features and a rotation, and gives its log-density up to a constant."""

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from framework.density_head import DensityHead
from framework.geometry import quaternions
from framework.geometry.rotation import viewpoint_rotation
from framework.geometry.rotation_grid import centres
from framework.heads.parameters import require_finite
from framework.heads.rotations import require_rotation
from framework.heads.viewpoints import log_volume
from framework.target import Target
from plugins.density_head.implicit_pdf.density import CellDensity

Cells = Literal[72, 576, 4608, 36864, 294912]
LARGEST_FEATURE = 30.0
"""Bound of the features that the network reads, so that it stays accurate for raw parameters of any size."""
CHUNK = 2**22
"""Largest number of activations of a hidden layer that are computed at once."""


class ImplicitPDFHead(DensityHead):
    """Density of rotations p(R|x) ∝ exp f(x, R) with a network f of features x and rotation R (Murphy et al. 2021).

    The raw parameters are the features' part of the first layer: with the bounded raw parameters r and the positional
    encoding γ(R) of the rotation matrix, the first layer is ReLU(r + W γ(R)). Then follow `layers` hidden layers and a
    linear one.

    The density of a prediction is constant in each of `cells` cells of equal volume, with f at the centre of the cell,
    so that it is normalised exactly. The constant cells cost log-likelihood. Let h be the width of a cell, and σ > h
    the standard deviation of the true density about an axis. The cost is then about h²/(24 σ²) nats for each of the
    three axes: 0.02 nats for 36,864 cells (h = 7.5°) and σ = 10°.

    The loss compares f at the label R with f at the centres Rᵢ of n = `training_cells` cells. The centres are rotated
    by a random rotation A, which the samples of a batch share. With the elevation e of the label, the loss is

        -f(x, R) + log((exp f(x, R) + Σᵢ exp f(x, Rᵢ A)) / (n + 1)) - log(cos e / 8π²).

    Murphy et al. rotate the centres so that one of them is the label; here the label is added to the centres. f then
    learns the log-density up to a constant that may depend on x.

    Args:
        hidden: width of the layers.
        layers: number of hidden layers after the first.
        frequencies: number of frequencies of the encoding: sin and cos of 2ʲπ times each element of the matrix.
        training_cells: number of rotations with which the loss compares a label.
        cells: number of cells of the density.

    Raises:
        ConfigError: the target is not azimuth, elevation and tilt, in this order.
    """

    bibtex = "murphy2021implicit, yershova2010generating, gorski2005healpix"
    knobs: ClassVar[Mapping[str, tuple[int, ...]]] = {"cells": (576, 4608, 36864, 294912)}

    def __init__(
        self,
        target: Target,
        *,
        hidden: Annotated[int, Field(gt=0, le=4096)] = 64,
        layers: Annotated[int, Field(ge=0, le=16)] = 2,
        frequencies: Annotated[int, Field(ge=1, le=8)] = 3,
        training_cells: Cells = 576,
        cells: Cells = 36864,
    ) -> None:
        super().__init__()
        require_rotation(target, by="implicit_pdf")
        self.frequencies = frequencies
        self.training_cells = training_cells
        self.cells = cells
        self.size = hidden
        self.of_rotation = nn.Linear(18 * frequencies, hidden, bias=False)
        body: list[nn.Module] = [nn.ReLU()]
        for _ in range(layers):
            body += [nn.Linear(hidden, hidden), nn.ReLU()]
        self.body = nn.Sequential(*body, nn.Linear(hidden, 1, bias=False))

    def forward(self, raw: Float[Tensor, "*batch size"]) -> CellDensity:
        raw = require_finite(raw, self.size)
        encoded = self.of_rotation(self._encode(centres(self.cells)))
        rows = raw.reshape(-1, self.size)
        count = max(1, CHUNK // (self.cells * self.size))
        parts = [self._log_density(part.unsqueeze(-2), encoded) for part in rows.split(count)]
        logits = torch.cat(parts).reshape(*raw.shape[:-1], self.cells)
        return CellDensity(torch.log_softmax(logits, -1))

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        raw = require_finite(raw, self.size)
        turn = torch.randn(4, dtype=torch.float64, device=raw.device)
        turn = turn / torch.linalg.vector_norm(turn)
        grid = quaternions.of_viewpoint(centres(self.training_cells).to(raw.device))
        others = self._encode(quaternions.to_viewpoint(quaternions.product(grid, turn)))
        at_others = self._log_density(raw.unsqueeze(-2), self.of_rotation(others))
        at_label = self._log_density(raw, self.of_rotation(self._encode(target)))
        total = torch.logsumexp(torch.cat([at_label.unsqueeze(-1), at_others], -1), -1)
        volume = log_volume(target[..., 1].double())
        return total - at_label - math.log(self.training_cells + 1) - volume.to(raw.dtype)

    def _encode(self, angles: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape numbers"]:
        """Return sin and cos of 2ʲπ times each element of the rotation matrix, j = 0 … `frequencies` - 1.

        `angles` are azimuth, elevation and tilt of the rotation. The result has the dtype of the weights.
        """
        weight = self.of_rotation.weight
        matrix = viewpoint_rotation(angles.double()).flatten(-2).to(weight.device)
        octaves = 2.0 ** torch.arange(self.frequencies, dtype=torch.float64, device=weight.device)
        phase = (math.pi * matrix.unsqueeze(-1) * octaves).flatten(-2)
        return torch.cat([phase.sin(), phase.cos()], -1).to(weight.dtype)

    def _log_density(self, raw: Tensor, encoded: Tensor) -> Tensor:
        """Return f for raw parameters and encoded rotations, whose shapes broadcast except for the last dimension."""
        bounded = LARGEST_FEATURE * torch.tanh(raw.to(encoded.dtype) / LARGEST_FEATURE)
        return self.body(bounded + encoded).squeeze(-1)
