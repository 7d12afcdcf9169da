"""Config folders that are added on the command line, which can run no code, write no files and name no store."""

from pathlib import Path

import pytest
import yaml

from framework.configuration.command_line import command_line
from framework.configuration.foreign_configs import require_harmless
from framework.errors import ConfigError

HEADED = "# @package {}\n{}"
BAD = {
    "callbacks": ("experiment/x.yaml", "hydra: {callbacks: {a: {b: c}}}"),
    "environment": ("experiment/x.yaml", "hydra: {job: {env_set: {PYTHONSTARTUP: evil.py}}}"),
    "logging": ("experiment/x.yaml", "hydra: {job_logging: {handlers: {a: {'()': os.system}}}}"),
    "search path": ("config.yaml", "hydra: {searchpath: [pkg://evil]}"),
    "all of hydra": ("x.yaml", "hydra: text"),
    "where runs go": ("x.yaml", "hydra: {run: {dir: /somewhere}}"),
    "where sweeps go": ("x.yaml", "hydra: {sweep: {dir: /somewhere, subdir: a}}"),
    "target": ("experiment/x.yaml", "data: {a: [{_target_: os.system}]}"),
    "target of a launcher": ("x.yaml", "hydra: {launcher: {_target_: os.system}}"),
    "group of hydra": ("hydra/job_logging/x.yaml", "a: 1"),
    "package by name": ("a/hydra.yaml", "a: 1"),
    "package in a header": ("a/x.yaml", HEADED.format("hydra.callbacks", "a: 1")),
    "package of its name": ("a/b.yaml", HEADED.format("_name_", "a: 1")),
    "package in a choice": ("x.yaml", "defaults: [{/a@hydra.callbacks: b}]"),
    "choice of logging": ("x.yaml", "defaults: [{override /hydra/job_logging: x}]"),
    "launcher of other machines": ("x.yaml", "defaults: [{override /hydra/launcher: ray}]"),
    "launcher's address": ("x.yaml", "hydra: {launcher: {address: 10.0.0.1}}"),
    "sweeper's database": ("x.yaml", "hydra: {sweeper: {storage: 'postgresql://10.0.0.1/x'}}"),
    "choice elsewhere": ("x.yaml", "defaults: [{override /hydra/launcher: ../../x}]"),
    "choice as text": ("x.yaml", "defaults: [/a@hydra.job/b]"),
    "store": ("x.yaml", "logger: {uri: 'http://127.0.0.2'}"),
    "store in a package": ("x.yaml", HEADED.format("logger", "uri: http://127.0.0.2")),
    "store as a group": ("logger/x.yaml", "uri: http://127.0.0.2"),
    "store by a choice": ("x.yaml", "defaults: [{/a@logger: b}]"),
    "mode": ("x.yaml", "mode: {name: encode, files: /home, into: /tmp}"),
    "config of a sweep": ("experiment/x.yaml", "defaults: [/multirun@_global_]"),
    "config of a job": ("experiment/x.yaml", "defaults: [{/0@_global_: config}]"),
    "sweep over stores": ("x.yaml", "hydra: {sweeper: {params: {logger.uri: 'http://127.0.0.2'}}}"),
    "sweep over folders": ("x.yaml", "hydra: {sweeper: {params: {hydra.run.dir: '/a,/b'}}}"),
    "sweep over modes": ("x.yaml", "hydra: {sweeper: {params: {+mode: encode}}}"),
    "sweep over a package": ("x.yaml", "hydra: {sweeper: {params: {a@hydra.job.env_set: b}}}"),
    "sweep over flags": ("x.yaml", "hydra: {sweeper: {params: {--config-dir: b}}}"),
    "sweep of text": ("x.yaml", "hydra: {sweeper: {params: logger.uri=a}}"),
    "run to continue": ("x.yaml", "resume: /home/me/run"),
    "sweep over runs to continue": ("x.yaml", "hydra: {sweeper: {params: {resume: /home/me/run}}}"),
    "environment variable": ("x.yaml", "experiment_name: ${oc.env:AWS_SECRET_ACCESS_KEY}"),
    "environment variable in a list": ("x.yaml", "a: [{b: 'c ${oc.env:HOME}'}]"),
    "environment variable by a nested name": ("x.yaml", "b: oc\na: ${${b}.env:HOME}"),
    "environment variable in a choice": ("x.yaml", "defaults: [{/a: '${oc.env:HOME}'}]"),
    "path of this machine": ("x.yaml", "a: ${hydra:runtime.cwd}"),
    "alias": ("x.yaml", "a: &a [1]\nb: *a"),
    "package after a blank": ("experiment/x.yaml", " # @package logger\nuri: http://127.0.0.2"),
    "package after another header": ("experiment/x.yaml", "# @a b\x85# @package hydra.run\ndir: /somewhere"),
    "package before the last header": (
        "experiment/x.yaml",
        "# @package hydra.run\n" + "# @a b\n" * 100 + "# @package data\ndir: /somewhere",
    ),
    "tag that only Hydra reads": (
        "experiment/x.yaml",
        HEADED.format(
            "_global_",
            "hydra: {run: {dir: /somewhere}}\na: !!python/object/apply:pathlib.Path [x]",
        ),
    ),
    "pairs": ("x.yaml", "a: !!pairs [b: '${oc.env:HOME}']"),
    "config of a job, optionally": ("experiment/x.yaml", "defaults: [{optional /0@_global_: config}]"),
    "config of a job, in other words": ("experiment/x.yaml", "defaults: [{a override /0@_global_: config}]"),
    "choice of no group": ("x.yaml", "defaults: [{'@_global_': 0/config}]"),
}
GROUPS = ("experiment", "data", "logger", "a")
FORMS = (
    ["--config-dir={}"],
    ["--config-dir", "{}"],
    ["-cd", "{}"],
    ["--config-d={}"],
    ["--config-path={}"],
    ["-cp", "{}"],
)


@pytest.mark.parametrize("form", FORMS, ids=str)
@pytest.mark.parametrize("kind", BAD)
def test_a_foreign_config_says_neither_what_runs_nor_where_results_go(
    kind: str, form: list[str], tmp_path: Path
) -> None:
    name, text = BAD[kind]
    file = tmp_path / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    for left in ("multirun.yaml", "0/config.yaml"):  # as a sweep leaves them
        (tmp_path / left).parent.mkdir(exist_ok=True)
        (tmp_path / left).write_text("a: 1")
    with pytest.raises(ConfigError, match=file.name):
        require_harmless(
            [*(word.format(tmp_path) for word in form), "experiment=x", "--config-name=x"], GROUPS
        )


def test_what_it_may_say_passes(tmp_path: Path) -> None:
    (tmp_path / "experiment").mkdir()
    content = {
        "defaults": [
            {"/experiment@_global_": "a"},
            {"override /hydra/launcher": "basic"},
            {"override /logger": "none"},
            "_self_",
        ],
        "hydra": {"sweeper": {"params": {"seed": "1,2", "+data.mode": "a,b"}}, "launcher": {"jobs": 2}},
        "logger": {"experiment": "mine"},
        "resume": "never",
        "data": {"root": "/data", "size": "${seed}", "name": "${.size} of ${a.${b}[0]}"},
    }
    (tmp_path / "experiment" / "x.yaml").write_text("# @package _global_\n" + yaml.safe_dump(content))
    require_harmless([f"--config-dir={tmp_path}"], GROUPS)
    (tmp_path / "0").mkdir()
    for left in ("multirun.yaml", "0/config.yaml"):  # as a sweep leaves them; nothing can choose them
        (tmp_path / left).write_text("hydra: {callbacks: {}}")
    require_harmless([f"--config-dir={tmp_path}"], GROUPS)
    require_harmless(["--config-dir=nowhere", "seed=1", "-m"], GROUPS)
    (tmp_path / "experiment" / "y.yaml").symlink_to("x.yaml")
    with pytest.raises(ConfigError, match="is a link"):
        require_harmless([f"--config-dir={tmp_path}"], GROUPS)


@pytest.mark.parametrize(
    "argument",
    [
        "--experimental-rerun=a.pickle",
        "--experimental-rerun",
        "--exp=a",
        "logger.uri=http://me:secret@host",
        "hydra.searchpath=[file:///somewhere]",
        "++hydra.searchpath=[pkg://somewhere]",
    ],
)
def test_flags_that_run_or_store_what_they_should_not_are_refused(argument: str) -> None:
    with pytest.raises(ConfigError) as caught:
        command_line([argument, "a.pickle"])
    assert "secret" not in str(caught.value)
