"""mode=calibrate: fit uncertainty wrappers around a trained model to the validation split, and test it with them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from framework.configuration.config import Config, Options
from framework.configuration.registry import load
from framework.configuration.schema import build, resolve
from framework.datasets.fields import fetch
from framework.distributions.protocol import value_set
from framework.errors import ConfigError
from framework.model import FrozenFrontEnd, Predictor
from framework.reports.report import report_test
from framework.runs.run import open_run
from framework.runs.session import add_test_parts, calibrate, for_trained
from framework.target import Target
from framework.uncertainty import FollowsTraining, SelfTraining, SeveralModels, self_training

FEW = 2
"""Number of samples with which uncertainty wrappers are tried before they are fitted."""


class CalibrateOptions(Options):
    """Options of mode=calibrate, which has none: `uncertainty` chooses the wrappers to fit."""


def run(config: Config) -> None:
    """Calibrate the wrappers, write checkpoints/model.ckpt for the other modes, test the model and print its table row.

    Raises:
        ConfigError: No wrapper is chosen, or a chosen wrapper must be trained or has been fitted already.
    """
    config.options(CalibrateOptions)
    wrappers = resolve_wrappers(config.settings.uncertainty or {})
    session = for_trained(config)
    if self_training(session.predictor) is not None and not config.first_override("data"):
        raise ConfigError(
            f"{config.settings.checkpoint} was trained on the validation split too, so that a wrapper fitted to it "
            "would be overconfident. Choose the wrapper when you train, or give other data with data=..."
        )
    existing = [part["name"] for part in session.parts["uncertainty"]]
    for part in wrappers:
        if part["name"] in existing:
            raise ConfigError(
                f"uncertainty={part['name']}: {config.settings.checkpoint} is already wrapped in "
                f"{' + '.join(existing)}, so the same wrapper would be fitted twice. Give the checkpoint of the model "
                "without this wrapper, or choose another wrapper."
            )
    parts = {**session.parts, "uncertainty": [*session.parts["uncertainty"], *wrappers]}
    method = " + ".join([session.method, *(part["name"] for part in wrappers)])
    splits = session.data.splits()
    inputs = fetch(splits.validation, range(min(FEW, len(splits.validation))))["input"]  # type: ignore[arg-type]
    predictor = wrap_trained(session.predictor, wrappers, session.target, inputs)
    session = add_test_parts(replace(session, parts=parts, method=method, predictor=predictor))
    with open_run(session.config) as run:
        session.record(run)
        calibrate(session)
        session.save_model(run)
        report_test(run, session)


def resolve_wrappers(wrappers: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the checked configs of the uncertainty wrappers in `wrappers`, innermost first.

    Raises:
        ConfigError: There is no wrapper, or one of them trains several models or collects weights during training.
    """
    if not wrappers:
        raise ConfigError(
            "mode=calibrate fits wrappers to a trained model, but no wrapper is chosen. Add uncertainty=[...]; "
            "mode=plugins lists the names of wrappers."
        )
    resolved = [resolve("uncertainty", part, f"uncertainty.{key}") for key, part in wrappers.items()]
    for part in resolved:
        if issubclass(load("uncertainty", part["name"]), (SeveralModels, SelfTraining)):
            raise ConfigError(
                f"uncertainty={part['name']} trains several models, but a checkpoint holds one. Train the wrapper with "
                "mode=train, or join separately trained models with mode=combine mode.members=[...]."
            )
        if issubclass(load("uncertainty", part["name"]), FollowsTraining):
            raise ConfigError(
                f"uncertainty={part['name']} collects weights during training, but a checkpoint holds those of one "
                "epoch. Train the wrapper with mode=train."
            )
    return resolved


@torch.no_grad()
def wrap_trained(
    predictor: Predictor, wrappers: Sequence[Mapping[str, Any]], target: Target, inputs: Tensor
) -> Predictor:
    """Return a trained predictor inside uncertainty wrappers, in evaluation mode; fixed encoders stay outside them.

    Args:
        predictor: Trained predictor.
        wrappers: Configs of the wrappers, innermost first.
        target: Target that is predicted.
        inputs: Inputs of a few samples, for which the predictor inside each wrapper predicts once.

    Raises:
        ConfigError: A wrapper needs more than one model, has weights of its own to train, or would be put around a
            predictor with conformal prediction sets; or the wrapper itself raises the error.
    """
    front = predictor if isinstance(predictor, FrozenFrontEnd) else None
    inner = predictor if front is None else front.predictor
    features = inputs if front is None else front.features(inputs)
    for part in wrappers:
        if value_set(inner(features)) is not None:
            raise ConfigError(
                f"uncertainty={part['name']} would be put around a model that predicts sets with a guaranteed "
                "coverage, and this guarantee would not hold for the changed density. Put the wrapper that predicts "
                "sets last, around a model without sets."
            )
        inner = _wrap(part, inner, target).eval()
    return inner if front is None else FrozenFrontEnd(list(front.encoders), inner).eval()  # type: ignore[arg-type]


def _wrap(part: Mapping[str, Any], inner: Predictor, target: Target) -> Predictor:
    model_count = 0

    def model() -> Predictor:
        nonlocal model_count
        model_count += 1
        return inner

    wrapped: Predictor = build("uncertainty", part, model=model, target=target)
    trainable = {id(parameter) for parameter in wrapped.parameters() if parameter.requires_grad}
    trainable -= {id(parameter) for parameter in inner.parameters()}
    if model_count != 1 or trainable:
        reason = "has trainable weights" if trainable else f"wraps {model_count} models"
        raise ConfigError(
            f"uncertainty={part['name']} {reason}, but mode=calibrate only fits wrappers that are calibrated on the "
            "validation split of one trained model. Use this wrapper with mode=train."
        )
    return wrapped
