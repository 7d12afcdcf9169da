"""Paths in a stored config, which are used only if the user names them again."""

import json
import os
import pickle
import shlex
import subprocess
import sys
import typing
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.configuration import paths, registry
from framework.configuration.loading import load_with_description, reader
from framework.configuration.paths import FilePath, Words, holds_path, shell_arguments
from framework.configuration.signature import parts, signature
from framework.configuration.stored_keys import as_stored
from framework.errors import ConfigError
from tests.conftest import Done, Framework

CANARY = """
import sys

opened = []
def notice(event, arguments):
    if event in ("open", "os.listdir", "os.scandir", "os.mkdir") and "canary" in str(arguments[0]):
        opened.append(str(arguments[0]))
sys.addaudithook(notice)

import copy
from pathlib import Path

import yaml

import framework
from framework import modes
from framework.configuration.config import Config
from framework.configuration.registry import load
from framework.deployment.served import _load_pyfunc
from framework.errors import UserError
from framework.runs.session import add_test_parts, for_trained
from framework.storage.checkpoints import read, write

base, source = map(Path, sys.argv[1:3])
content = read(source)
checkpoint = base / "stored.ckpt"
(base / "run").mkdir()
settings = {"mode": {"name": "test"}, "logger": {"name": "none"}, "checkpoint": str(checkpoint), "threads": 1}


def resumed():
    with (base / "run" / "config.yaml").open("w") as file:
        yaml.safe_dump({**settings, **groups, "mode": {"name": "train"}, "checkpoint": None}, file)
    (base / "run" / "overrides.yaml").write_text("[]")
    modes.run({"resume": str(base / "run"), "logger": None}, base / "run", [f"resume={base / 'run'}"])


uses = {
    "load": lambda: framework.load(checkpoint),
    "freeze": lambda: framework.freeze(checkpoint),
    "serve": lambda: _load_pyfunc(str(checkpoint)),
    "test": lambda: add_test_parts(for_trained(Config.of(settings, base / "test", []))),
    "resume": resumed,
}
for line in sys.stdin.read().splitlines():
    group, name, key, canary = line.split()
    load(group, name)  # so that what an import opens is not counted
    part = {"name": name, key: canary}
    config = copy.deepcopy(content["framework"]["config"])
    config[group] = [part] if group in ("encoder", "uncertainty", "objective", "metric") else part
    groups = {group: {"own": part} if isinstance(config[group], list) else part}
    write({**content, "framework": {**content["framework"], "config": config}}, checkpoint)
    for use, run in uses.items():
        opened.clear()
        try:
            run()
            ended = "done"
        except UserError as error:
            ended = "said" if str(error).count(canary) else "refused"
        print("USE", use, group, name, key, ended, *opened)
"""


def texts() -> list[tuple[str, str, str]]:
    """Return the registry, plugin and name of every parameter that can hold a text."""

    def takes_text(annotation: Any) -> bool:
        if isinstance(annotation, type):
            return annotation is str or issubclass(annotation, os.PathLike)
        return typing.get_origin(annotation) is not Literal and any(
            map(takes_text, typing.get_args(annotation))
        )

    found = []
    for group in registry.GROUPS:
        for name in registry.installed(group):
            cls = registry.load(group, name)
            found += [
                (group, name, key)
                for key, (annotation, _) in signature(cls).items()
                if key not in parts(cls) and (annotation is Any or takes_text(annotation))
            ]
    return found


@pytest.mark.slow
def test_no_use_of_a_stored_config_opens_what_it_names(
    whole: Done, tmp_path: Path, stranger_site: Path
) -> None:
    """Test every text parameter of every plugin with every command that reads stored configs."""
    canary = tmp_path / "canary"
    canary.mkdir()
    asked = [f"{group} {name} {key} {canary}" for group, name, key in texts()]
    done = subprocess.run(
        [sys.executable, "-c", CANARY, tmp_path, whole.folder / "checkpoints" / "model.ckpt"],
        input="\n".join(asked),
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(stranger_site), "FRAMEWORK_CACHE": str(tmp_path / "cache")},
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    lines = [line.split()[1:] for line in done.stdout.splitlines() if line.startswith("USE ")]
    assert len(lines) == 5 * len(asked) > 150
    opened = [line for line in lines if len(line) > 5]
    assert not opened
    # of what decides a model's numbers, and of any run that goes on, the refusal says the path
    silent = [
        line
        for line in lines
        if (line[0] == "resume" or (line[1] in ("encoder", "density_head") and line[0] != "resume"))
        and line[4] != "said"
        and not is_words(*line[1:4])
        and (line[0] == "resume" or line[3] not in getattr(registry.load(*line[1:3]), "initial", ()))
    ]
    assert not silent


def is_words(group: str, name: str, key: str) -> bool:
    return not holds_path(signature(registry.load(group, name))[key][0], "a/b")


def test_what_is_said_to_be_words_is_no_path() -> None:
    """The parameters of the project's plugins that never hold a path are listed, so that a new one is considered."""
    assert {f"{name}.{key}" for group, name, key in texts() if is_words(group, name, key)} == {
        "tabular.target",
        "tabular.columns",
        "tabular.units",
        "tabular.missing_words",
        "image_folder.classes",
        "turned_images.classes",
        "images_with_angles.units",
        "table_tennis.units",
        "images_with_angles.angle_columns",
        "images_with_angles.mirror",
        "point_cloud_folder.columns",
        "labelled_points.label",
        "labelled_points.classes",
        "decision_cost.actions",
        "decision_cost.number",
    }
    marked = {
        key for group, name, key in texts() if holds_path(signature(registry.load(group, name))[key][0], "a")
    }
    assert marked >= {"root", "body", "path", "weights", "checkpoint", "skins"}


@dataclass
class Inner:
    """Part of a parameter."""

    file: FilePath
    title: Words = ""


class Model(pydantic.BaseModel):
    """Part of a parameter."""

    file: Path
    free: str = ""


VALUES = [
    (str, "plain", False),
    (str, "some/where", True),
    (str, "some\\where", True),
    (str, "~somebody", True),
    (str, "", False),
    (Any, "some/where", True),
    (Any, {"a": [1, {"b": ("/",)}]}, True),
    (dict[str, int], {"/etc": 1}, True),
    (Path, "file", True),
    (Path | None, None, False),
    (pydantic.FilePath, "file", True),
    (pydantic.DirectoryPath | None, "file", True),
    (FilePath, "file", True),
    (list[FilePath], ["file"], True),
    (Annotated[FilePath | None, pydantic.Field(max_length=9)], "file", True),
    (Words, "km/h", False),
    (Words | list[Words] | None, ["km/h"], False),
    (Literal["a/b", "c"], "a/b", False),
    (Literal["a/b"] | str, "c/d", True),
    (Inner, {"file": "file"}, True),
    (Inner, {"title": "a/b"}, False),
    (list[Inner] | None, [{"title": "a"}, {"file": "b"}], True),
    (Model, {"file": "file"}, True),
    (Model, {"free": "a"}, False),
    (Model, {"unknown": "a/b"}, True),
    (int, 3, False),
]


@pytest.mark.parametrize(("annotation", "value", "path"), VALUES)
def test_a_path_is_one_by_annotation_or_by_its_looks(annotation: Any, value: Any, path: bool) -> None:
    assert holds_path(annotation, value) is path


@settings(max_examples=100, deadline=None)
@given(st.text(st.characters(), min_size=1, max_size=20).filter(str.isprintable))
def test_the_words_to_add_say_the_path(path: str) -> None:
    (word,) = shlex.split(shell_arguments({"data.root": path})[0])
    (argument,) = as_stored(["resume=a/b", word])[1:]
    parsed = OverridesParser.create().parse_override(argument)
    assert parsed.key_or_group == "stored.data.root"
    assert str(parsed.value()) == path


@pytest.mark.parametrize(
    "path", ["houses.csv", "my_images", "my-data.v2", "nan.csv", "a/b", "./x.csv", "/d/1.csv"]
)
def test_plain_paths_are_written_without_quotes(path: str) -> None:
    assert shell_arguments({"data.root": path}) == [f"data.root={path}"]
    value = OverridesParser.create().parse_override(f"data.root={path}").value()
    assert isinstance(value, str) and value == path


@pytest.mark.parametrize(
    "path", ["null", "True", "NaN", "inf", "1e5", "-3", "007", "a,b", "a b", "[x]", "a:b", "$x"]
)
def test_paths_that_hydra_would_read_as_something_else_have_quotes(path: str) -> None:
    (word,) = shlex.split(shell_arguments({"data.root": path})[0])
    assert word == f"data.root='{path}'"
    assert str(OverridesParser.create().parse_override(word).value()) == path


@pytest.mark.parametrize(
    ("arguments", "rewritten"),
    [
        ("mode=test checkpoint=a data.root=b", "mode=test checkpoint=a +stored.data.root=b"),
        ("mode=test checkpoint=a data=x data.root=b", None),
        (
            "mode=test checkpoint=a data=x outliers.root=b",
            "mode=test checkpoint=a data=x +stored.outliers.root=b",
        ),
        (
            "mode=test checkpoint=a data@outliers=x outliers.root=b data.root=c",
            "mode=test checkpoint=a data@outliers=x outliers.root=b +stored.data.root=c",
        ),
        (
            "mode=combine mode.members=m encoder.x.body=b",
            "mode=combine mode.members=m +stored.encoder.x.body=b",
        ),
        (
            "mode=test,predict checkpoint=a metric.lpips.weights=b -m",
            "mode=test,predict checkpoint=a +stored.metric.lpips.weights=b -m",
        ),
        ("mode=train checkpoint=a data.root=b", None),
        ("experiment=e mode=test checkpoint=a data.root=b", None),
        ("mode=test data.root=b", None),
        ("resume=auto data.root=b", None),
        (
            "resume=f mode.files=b checkpoint=c threads=1",
            "resume=f +stored.mode.files=b checkpoint=c threads=1",
        ),
    ],
)
def test_keys_of_what_is_not_chosen_are_those_of_the_stored_config(
    arguments: str, rewritten: str | None
) -> None:
    assert as_stored(arguments.split()) == (rewritten or arguments).split()


def test_a_path_said_again_is_used(framework: Framework, tmp_path: Path) -> None:
    table = tmp_path / "my table.csv"
    table.write_text("a,b,km/h\n" + "".join(f"{i % 7},{i % 5},{i % 7 + i % 3}\n" for i in range(90)))
    tabular = ["data=tabular", f"data.path='{table}'", "data.target=km/h", "data.kind=real", "encoder=[mlp]"]
    rest = ["density_head=gaussian", "metric=[nll]", "trainer.max_epochs=1", "threads=1", "logger=none"]
    run = framework(*tabular, *rest)
    assert run.code == 0, run.out
    test = ["mode=test", f"checkpoint={run.folder}", "logger=none"]
    refused = framework(*test, folder="test")
    assert refused.code == 2 and f"data.path = '{table}'" in refused.out
    again = shlex.split(refused.out.split("`python -m framework`, add ")[1].split(". In the")[0])
    assert again == [f"data.path='{table}'"]
    tested = framework(*test, *again, folder="test")
    assert tested.code == 0, tested.out
    numbers = [json.loads((one.folder / "results.json").read_text())["nll"] for one in (run, tested)]
    assert numbers[0] == numbers[1]
    for said in ({}, {"data.path": table}):
        _, description = load_with_description(run.folder, paths=said)
        data = pickle.loads(pickle.dumps(reader(description)))
        with nullcontext() if said else pytest.raises(ConfigError, match=r"data\.path="):
            data.prepare()
    wrong = framework(*test, "data.pat=x", folder="test")
    assert wrong.code == 2 and "data.pat" in wrong.out
    changed = framework(*test, *again, "encoder.mlp.widths=[3]", folder="test")
    assert changed.code == 2 and "may override only the paths of a trained model" in changed.out

    # a run that goes on: the same path, no other
    (run.folder / "run.json").unlink()
    resume = f"resume={run.folder}"
    unsaid = framework(resume, say_again=False)
    assert unsaid.code == 2 and unsaid.out.split("Add to the command: ")[1].splitlines()[0] == shlex.join(
        again
    )
    other = framework(resume, "data.path=/other", say_again=False)
    assert other.code == 2 and "would change it" in other.out
    gone_on = framework(resume, *again)
    assert gone_on.code == 0, gone_on.out


def test_what_a_checkpoint_starts_from_and_modes_read_are_paths_too() -> None:
    values = {
        "mode": {"name": "predict", "files": "x"},
        "checkpoint": "run",
        "stored": {"data": {"root": "/a"}},
    }
    found = paths.paths_of(values)
    assert found == {"mode.files": "x", "checkpoint": "run", "data.root": "/a"}
    with pytest.raises(ConfigError, match=r"mode\.files=.*x.* data\.root=/a"):
        paths.require_repeated(found, {"checkpoint": "run"}, "folder")
    paths.require_repeated(found, found, "folder")
