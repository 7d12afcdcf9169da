"""mode=combine: join separately trained models as the members of one wrapper, calibrate it and test it."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
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
from framework.errors import CheckpointError, ConfigError
from framework.model import FrozenFrontEnd, Predictor
from framework.reports.report import report_test
from framework.runs.job import find_job_folders, natural_order_key
from framework.runs.run import open_run
from framework.runs.session import add_test_parts, calibrate, for_predictor, set_up_process
from framework.storage.enclosed import require_enclosed
from framework.uncertainty import Joining

_MODEL = "checkpoints/model.ckpt"


class CombineOptions(Options):
    """Options of mode=combine: the models that become members, and the wrapper that joins them."""

    members: str | list[str]
    wrapper: str


def run(config: Config) -> None:
    """Join the members, write checkpoints/model.ckpt for the other modes, and print the table row of its test."""
    options = config.options(CombineOptions)
    console = set_up_process(config.settings)
    sources = found(options.members)
    again = flatten(config.settings.stored)
    members = [
        load_with_description(source, uri=config.settings.logger.uri, paths=again) for source in sources
    ]
    described = common([description for _, description in members])
    wrappers = [
        wrapping(options.wrapper, len(members)),
        *(
            resolve("uncertainty", part, f"uncertainty.{key}")
            for key, part in (config.values.get("uncertainty") or {}).items()
        ),
    ]
    parts = {**described.config, "uncertainty": [*described.config["uncertainty"], *wrappers]}
    method = " + ".join([described.method, *(part["name"] for part in wrappers)]) if described.method else ""
    session = add_test_parts(
        for_predictor(config, members[0][0], replace(described, config=parts, method=method), console)
    )
    session.predictor = joined(parts, session.data, [member for member, _ in members])
    with open_run(session.config) as run:
        session.record(run)
        calibrate(session)
        session.save_model(run)
        console.print(f"{len(members)} members: {', '.join(map(str, sources))}", soft_wrap=True)
        report_test(run, session)


def found(members: str | Sequence[str]) -> list[str | Path]:
    """Return the run folders, checkpoint files or MLflow run ids of the members.

    If `members` is a folder of runs, these are the runs directly in it that hold a trained model, sorted by name. If
    there are none, they are the jobs at any depth that hold one.

    Raises:
        ConfigError: There are fewer than two members.
    """
    if not isinstance(members, str):
        listed: list[str | Path] = list(members)
    else:
        folder = Path(members).expanduser()
        require_enclosed(folder, ConfigError)
        runs = sorted((path.parent.parent for path in folder.glob(f"*/{_MODEL}")), key=natural_order_key)
        listed = [*(runs or (job for job in find_job_folders(folder) if (job / _MODEL).is_file()))]
    if len(listed) < 2:
        raise ConfigError(
            f"mode.members = {members!r} gives {len(listed)} trained models; wanted at least two: the folder of "
            "a sweep (outputs/sweeps/<time>), or a list of run folders, checkpoint files or MLflow run ids."
        )
    return listed


def common(members: Sequence[Description]) -> Description:
    """Return the description that all members share.

    Raises:
        CheckpointError: Two members differ in data, parts, target or inputs; the message says in which.
    """
    first = members[0]
    for other in members[1:]:
        here, there = other.config["data"], first.config["data"]
        if differing := sorted(key for key in {*here, *there} if here.get(key) != there.get(key)):
            wanted = {key: "null" if there.get(key) is None else there[key] for key in differing}
            fixed = " ".join(f"data.{key}={value}" for key, value in wanted.items())
            raise CheckpointError(
                f"{other.path} and {first.path} differ in {', '.join(f'data.{key}' for key in differing)}: what is "
                f"test data of one may have trained the other. Train the members on the same data, with {fixed} in all."
            )
        for key in ("density_head", "encoder", "uncertainty"):
            if other.config[key] != first.config[key]:
                raise CheckpointError(
                    f"{other.path} and {first.path} differ in {key}: {other.config[key]} and "
                    f"{first.config[key]}. Members must be alike but for their seed; "
                    "name those that are one by one in mode.members."
                )
        for key in ("target", "input_shape", "data_state"):
            one, two = getattr(other, key), getattr(first, key)
            if one != two:
                raise CheckpointError(
                    f"{other.path} and {first.path} differ in {key}: {str(one)[:200]} and {str(two)[:200]}. "
                    "Members must have been trained on the same data."
                )
    return first


def wrapping(wrapper: str, count: int) -> dict[str, Any]:
    """Return the config of a wrapper around `count` members.

    Raises:
        ConfigError: The wrapper cannot join separately trained members.
    """
    kind = load("uncertainty", wrapper)
    if not issubclass(kind, Joining):
        raise ConfigError(
            f"mode.wrapper={wrapper} has no members that could have been trained apart. Give a wrapper that has, one "
            "that derives from framework.uncertainty.Joining."
        )
    return resolve("uncertainty", {"name": wrapper, **kind.parameters_of(count)}, "mode.wrapper")


def joined(config: dict[str, Any], data: Data, members: Sequence[Predictor]) -> Predictor:
    """Return the predictor of `config`, which contains the wrapper of `wrapping`, with the members joined in it."""
    predictor = build_predictor(config, data.target, data.input_shape, 0, data.columns)
    if isinstance(predictor, FrozenFrontEnd):
        members = [_inner(predictor, member, index) for index, member in enumerate(members)]
    next(module for module in predictor.modules() if isinstance(module, Joining)).join(members)
    return predictor


def _inner(whole: FrozenFrontEnd, member: Predictor, index: int) -> Predictor:
    """Return the part of a member behind its fixed encoders.

    The encoders must be equal in all members. Those of the first member (`index` 0) are copied into `whole`.
    """
    assert isinstance(member, FrozenFrontEnd)
    state = member.encoders.state_dict()
    if index == 0:
        whole.encoders.load_state_dict(state)
    for name, tensor in whole.encoders.state_dict().items():
        if not torch.equal(tensor, state[name]):
            raise CheckpointError(
                f"member {index} was trained on other features than member 0: their encoders differ in {name}. "
                "Join runs whose encoders were built alike."
            )
    return member.predictor
