"""Outlier scores from the features in front of the final layer, beside an unchanged density."""

import logging
from collections.abc import Callable, Iterable, Iterator
from typing import Annotated, Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.distributions import Distribution

from framework.calibration.final_layer import find_final_layer, run_final_layer
from framework.calibration.module_flags import evaluation_mode
from framework.calibration.validation import nonempty_batches
from framework.data import Batch
from framework.distributions.class_probabilities import class_probabilities
from framework.distributions.unchanged import ScoredDensity
from framework.errors import ConfigError, count_of
from framework.model import Model, Predictor
from framework.storage.weights import FINITE, FROM_0, require_state
from framework.target import Target
from framework.uncertainty import ReadsTraining, Uncertainty
from plugins.uncertainty.feature_score.statistics import (
    choose_samples,
    energy,
    fit_clusters,
    mahalanobis,
    merge_clusters,
    neighbour_distance,
    to_unit_length,
)

Method = Literal["mahalanobis", "relative_mahalanobis", "knn", "energy"]
MOST_FEATURES = 2048
"""Largest number of features whose covariance is stored (32 MiB in a checkpoint)."""
MOST_STORED = 2**26
"""Largest number of features of all stored training samples together (256 MiB in a checkpoint)."""
NEIGHBOURS, REFERENCES = 50, 5000
"""Defaults of `neighbours` and `references`."""
UNCALIBRATED = (
    "feature_score: the statistics of the training data are missing, because the model was not calibrated, so every "
    "outlier score is 0 and says nothing. Use the model that a run writes at its end (checkpoints/model.ckpt), or run "
    "mode=calibrate."
)
"""Warning before `calibrate`, for methods that need statistics."""
_log = logging.getLogger(__name__)


class FeatureScore(Uncertainty, ReadsTraining):
    """Unchanged densities, each with an outlier score from the features that the final linear layer reads.

    The score is high for inputs unlike the training data. The methods are:

    - "mahalanobis": squared Mahalanobis distance from the nearest class, with one covariance for all classes (Lee et
      al. 2018). A target that is no class counts as a single class.
    - "relative_mahalanobis": this distance minus the squared Mahalanobis distance from the mean of all training samples
      (Ren et al. 2021). The covariance of the second distance is the first one plus that of the class means.
    - "knn": distance from the k-th nearest of the stored training samples (Sun et al. 2022).
    - "energy": -log Σ exp of the logits (Liu et al. 2020), which needs no statistics of training samples.

    `calibrate` computes the statistics from the training split. If there is no training split, it uses the samples that
    it is given. Before `calibrate`, the scores of distances are 0, and a warning says so.
    `framework.distributions.unchanged.outlier_score` reads the score of a density. A wrapper around this one drops the
    scores, unless it leaves the density unchanged too.

    Args:
        method: one of the methods above.
        normalise: whether features are first scaled to Euclidean length 1; None: for "knn" only, as in Sun et al. 2022.
        shrinkage: share of the identity in the covariances; None: the estimate of Ledoit & Wolf 2004.
        neighbours: k of "knn"; None for 50. If there are fewer training samples, their number is used.
        references: largest number of training samples that "knn" stores; a random choice if there are more. None for
            5000.

    Attributes:
        counts: number of training samples of each class, an int64 buffer, if the method is a Mahalanobis distance.
        count: number of stored samples, an int64 buffer, if the method is "knn".

    Raises:
        ConfigError: a setting has no effect on the method; the model has no final linear layer that reads a vector, or
            several models; it has too many features; or the method needs classes or logits, which the model lacks.
        UserError: the validation split is empty.
    """

    bibtex = "lee2018simple, ren2021simple, sun2022out, liu2020energy, ledoit2004well"
    varies_weights = True  # a frozen network returns raw parameters only, and no features

    # one parameter for each setting of the methods, so that the schema checks them
    def __init__(
        self,
        model: Callable[[], Predictor],
        target: Target,
        *,
        method: Method = "mahalanobis",
        normalise: bool | None = None,
        shrinkage: Annotated[float, Field(ge=0, le=1)] | None = None,
        neighbours: Annotated[int, Field(ge=1)] | None = None,
        references: Annotated[int, Field(ge=1)] | None = None,
    ) -> None:
        super().__init__()
        own = {
            "normalise": normalise,
            "shrinkage": shrinkage,
            "neighbours": neighbours,
            "references": references,
        }
        require_effect(method, {name: value for name, value in own.items() if value is not None})
        if method in ("relative_mahalanobis", "energy"):
            target.require("class", by=f"uncertainty feature_score with method={method}")
        self.model = model()
        self.method: Method = method
        self.normalise = method == "knn" if normalise is None else normalise
        self.shrinkage = shrinkage
        self.neighbours = NEIGHBOURS if neighbours is None else neighbours
        self.references = REFERENCES if references is None else references
        self.classes = len(target.names) if target.kind == "class" else 1
        if method == "knn" and self.neighbours > self.references:
            raise ConfigError(
                f"uncertainty.feature_score.neighbours is {self.neighbours}, but only {self.references} training "
                "samples are stored (references). Lower neighbours or raise references."
            )
        self._register(network_of(self.model).layer.in_features)
        self._warned = False

    def _register(self, features: int) -> None:
        """Register the buffers of the method's statistics.

        Raises:
            ConfigError: they would be too large.
        """
        wide = features > MOST_FEATURES
        if self.method == "knn":
            if self.references * features > MOST_STORED:
                raise ConfigError(
                    f"uncertainty.feature_score.references = {self.references} samples of {features} features are more "
                    f"than {MOST_STORED:,} numbers. Lower references."
                )
            self.register_buffer("samples", torch.zeros(self.references, features))
            self.register_buffer("count", torch.zeros((), dtype=torch.int64))
            require_state(self, samples=FINITE, count=(0.0, float(self.references)))
        elif self.method != "energy":
            if wide:
                raise ConfigError(
                    f"The final layer reads {features:,} features, but uncertainty.feature_score.method={self.method} "
                    f"stores a matrix of all pairs and allows at most {MOST_FEATURES:,}. Set method to knn."
                )
            names = ("", "_of_all") if self.method == "relative_mahalanobis" else ("",)
            for name in names:
                classes = 1 if name else self.classes
                self.register_buffer(f"means{name}", torch.zeros(classes, features, dtype=torch.float64))
                self.register_buffer(f"counts{name}", torch.zeros(classes, dtype=torch.int64))
                self.register_buffer(f"whitening{name}", torch.eye(features, dtype=torch.float64))
                bounds = {f"means{name}": FINITE, f"counts{name}": FROM_0, f"whitening{name}": FINITE}
                require_state(self, **bounds)

    def forward(self, inputs: Tensor) -> Distribution:
        """Return the density for each input with its score; in training the density alone."""
        if self.training:
            return self.model(inputs)
        passed = run_network(self.model, inputs)
        if not self._warned and self.method != "energy":
            self._warned = True
            if not self._calibrated:
                _log.warning("%s", UNCALIBRATED)
        return ScoredDensity(passed.density, self._score(passed.features, passed.raw))

    @property
    def _calibrated(self) -> bool:
        """True if `calibrate` has computed the statistics, or a checkpoint with statistics was loaded."""
        return bool(self.get_buffer("count" if self.method == "knn" else "counts").sum() > 0)

    def _score(
        self, features: Float[Tensor, "batch feature"], raw: Float[Tensor, "batch raw"]
    ) -> Float[Tensor, "batch"]:
        if self.method == "energy":
            return energy(raw)
        features = self._prepare(features)
        if self.method == "knn":
            count = int(self.get_buffer("count"))
            if not count:
                return features.new_zeros(len(features))
            samples = self.get_buffer("samples")[:count]
            return neighbour_distance(features, samples, min(self.neighbours, count))
        score = self._distance(features, "")
        if self.method == "relative_mahalanobis":
            score = score - self._distance(features, "_of_all")
        return score

    def _distance(self, features: Float[Tensor, "batch feature"], name: str) -> Float[Tensor, "batch"]:
        means, counts, whitening = (
            self.get_buffer(f"{part}{name}") for part in ("means", "counts", "whitening")
        )
        return mahalanobis(features, means.double(), counts, whitening.double())

    def _prepare(self, features: Float[Tensor, "batch feature"]) -> Float[Tensor, "batch feature"]:
        """Return the features in float64, scaled to Euclidean length 1 if `normalise` is set."""
        features = features.double()
        return to_unit_length(features) if self.normalise else features

    @torch.no_grad()
    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Calibrate the wrapped model, and compute the statistics of the training split."""
        kept_batches = nonempty_batches(batches, by="feature_score")
        self.model.calibrate(kept_batches)
        with evaluation_mode(self):
            if self.method == "energy":
                require_logits(self.model, kept_batches[0]["input"])
            else:
                self._fit(kept_batches if self.training_split is None else self.training_split)

    def _fit(self, batches: Iterable[Batch]) -> None:
        def parts() -> Iterator[tuple[Tensor, Tensor]]:
            for batch in batches:
                features = self._prepare(run_network(self.model, batch["input"]).features)
                label = torch.zeros(len(features), dtype=torch.int64, device=features.device)
                yield features, label if self.classes == 1 else batch["target"]

        if self.method == "knn":
            chosen = choose_samples(parts, self.references)
            self.get_buffer("samples")[: len(chosen)] = chosen.to(self.get_buffer("samples"))
            self.get_buffer("count").fill_(len(chosen))
            few = (
                f", fewer than the {self.neighbours} neighbours that are set"
                if len(chosen) < self.neighbours
                else ""
            )
            self.remark = f"feature_score: the store holds {count_of(len(chosen), 'training sample')}{few}."
            return
        clusters = fit_clusters(parts, self.classes, self.shrinkage)
        self._store(clusters, "")
        if self.method == "relative_mahalanobis":
            self._store(merge_clusters(clusters), "_of_all")
        self.remark = (
            f"feature_score: {int(clusters.counts.sum())} training samples in {int((clusters.counts > 0).sum())} "
            f"classes; shrinkage of the covariance {clusters.shrinkage:.3g}."
            if self.classes > 1
            else f"feature_score: {int(clusters.counts.sum())} training samples; shrinkage of the covariance "
            f"{clusters.shrinkage:.3g}."
        )

    def _store(self, clusters: Any, name: str) -> None:
        for part in ("means", "counts", "whitening"):
            self.get_buffer(f"{part}{name}").copy_(getattr(clusters, part))


EFFECTIVE: dict[Method, tuple[str, ...]] = {
    "mahalanobis": ("normalise", "shrinkage"),
    "relative_mahalanobis": ("normalise", "shrinkage"),
    "knn": ("normalise", "neighbours", "references"),
    "energy": (),
}
"""Settings that have an effect on each method."""


def require_effect(method: Method, settings: dict[str, Any]) -> None:
    """Refuse settings that have no effect on the method.

    Raises:
        ConfigError: there are such settings.
    """
    idle = [name for name in settings if name not in EFFECTIVE[method]]
    if idle:
        allowed = ", ".join(EFFECTIVE[method]) or "no other settings"
        raise ConfigError(
            f"uncertainty.feature_score.{idle[0]} = {settings[idle[0]]} has no effect on method={method}, which reads "
            f"{allowed}. Leave {' and '.join(idle)} out, or choose another method."
        )


class Network(NamedTuple):
    """The single network of a predictor.

    Attributes:
        model: the predictor itself, or the only `Model` inside its wrappers.
        layer: final linear layer of the model.
    """

    model: Predictor
    layer: nn.Linear


class Pass(NamedTuple):
    """Results of one prediction.

    Attributes:
        features: what the final layer reads, (batch, feature).
        raw: what the final layer returns, (batch, raw).
        density: the density of the predictor.
    """

    features: Tensor
    raw: Tensor
    density: Distribution


def network_of(predictor: Predictor) -> Network:
    """Return the network whose features are scored: the predictor, or the only `Model` inside its wrappers.

    Raises:
        ConfigError: there are several models, or the model has no final linear layer.
    """
    model = predictor
    if any(isinstance(module, Uncertainty) for module in predictor.modules()):
        models = [module for module in predictor.modules() if isinstance(module, Model)]
        if len(models) != 1:
            raise ConfigError(
                f"uncertainty feature_score reads the features of one model, but {type(predictor).__name__} has "
                "several models, or computes several together. Leave one of the two out of uncertainty."
            )
        model = models[0]
    layer = find_final_layer(model)
    if layer is None:
        raise ConfigError(
            "uncertainty feature_score reads the features in front of the final linear layer, but this model has no "
            "such layer: its head reads the features themselves, or is fitted at once, or has several networks. Choose "
            "another density_head, or leave feature_score out."
        )
    return Network(model, layer)


def run_network(predictor: Predictor, inputs: Tensor) -> Pass:
    """Return the density of a predictor for inputs, and what its final layer reads and returns.

    Raises:
        ConfigError: a predictor that is no `Model` calls its final layer several times, or not with vectors.
    """
    model, layer = network_of(predictor)
    features, raw, density = run_final_layer(model, layer, inputs, by="feature_score")
    if isinstance(model, Model):
        density = model.head(raw) if predictor is model else predictor(inputs)
    assert density is not None
    return Pass(features, raw, density)


def require_logits(predictor: Predictor, inputs: Tensor) -> None:
    """Refuse a model whose raw parameters are not the logits of its classes.

    Raises:
        ConfigError: the softmax of the raw parameters is not the predicted probability of the classes.
    """
    model, _ = network_of(predictor)
    passed = run_network(model, inputs)
    probabilities = class_probabilities(passed.density)
    softmax = passed.raw.double().softmax(-1)
    if softmax.shape != probabilities.shape or not torch.allclose(softmax, probabilities, rtol=0, atol=1e-3):
        raise ConfigError(
            "uncertainty.feature_score.method=energy needs one logit for each class, but the raw parameters of this "
            "model's density head are no such logits. Choose density_head=categorical, or another method."
        )
