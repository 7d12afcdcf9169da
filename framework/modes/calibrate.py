"""mode=calibrate: fit uncertainty wrappers around a trained model to the validation split, and test the result."""

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
from framework.uncertainty import SeveralModels

FEW = 2
"""Number of samples on which wrappers are tried before anything is fitted."""


class CalibrateOptions(Options):
    """Options of mode=calibrate, which has none: `uncertainty` chooses the wrappers to fit."""


def run(config: Config) -> None:
    """Calibrate the wrappers, write checkpoints/model.ckpt for the other modes, and print the table row of its test.

    Raises:
        ConfigError: No wrapper is chosen, or a chosen wrapper must be trained or has been fitted already.
    """
    config.options(CalibrateOptions)
    wrappers = chosen(config.values.get("uncertainty") or {})
    session = for_trained(config)
    there = [part["name"] for part in session.parts["uncertainty"]]
    for part in wrappers:
        if part["name"] in there:
            raise ConfigError(
                f"uncertainty={part['name']}: {config.settings.checkpoint} is wrapped in {' + '.join(there)} already, "
                "and another one around it would fit what was fitted. Give the checkpoint of the model without it, or "
                "another wrapper."
            )
    parts = {**session.parts, "uncertainty": [*session.parts["uncertainty"], *wrappers]}
    method = " + ".join([session.method, *(part["name"] for part in wrappers)])
    splits = session.data.splits()
    inputs = fetch(splits.validation, range(min(FEW, len(splits.validation))))["input"]  # type: ignore[arg-type]
    predictor = around_trained(session.predictor, wrappers, session.target, inputs)
    session = add_test_parts(replace(session, parts=parts, method=method, predictor=predictor))
    with open_run(session.config) as run:
        session.record(run)
        calibrate(session)
        session.save_model(run)
        report_test(run, session)


def chosen(wrappers: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the checked wrappers of a config, innermost first.

    Raises:
        ConfigError: There is no wrapper, or one of them trains several models.
    """
    if not wrappers:
        raise ConfigError(
            "mode=calibrate fits wrappers to a trained model, and none is chosen. Give uncertainty=[...], of which "
            "mode=plugins lists the names."
        )
    found = [resolve("uncertainty", part, f"uncertainty.{key}") for key, part in wrappers.items()]
    for part in found:
        if issubclass(load("uncertainty", part["name"]), SeveralModels):
            raise ConfigError(
                f"uncertainty={part['name']} trains several models, and a checkpoint holds one. Train it with "
                "mode=train, or join models that were trained apart with mode=combine mode.members=[...]."
            )
    return found


@torch.no_grad()
def around_trained(
    predictor: Predictor, wrappers: Sequence[Mapping[str, Any]], target: Target, inputs: Tensor
) -> Predictor:
    """Return a trained predictor in wrappers, behind its fixed encoders, in evaluation mode.

    Args:
        predictor: Trained predictor.
        wrappers: Configs of the wrappers, innermost first.
        target: Target that is predicted.
        inputs: Inputs of a few samples.

    Raises:
        ConfigError: A wrapper needs more than one model, has weights of its own to train, or would drop the conformal
            prediction sets of the predictor inside it; or the wrapper itself raises the error.
    """
    front = predictor if isinstance(predictor, FrozenFrontEnd) else None
    inner = predictor if front is None else front.predictor
    features = inputs if front is None else front.features(inputs)
    for part in wrappers:
        if value_set(inner(features)) is not None:
            raise ConfigError(
                f"uncertainty={part['name']} is put around a model that predicts sets which hold a promised share of "
                "the targets, and would drop them: what was promised of a density is not so of what is made of it. Put "
                "what makes the sets last, around a model without them."
            )
        inner = _wrapped(part, inner, target).eval()
    return inner if front is None else FrozenFrontEnd(list(front.encoders), inner).eval()  # type: ignore[arg-type]


def _wrapped(part: Mapping[str, Any], inner: Predictor, target: Target) -> Predictor:
    asked = 0

    def model() -> Predictor:
        nonlocal asked
        asked += 1
        return inner

    found: Predictor = build("uncertainty", part, model=model, target=target)
    own = {id(one) for one in found.parameters() if one.requires_grad} - {
        id(one) for one in inner.parameters()
    }
    if asked != 1 or own:
        does = "has weights of its own that are trained by gradient" if own else f"wraps {asked} models"
        raise ConfigError(
            f"uncertainty={part['name']} {does}, and mode=calibrate only fits what is calibrated on the validation "
            "split of one trained model. Choose it in mode=train."
        )
    return found
