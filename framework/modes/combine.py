"""mode=combine: join separately trained models as the members of one wrapper, calibrate it and test it."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch

from framework.configuration.assembly import build_predictor
from framework.configuration.config import Config, Options
from framework.configuration.description import Description
from framework.configuration.loading import load_with_description
from framework.configuration.paths import flatten
from framework.configuration.registry import load
from framework.configuration.schema import resolve
from framework.data import Data
from framework.errors import CheckpointError, ConfigError, count_of
from framework.model import FrozenFrontEnd, Predictor
from framework.reports.report import report_test
from framework.runs.job import find_members
from framework.runs.run import open_run
from framework.runs.session import add_test_parts, calibrate, for_predictor, set_up_process
from framework.uncertainty import Joining, SelfTraining, SeveralModels


class CombineOptions(Options):
    """Options of mode=combine.

    Attributes:
        members: Folder of a sweep whose runs become the members, or a list with the run folder, checkpoint file or
            MLflow run id of each member.
        wrapper: Name of the uncertainty wrapper that joins the members, such as "ensemble".
    """

    members: str | list[str]
    wrapper: str


def run(config: Config) -> None:
    """Join the members, write checkpoints/model.ckpt for the other modes, test the model and print its table row."""
    options = config.options(CombineOptions)
    console = set_up_process(config.settings)
    around = outer_wrappers(config.settings.uncertainty or {})
    sources = find_members(options.members)
    repeated_paths = flatten(config.settings.stored)
    members = [
        load_with_description(source, uri=config.settings.logger.uri, paths=repeated_paths)
        for source in sources
    ]
    shared = common_description([description for _, description in members])
    wrappers = [wrapper_config(options.wrapper, len(members)), *around]
    parts = {**shared.config, "uncertainty": [*shared.config["uncertainty"], *wrappers]}
    method = " + ".join([shared.method, *(part["name"] for part in wrappers)]) if shared.method else ""
    session = add_test_parts(
        for_predictor(config, members[0][0], replace(shared, config=parts, method=method), console)
    )
    session.predictor = build_joined(parts, session.data, [member for member, _ in members])
    with open_run(session.config) as run:
        session.record(run)
        calibrate(session)
        session.save_model(run)
        console.print(f"{count_of(len(members), 'member')}: {', '.join(map(str, sources))}", soft_wrap=True)
        report_test(run, session)


def common_description(members: Sequence[Description]) -> Description:
    """Return the description of the first member, after checking that the others agree with it.

    Raises:
        CheckpointError: Two members differ in data, parts, target or inputs; the message names the difference.
    """
    first = members[0]
    for other in members[1:]:
        other_data, first_data = other.config["data"], first.config["data"]
        if differing := sorted(
            key for key in {*other_data, *first_data} if other_data.get(key) != first_data.get(key)
        ):
            values = {key: "null" if first_data.get(key) is None else first_data[key] for key in differing}
            fixed = " ".join(f"data.{key}={value}" for key, value in values.items())
            raise CheckpointError(
                f"{other.path} and {first.path} differ in {', '.join(f'data.{key}' for key in differing)}, so one "
                "model may have been trained on test data of the other. Train all members on the same data: add "
                f"{fixed} to the command of each."
            )
        for key in ("density_head", "encoder", "uncertainty"):
            if other.config[key] != first.config[key]:
                raise CheckpointError(
                    f"{other.path} and {first.path} differ in {key}: {other.config[key]} and "
                    f"{first.config[key]}. Members may differ in their seed only. "
                    "List members that are alike in mode.members, one by one."
                )
        for key in ("target", "input_shape", "data_state"):
            other_value, first_value = getattr(other, key), getattr(first, key)
            if not _are_equal(other_value, first_value):
                raise CheckpointError(
                    f"{other.path} and {first.path} differ in {key}: {str(other_value)[:200]} and "
                    f"{str(first_value)[:200]}. Train the members on the same data."
                )
    return first


def _are_equal(first: Any, second: Any) -> bool:
    """Return whether two values are equal; the values of a mapping may be tensors, as in the state of a data set."""
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        return first.keys() == second.keys() and all(_are_equal(first[key], second[key]) for key in first)
    if isinstance(first, torch.Tensor) and isinstance(second, torch.Tensor):
        return torch.equal(first, second)
    return (
        not isinstance(first, torch.Tensor) and not isinstance(second, torch.Tensor) and bool(first == second)
    )


def wrapper_config(wrapper: str, count: int) -> dict[str, Any]:
    """Return the resolved config of the uncertainty wrapper `wrapper` around `count` members.

    Raises:
        ConfigError: The wrapper cannot join separately trained members.
    """
    kind = load("uncertainty", wrapper)
    if not issubclass(kind, Joining):
        raise ConfigError(
            f"mode.wrapper={wrapper} cannot join separately trained models. Choose a wrapper that derives from "
            "framework.uncertainty.Joining."
        )
    return resolve("uncertainty", {"name": wrapper, **kind.parameters_of(count)}, "mode.wrapper")


def outer_wrappers(wrappers: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the resolved configs of `wrappers`, which are put around the joined model, innermost first.

    Raises:
        ConfigError: One of them needs several models, but there is only one joined model.
    """
    resolved = [resolve("uncertainty", part, f"uncertainty.{key}") for key, part in wrappers.items()]
    for part in resolved:
        if issubclass(load("uncertainty", part["name"]), (SeveralModels, SelfTraining, Joining)):
            raise ConfigError(
                f"uncertainty={part['name']} needs several models, but in mode=combine the wrappers of uncertainty are "
                f"put around the one model that mode.wrapper joins. Leave uncertainty={part['name']} out; "
                "mode.wrapper chooses the wrapper that joins the members."
            )
    return resolved


def build_joined(config: dict[str, Any], data: Data, members: Sequence[Predictor]) -> Predictor:
    """Return the predictor that `config` describes, with `members` as the members of its wrapper.

    Args:
        config: Resolved configs of all plugins, with the wrapper that joins the members (`wrapper_config`).
        data: Data set whose target and inputs the predictor has.
        members: Trained predictors, whose weights are copied.

    Raises:
        CheckpointError: The fixed encoders of two members differ.
    """
    predictor = build_predictor(config, data.target, data.input_shape, 0, data.columns)
    if isinstance(predictor, FrozenFrontEnd):
        members = [_inner_predictor(predictor, member, index) for index, member in enumerate(members)]
    next(module for module in predictor.modules() if isinstance(module, Joining)).join(members)
    return predictor


def _inner_predictor(joined: FrozenFrontEnd, member: Predictor, index: int) -> Predictor:
    """Return the part of a member behind its fixed encoders, after checking that these equal those of the first member.

    The encoders of the first member (`index` 0) are copied into `joined`.
    """
    assert isinstance(member, FrozenFrontEnd)
    state = member.encoders.state_dict()
    if index == 0:
        joined.encoders.load_state_dict(state)
    for name, tensor in joined.encoders.state_dict().items():
        if not torch.equal(tensor, state[name]):
            raise CheckpointError(
                f"Member {index} was trained on other features than member 0: the encoders of both differ in {name}. "
                "Join runs with the same encoders."
            )
    return member.predictor
