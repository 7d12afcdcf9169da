"""Gradient-boosted trees (Chen & Guestrin 2016) as a density head."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import torch
import xgboost
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.distributions import Categorical, Distribution

from framework.density_head import DensityHead, Fitted
from framework.distributions.normals import IndependentNormals
from framework.errors import ConfigError
from framework.heads.parameters import require_validation
from framework.heads.unit import Unit
from framework.target import Target
from plugins.density_head.trees.heads_without_gradient import (
    FLOOR,
    WIDEST,
    load_any_shape,
    require_class_or_real,
    require_fitted,
    single,
    with_gradient_of_0,
)
from plugins.density_head.trees.stored_boosting import require_boosting
from plugins.density_head.trees.stored_forest import require_widths

Share = Annotated[float, Field(gt=0, le=1)]


class XGBoostHead(DensityHead, Fitted):
    """Trees that each correct the sum of the previous ones, fitted to all training samples at once.

    For classes, each class has its own sum of trees; the probabilities are the softmax of these sums, trained by
    cross-entropy. For reals, the density is normal, and its mean is the sum of the trees, trained by squared error. It
    has one standard deviation for each number of the target: the root mean squared residual on the training split after
    the fit, and on the validation split after `calibrate`. The output of the trees is piecewise constant in the
    features, and its gradient is 0. Predictions are float32.

    The model is stored as bytes in XGBoost's own portable binary format (UBJSON), which contains no code.

    Attributes:
        rounds: number of boosting rounds whose trees are used, counted from the first (a knob).

    Args:
        rounds: number of boosting rounds.
        depth: largest number of splits from root to leaf.
        rate: factor by which each round's trees are shrunk.
        samples: share of the training samples drawn in each round.
        features: share of the features drawn for each tree.
        weight: smallest sum of second derivatives of the loss in a leaf.
        splits: "hist" tries the borders of at most 256 bins of each feature as thresholds, "exact" the values of all
            samples. For few samples with very many features "exact" is faster and takes less memory, since the memory
            for bins grows with the number of features.

    Raises:
        ConfigError: the target is an angle, an image, or a single class.
        UserError: the head is used before it was fitted.
    """

    knobs: ClassVar[Mapping[str, tuple[int, ...]]] = {"rounds": (1, 3, 10, 30, 100)}
    bibtex = "chen2016xgboost"

    model: Tensor
    width: Tensor
    read: Tensor

    def __init__(
        self,
        target: Target,
        *,
        rounds: Annotated[int, Field(gt=0)] = 100,
        depth: Annotated[int, Field(gt=0)] = 6,
        rate: Share = 0.3,
        samples: Share = 1.0,
        features: Share = 1.0,
        weight: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1.0,
        splits: Literal["hist", "exact"] = "hist",
    ) -> None:
        super().__init__()
        require_class_or_real(target, by="density_head xgboost")
        self.classes = len(target.names) if target.kind == "class" else 0
        if self.classes == 1:
            raise ConfigError(
                f"density_head xgboost needs two classes or more, but this data set has one, {target.names[0]}. Choose "
                "other data."
            )
        self.numbers = self.classes or len(target.names)
        self.unit = Unit.of(target)
        self.rounds = rounds
        self.options = {
            "max_depth": depth,
            "learning_rate": rate,
            "subsample": samples,
            "colsample_bytree": features,
            "min_child_weight": weight,
            "tree_method": splits,
        }
        self.register_buffer("model", torch.zeros(0, dtype=torch.uint8))
        self.register_buffer("width", torch.ones(0 if self.classes else self.numbers, dtype=torch.float64))
        self.register_buffer("read", torch.zeros((), dtype=torch.int64))
        self.size = 0
        self.booster: xgboost.Booster | None = None
        load_any_shape(self, XGBoostHead._require, XGBoostHead._open)

    def fit(self, features: Float[Tensor, "sample size"], target: Tensor, seed: int) -> None:
        """Grow the trees from all training samples."""
        options: dict[str, Any] = {
            **self.options,
            "seed": seed % 2**31,
            "nthread": torch.get_num_threads(),
            "objective": "multi:softprob" if self.classes else "reg:squarederror",
        }
        if self.classes:
            options["num_class"] = self.classes
        wanted = target if self.classes else self.unit.standardise(target)
        matrix = xgboost.DMatrix(single(features).numpy(), wanted.cpu().numpy())
        fitted = xgboost.train(options, matrix, self.rounds, verbose_eval=False)
        stored = torch.frombuffer(fitted.save_raw("ubj"), dtype=torch.uint8)
        self.model = stored.clone().to(target.device)
        self.read.fill_(features.shape[1])
        self._open()
        if not self.classes:
            self._measure_width(features, target)

    def forward(self, raw: Float[Tensor, "*batch size"]) -> Distribution:
        """Return the density for raw parameters."""
        raw = require_fitted(raw, self.size, by="density_head xgboost")
        sums = self._sums(raw.reshape(-1, self.size)).to(raw).reshape(*raw.shape[:-1], self.numbers)
        sums = with_gradient_of_0(sums, raw)
        if self.classes:
            return Categorical(logits=sums.log_softmax(-1), validate_args=False)
        mean, scale, _ = self.unit.to_target_unit(sums, self.width.to(raw).expand_as(sums))
        return IndependentNormals(mean, scale)

    @torch.no_grad()
    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        """Set the standard deviations to the root mean squared residuals of the split; do nothing for classes."""
        if self.classes:
            return
        require_validation(raw, "A standard deviation is")
        self._measure_width(raw, target)

    def _measure_width(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        residual = self.unit.standardise(target.double()) - self._sums(raw).to(target.device)
        self.width.copy_(residual.square().mean(0).sqrt().clamp(FLOOR, WIDEST))

    def _sums(self, raw: Float[Tensor, "sample size"]) -> Float[Tensor, "sample number"]:
        """Return the sum of the trees' outputs for each class or number of the target, float32."""
        assert self.booster is not None
        rounds = min(max(1, self.rounds), self.booster.num_boosted_rounds())
        sums = self.booster.inplace_predict(
            single(raw).numpy(), iteration_range=(0, rounds), predict_type="margin"
        )
        return torch.from_numpy(sums).reshape(len(raw), self.numbers)

    def _require(self, arrays: Mapping[str, np.ndarray]) -> None:
        content, size = arrays["model"], arrays["read"]
        if (
            content.ndim != 1
            or size.ndim != 0
            or not 0 <= int(size) < 2**31
            or bool(len(content)) != bool(size)
        ):
            raise ValueError(
                f"the stored `model` has the shape {content.shape}, and `read`, the number of features that the trees "
                f"read, is {size.tolist()}; expected either a row of bytes in `model` and at least 1 feature in "
                "`read`, or no bytes and 0 features"
            )
        if len(content):
            require_boosting(content.tobytes(), self.classes, self.numbers, int(size))
        require_widths(arrays["width"], 0 if self.classes else self.numbers)

    def _open(self, *_: Any) -> None:
        """Build the library's model from the stored bytes."""
        self.size = int(self.read)
        self.booster = None
        if self.size:
            self.booster = xgboost.Booster({"nthread": torch.get_num_threads()})
            self.booster.load_model(bytearray(self.model.cpu().numpy()))
