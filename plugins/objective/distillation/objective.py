"""Distillation: a penalty on predicted densities that differ from those of a trained model, the teacher."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.calibration.module_flags import BATCH_NORM, set_flag
from framework.configuration.loading import load_with_description
from framework.configuration.paths import FilePath, flatten
from framework.data import Batch, Data
from framework.errors import ConfigError, quote
from framework.model import Predictor, independent_penalty
from framework.objective import Objective
from framework.uncertainty import own_batches, rows_per_model
from plugins.objective.distillation.divergence import from_teacher


class Distillation(Objective):
    """A penalty on predicted densities q that differ from the densities p of a trained model, the teacher.

    The penalty is the weight times the mean of KL(p ‖ q) over the samples of the batch, nats (Hinton, Vinyals & Dean
    2015). It has the same gradient as the cross-entropy of p and q, and is smallest for q = p. If the teacher is an
    ensemble, p is the mixture of its members, and one network learns the density of the whole ensemble. The penalty is
    added to the loss on the targets of the data, which has the weight 1.

    The teacher predicts in evaluation mode and is not trained. The trained student does not contain the teacher. Batch
    norm normalises by the moments of the batch, and does not update the running moments.

    Args:
        teacher: run folder, checkpoint file or MLflow run id of the teacher.
        weight: weight of the penalty, relative to the loss on the targets of the data.
        draws: number of targets that the teacher draws for each sample in each step, if the target is not a class.
        noise: standard deviation of normal noise that is added to the inputs of the penalty, in the units of the
            inputs, so that the student also learns what the teacher predicts around the training data.
        other_data: whether the teacher may have been trained with other settings of the data than this run.
        paths: files and folders that the teacher's configuration names. A path that is stored in the checkpoint is used
            only if it is repeated here, as in `paths={encoder: {rasterised: {body: ...}}}`.

    Raises:
        ConfigError: there is no teacher; its inputs or targets differ from those of the run, or are scaled in another
            way; or its data has other settings, and `other_data` is false. In training: `noise` is above 0 and the
            inputs are integers.
        CheckpointError: the teacher's checkpoint is damaged, or does not exist.
    """

    bibtex = "hinton2015distilling"

    def __init__(
        self,
        *,
        teacher: FilePath | None = None,
        weight: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 9.0,
        draws: Annotated[int, Field(ge=1, le=10_000)] = 16,
        noise: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0,
        other_data: bool = False,
        paths: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        if teacher is None:
            raise ConfigError(
                "objective.distillation.teacher is null, but distillation learns from a trained model. Train one, for "
                "example with uncertainty=[ensemble], and set objective.distillation.teacher to the run folder that "
                "it prints."
            )
        self.weight = weight
        self.draws = draws
        self.noise = noise
        self.other_data = other_data
        predictor, self.description = load_with_description(teacher, paths=flatten(paths or {}))
        # no submodule: it is neither trained nor stored
        self._teacher = (predictor.requires_grad_(False),)

    @property
    def teacher(self) -> Predictor:
        """The teacher, in evaluation mode."""
        return self._teacher[0]

    def check_data(self, data: Data, config: Mapping[str, Any]) -> None:
        """Refuse data to which the teacher does not apply.

        Raises:
            ConfigError: the teacher's inputs or targets differ from those of `data` or are scaled in another way; or
                the teacher's data has other settings, and `other_data` is false.
        """
        source = self.description
        compared = {
            "another target": (source.target, data.target),
            "another shape of inputs": (source.input_shape, tuple(data.input_shape)),
            "other input columns": (source.columns, tuple(data.columns)),
            "another state of the data, such as the scaling": (source.data_state, dict(data.state_dict())),
        }
        for difference, (stored, own) in compared.items():
            if not _equal(stored, own):
                raise ConfigError(
                    f"The teacher {source.path} has {difference} than this run: {quote(stored)}, but here "
                    f"{quote(own)}. Train the teacher with the data of this run, or give this run the data settings "
                    "of the teacher."
                )
        if self.other_data:
            return
        stored = source.config["data"]
        left_out = {key.removeprefix("data.") for key in source.dropped}
        for key in sorted({*stored, *config} - left_out):
            if not _equal(stored.get(key), config.get(key)):
                raise ConfigError(
                    f"The teacher {source.path} was trained with data.{key} = {quote(stored.get(key))}, but this run "
                    f"has {quote(config.get(key))}. The teacher may have seen test samples of this run, and the "
                    "results would then be too good. Use the same data settings, or set "
                    "objective.distillation.other_data=true if no test sample of this run trained the teacher."
                )

    def forward(self, predictor: Predictor, batch: Batch) -> Float[Tensor, ""]:
        """Return the weighted penalty of a batch."""
        # with one batch per member, all members see the inputs of the first
        inputs = batch["input"][: rows_per_model(predictor, len(batch["input"]))]
        if self.noise > 0:
            if not inputs.is_floating_point():
                raise ConfigError(
                    f"objective.distillation.noise = {self.noise:g} is added to numbers, but the inputs are of type "
                    f"{inputs.dtype}. Set noise to 0."
                )
            inputs = inputs + self.noise * torch.randn_like(inputs)
        with torch.no_grad():
            own = next(self.teacher.to(inputs.device).parameters(), inputs)
            teacher = self.teacher(inputs.to(own.dtype) if inputs.is_floating_point() else inputs)
        with set_flag(predictor, BATCH_NORM, "track_running_stats", False), own_batches(predictor, False):
            student = predictor.training_densities(inputs)
        divergence = independent_penalty(from_teacher(teacher, student, self.draws))
        mean = divergence.sum() / max(1, len(inputs))  # without samples the penalty is 0
        self.logged_terms = {"distillation": mean.detach()}
        return self.weight * mean


def _equal(first: Any, second: Any) -> bool:
    """Return whether two stored values are equal: also sequences, arrays and tensors of equal numbers, and two NaN."""
    first_values, second_values = _values(first), _values(second)
    if first_values is not None and second_values is not None:
        return len(first_values) == len(second_values) and all(map(_equal, first_values, second_values))
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        return set(first) == set(second) and all(_equal(first[key], second[key]) for key in first)
    if isinstance(first, float) and isinstance(second, float) and math.isnan(first):
        return math.isnan(second)
    return bool(first == second)


def _values(value: Any) -> Sequence[Any] | None:
    """Return the elements of a sequence, array or tensor; None for other values."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    return value if isinstance(value, list | tuple) else None
