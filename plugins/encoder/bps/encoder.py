"""Basis point sets: features of a cloud relative to a fixed set of points."""

from collections.abc import Iterable, Sequence
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from framework.encoder import Encoder, FitsInputs
from framework.errors import ConfigError
from framework.geometry.clouds import Normalisation, require_clouds
from framework.geometry.nearest import Queries, prepare
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

SPEED = 10.0
"""Factor by which a learned basis moves faster than the other parameters of a model, with an optimizer like Adam.

The distances of a cloud change little if a basis point moves by the usual step of a weight.
"""


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
        learned: whether the basis points are parameters that are trained with the model, starting from `basis` (like
            the probing points of Li et al. 2016). The distance |x - b| of a basis point b from its nearest point x has
            the gradient (b - x) / |b - x| in b. The encoder is then not `fixed`.

    Raises:
        ConfigError: the input is not a cloud; a feature is named twice or needs a column that the clouds lack; the
            basis is "grid" and `points` is not the cube of an integer; the basis is "selected" and `points` is more
            than 2048; or `learned` is true, and the basis is "grid" or no feature is "distance" or
            "delta".
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
        learned: bool = False,
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
        if learned:
            _require_learnable(basis, features)
        self.columns = input_columns
        self.features = features
        self.normalise: Normalisation = normalise
        self.rotation_invariant = rotation_invariant
        self.needs_fit = basis == "selected"
        self.radius, self.basis_seed = radius, basis_seed
        strategy = "ball_uniform" if basis == "selected" else basis
        basis_points = sets.basis(strategy, points, radius, basis_seed).to(torch.get_default_dtype())
        self.register_buffer("basis", basis_points)
        self.fixed = not learned
        self.moved = nn.Parameter(torch.zeros_like(basis_points)) if learned else None
        require_state(self, basis=FINITE)
        self._prepared: Basis | None = None
        total = sum(width(feature) for feature in features)
        self.output_shape = (total, *[sets.side(points)] * 3) if basis == "grid" else (total * points,)

    def forward(self, inputs: Float[Tensor, "batch points columns"]) -> Float[Tensor, "batch *features"]:
        """Return the features of the clouds."""
        learning = self.moved is not None and torch.is_grad_enabled()
        basis = self._moving_basis() if learning else self.prepared_basis()
        plain = (
            self.features == ["distance"] and self.normalise == "unit_ball" and not self.rotation_invariant
        )
        if plain and not learning:
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

    def basis_points(self) -> Float[Tensor, "k 3"]:
        """Return the basis points; they have a gradient if they are learned."""
        return self.basis if self.moved is None else self.basis + SPEED * self.moved

    def prepared_basis(self) -> Basis:
        """Return the basis prepared for search; it is prepared again only if its device, dtype or values changed."""
        points = self.basis_points().detach()
        if torch.compiler.is_exporting():  # a trace compares no values
            return Basis(points, Queries(points))
        cached = self._prepared
        if cached is None or not _same(cached.points, points):
            # a copy, which stays as it is if the buffer is changed in place
            cached = self._prepared = prepare_basis(points.clone())
        return cached

    def _moving_basis(self) -> Basis:
        """Return a learned basis, whose points have a gradient; it is prepared for a single search."""
        points = self.basis_points()
        return Basis(points, prepare(points, once=True))


def _require_learnable(basis: str, features: Sequence[str]) -> None:
    """Require a basis and features with which basis points can be learned.

    Raises:
        ConfigError: the basis points cannot be learned.
    """
    if basis == "grid":
        raise ConfigError(
            "encoder bps: learned=true moves the basis points, but basis=grid is for convolutions over a regular grid. "
            "Choose another basis, such as ball_uniform, or set learned to false."
        )
    if not {"distance", "delta"} & set(features):
        raise ConfigError(
            f"encoder bps: learned=true needs a feature that changes with the basis points, but features={features} "
            "are attributes of points of the cloud. Add distance or delta, or set learned to false."
        )


def _same(some: Tensor, other: Tensor) -> bool:
    return some.device == other.device and some.dtype == other.dtype and torch.equal(some, other)
