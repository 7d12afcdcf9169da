"""Basis point sets: features of a cloud relative to a fixed set of points."""

from collections.abc import Iterable
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.encoder import Encoder, FitsInputs
from framework.errors import ConfigError
from framework.geometry.clouds import Normalisation, require_clouds
from framework.geometry.nearest import Queries
from framework.storage.weights import FINITE, require_state
from plugins.encoder.bps import basis as sets
from plugins.encoder.bps import selection
from plugins.encoder.bps.encoding import (
    Basis,
    channels,
    columns_of,
    encode,
    encode_distances,
    prepare_basis,
    width,
)


class BPS(Encoder, FitsInputs):
    """Encoder that finds the cloud point nearest to each point of a fixed basis, and returns features of these points.

    The features are defined in thesis eq. 6.1-6.5.

    With the basis "grid", features are (channels, side, side, side), where x changes slowest. With the other bases,
    features are (channels × points,), one channel after the other. The basis is stored in the checkpoint.

    Args:
        input_shape: (points, columns) of the largest cloud; coordinates in the first three columns.
        input_columns: names of the columns, if features are attributes.
        basis: choice of basis points (`plugins.encoder.bps.basis`); "selected": points of a random set that are chosen
            before training by the distances of the training clouds (`plugins.encoder.bps.selection`).
        points: number of basis points, k; side³ for a "grid".
        radius: radius of the ball of basis points, or half the edge of a "grid", in units of the normalised cloud.
        features: names of the features of each basis point, in order: "distance" (1 number, eq. 6.4), "delta" (3
            numbers, eq. 6.5), and attributes of the nearest point: "color" (3 numbers: red, green, blue), "normal" (3
            numbers), or the name of a column (1 number).
        normalise: "unit_ball", "robust" or "none" (`framework.geometry.clouds.normalise_clouds`).
        basis_seed: seed of "ball_uniform" and of the points among which "selected" chooses; the run's seed has no
            influence.
        rotation_invariant: whether to encode each cloud along its own axes (`plugins.encoder.bps.frame`).

    Raises:
        ConfigError: the input is not a cloud; a feature is named twice or needs a column that the clouds lack; the
            basis is "grid" and `points` is not the cube of an integer; or the basis is "selected" and `points` is more
            than 2048.
    """

    fixed = True
    bibtex = "prokudin2019efficient"

    basis: Tensor

    # More than eight parameters: each keyword is a config key that a user sets alone.
    def __init__(
        self,
        input_shape: tuple[int, ...],
        input_columns: tuple[str, ...] = (),
        *,
        basis: sets.Strategy | Literal["selected"] = "ball_uniform",
        points: Annotated[int, Field(gt=0, le=10_000_000)] = 512,
        radius: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0,
        features: Annotated[list[str], Field(min_length=1)] = ["distance"],  # noqa: B006 - never written
        normalise: Normalisation = "unit_ball",
        basis_seed: Annotated[int, Field(ge=0, lt=2**32)] = 13,
        rotation_invariant: bool = False,
    ) -> None:
        super().__init__()
        require_clouds(input_shape, by="encoder bps")
        if len(set(features)) < len(features):
            raise ConfigError(
                f"encoder bps: features={features} names a feature twice. Name each feature once."
            )
        for feature in features:
            columns_of(feature, input_columns)
        if basis == "selected" and points > selection.MOST_POINTS:
            raise ConfigError(
                f"encoder bps: basis=selected chooses at most {selection.MOST_POINTS} basis points, but got "
                f"points={points}. Choose fewer points, or another basis."
            )
        self.columns = input_columns
        self.features = features
        self.normalise: Normalisation = normalise
        self.rotation_invariant = rotation_invariant
        self.needs_fit = basis == "selected"
        self.radius, self.basis_seed = radius, basis_seed
        strategy = "ball_uniform" if basis == "selected" else basis
        basis_points = sets.basis(strategy, points, radius, basis_seed).to(torch.get_default_dtype())
        self.register_buffer("basis", basis_points)
        require_state(self, basis=FINITE)
        self._prepared: Basis | None = None
        total = sum(width(feature) for feature in features)
        self.output_shape = (total, *[sets.side(points)] * 3) if basis == "grid" else (total * points,)

    def forward(self, inputs: Float[Tensor, "batch points columns"]) -> Float[Tensor, "batch *features"]:
        """Return the features of the clouds."""
        basis = self.prepared_basis()
        if self.features == ["distance"] and self.normalise == "unit_ball" and not self.rotation_invariant:
            distances = encode_distances(inputs, basis)
            if distances is not None:
                return distances.reshape(-1, *self.output_shape)
        encoding = encode(
            inputs,
            basis,
            self.features,
            self.normalise,
            self.columns,
            rotation_invariant=self.rotation_invariant,
        )
        return channels(encoding).reshape(-1, *self.output_shape)

    @torch.no_grad()
    def fit_inputs(self, batches: Iterable[Float[Tensor, "batch points columns"]]) -> None:
        """Choose the basis points for the training clouds, the most informative first (`selection`)."""
        count = len(self.basis)
        points = sets.basis(
            "ball_uniform", selection.candidate_count(count), self.radius, self.basis_seed
        ).to(self.basis)
        candidates = prepare_basis(points)
        distances = (
            encode(
                clouds,
                candidates,
                normalise=self.normalise,
                columns=self.columns,
                rotation_invariant=self.rotation_invariant,
            ).features["distance"]
            for clouds in batches
        )
        self.basis.copy_(points[selection.select(distances, count).to(points.device)])

    def prepared_basis(self) -> Basis:
        """Return the basis prepared for search; it is prepared again only if its device, dtype or values changed."""
        if torch.compiler.is_exporting():  # a trace compares no values
            return Basis(self.basis, Queries(self.basis))
        cached = self._prepared
        if cached is None or not _same(cached.points, self.basis):
            # a copy, which stays as it is if the buffer is changed in place
            cached = self._prepared = prepare_basis(self.basis.clone())
        return cached


def _same(some: Tensor, other: Tensor) -> bool:
    return some.device == other.device and some.dtype == other.dtype and torch.equal(some, other)
