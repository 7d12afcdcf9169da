"""Keys of a config that each mode reads, which are exactly the keys that it declares."""

import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import pytorch_lightning as pl
import torch
import yaml
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from torch.distributions import Categorical, Distribution, Gumbel, Independent

from framework.configuration import composition
from framework.configuration.config import Config
from framework.configuration.modes import (
    BUNDLES,
    EVERYWHERE,
    MODES,
    UNUSED_BY_TRAINING,
    idle_sentences,
    is_below,
    key_of,
    require_read,
)
from framework.configuration.registry import GROUPS
from framework.configuration.settings import (
    TRAINER_OURS,
    LoggerSettings,
    OptimizerSettings,
    Settings,
    TrainerSettings,
)
from framework.errors import ConfigError
from framework.runs.session import Session, note_idle_samples
from framework.storage.progress import output
from framework.target import Target
from framework.testing.bodies import write_subjects
from framework.training.schedules import Plateau, make_schedule

GROUPED = {"optimizer": OptimizerSettings, "logger": LoggerSettings, "trainer": TrainerSettings}
OPTIONS = composition.folder() / "mode"
WITH_A_RUN = ("resume", "experiment_name")
"""Settings that are read only when a run is resumed or sent to a store."""


def settings_of_the_schema() -> list[str]:
    """Every key that a command can set: the framework's own, those of each group, and one of a plugin of each."""
    own = [key for key in Settings.model_fields if key not in ("stored", "mode", *GROUPED)]
    below = [f"{group}.{key}" for group, model in GROUPED.items() for key in model.model_fields]
    plugins = [key for group in (*GROUPS, "outliers") for key in (group, f"{group}.key", f"{group}.name.key")]
    return [*own, *GROUPED, *below, *plugins, *BUNDLES]


@pytest.mark.parametrize("mode", MODES)
def test_a_mode_reads_a_setting_or_refuses_it(mode: str) -> None:
    for key in settings_of_the_schema():
        root = key.partition(".")[0]
        called = key if root == "trainer" and "trainer.accelerator" in MODES[mode].reads else root
        for written in (f"{key}=1", f"+{key}=1", f"++{key}=[a,b]", f"~{key}"):
            assert key_of(written) == key
            if is_below(key, (*MODES[mode].reads, *EVERYWHERE)):
                require_read(mode, [written])
                continue
            with pytest.raises(ConfigError) as refused:
                require_read(mode, ["seed=1", written])
            said = str(refused.value)
            assert (
                written in said
                and f"mode={mode} reads no {called}" in said
                and "Leave this setting out" in said
            )
            assert mode not in re.split("[;,] ", said.partition(f"reads no {called}")[2]), (
                "it names other modes, which read it"
            )


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("group", [*GROUPS, "outliers"])
def test_a_stored_setting_is_said_again_where_its_group_is_read(mode: str, group: str) -> None:
    written = f"+stored.{group}.key=1"
    if group in MODES[mode].stored:
        require_read(mode, [written])
        return
    with pytest.raises(ConfigError, match=rf"^{group}\.key=1: mode={mode} reads no {group}"):
        require_read(mode, [written])


def test_the_key_of_a_group_elsewhere_is_where_it_goes() -> None:
    assert key_of("data@outliers=moons") == "outliers"
    with pytest.raises(ConfigError, match="mode=predict reads no outliers"):
        require_read("predict", ["data@outliers=moons"])


MOONS = ("data=moons", "data.train=60", "data.validation=40", "data.test=40")
MODEL = ("encoder=[mlp]", "encoder.mlp.widths=[4]", "density_head=bernoulli", "data@outliers=moons_outliers")
REST = (
    "outliers.test=20",
    "metric=[accuracy,nll,out_of_distribution]",
    "batch_size=20",
    "trainer.max_epochs=1",
)
QUIET = ("logger=none", "threads=1")
COMMANDS: dict[str, Sequence[str]] = {
    "train": (*MOONS, *MODEL, *REST),
    "test": ("checkpoint={train}",),
    "calibrate": ("checkpoint={train}", "uncertainty=[temperature]"),
    "combine": ("mode.members=[{train},{train}]",),
    "predict": ("checkpoint={train}",),
    "encode": ("data=point_cloud_folder", "encoder=[bps]", "mode.files={clouds}", "mode.into={features}"),
    "export": ("checkpoint={train}",),
    "work_precision": ("checkpoint={combine}", "mode.metrics=[nll]", "mode.repeats=2"),
    "render": (
        *("renderer=smplpix", "data=human_scans", "data.root={people}", "metric=[psnr]", "batch_size=4"),
        *("encoder=[projection,slim]", "encoder.projection.height=12", "encoder.projection.width=9"),
        *("encoder.slim.widths=[4,4]", "density_head=laplace_image", "trainer.max_epochs=1", "samples=1"),
    ),
    "check": ("data=moons",),
    "plugins": (),
    "new": ("mode.plugin=density_head/my_head", "mode.folder={new}"),
    "report": ("mode.run={train}", "mode.into={report}"),
    "sync": ("mode.run={train}",),
}
"""Working command for each mode; `{mode}` is the folder of an earlier run of that mode."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("modes")


@pytest.fixture
def composed(folder: Path) -> Iterator[Callable[[str], Config]]:
    """The config of a mode's command."""
    places = {name: str(folder / name) for name in (*MODES, "clouds", "features", "people")}

    def config(mode: str) -> Config:
        overrides = [f"mode={mode}", *QUIET, *(one.format(**places) for one in COMMANDS[mode])]
        values = composition.plain(compose("config", ["experiment_name=test", *overrides]))
        return Config.of({**values, "experiment_name": None}, folder / mode, overrides)

    composition.register()
    with initialize_config_dir(str(composition.folder()), version_base="1.3"):
        yield config
    GlobalHydra.instance().clear()


@pytest.mark.parametrize("mode", MODES)
def test_a_mode_reads_what_it_says_it_reads(
    mode: str, folder: Path, composed: Callable[[str], Config], monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "clouds").mkdir(exist_ok=True)
    np.savetxt(folder / "clouds" / "one.xyz", np.random.default_rng(0).normal(size=(50, 3)))
    if mode == "render":
        write_subjects(folder / "people")
    # another worker may have made the earlier runs that this command names
    named = " ".join(COMMANDS[mode])
    for earlier in ("train", "combine"):
        needed = f"{{{earlier}}}" in named or "{combine}" in named
        if needed and not (folder / earlier).is_dir():
            import_module(f"framework.modes.{earlier}").run(composed(earlier))
    config = composed(mode)
    require_read(mode, config.overrides)
    seen: set[str] = set()
    get = Settings.__getattribute__

    def noting(self: Settings, key: str) -> Any:
        if key in Settings.model_fields:
            seen.add(key)
        return get(self, key)

    monkeypatch.setattr(Settings, "__getattribute__", noting)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if mode == "sync":  # this run has no store
            with pytest.raises(Exception, match="logger=none"):
                import_module(f"framework.modes.{mode}").run(config)
        else:
            import_module(f"framework.modes.{mode}").run(config)
    said = MODES[mode]
    read = {key.partition(".")[0] for key in said.reads} - {*BUNDLES, *WITH_A_RUN}
    assert seen - {"mode", "stored", *EVERYWHERE, *WITH_A_RUN} == read
    assert ("stored" in seen) == bool(said.stored)
    opened = (folder / mode / "config.yaml").is_file()
    assert [key in said.reads for key in WITH_A_RUN] == [opened, opened]


@pytest.mark.parametrize("mode", MODES)
def test_an_option_that_a_mode_has_not_is_refused(mode: str, composed: Callable[[str], Config]) -> None:
    known = yaml.safe_load((OPTIONS / f"{mode}.yaml").read_text())
    config = composed(mode)
    others = {key for other in MODES for key in yaml.safe_load((OPTIONS / f"{other}.yaml").read_text())}
    for key in sorted({*others, "nonsense"} - set(known)):
        mode_options = {**config.settings.mode, key: 1}
        wrong = replace(config, settings=config.settings.model_copy(update={"mode": mode_options}))
        with pytest.raises(ConfigError, match=rf"mode\.{key}: unknown key"):
            import_module(f"framework.modes.{mode}").run(wrong)


def rates(**changes: Any) -> tuple[float, ...]:
    """Return the factor of the learning rate in each step of a training whose loss stops improving."""
    chosen = OptimizerSettings(**changes)
    factor = make_schedule(chosen, 120, 10)
    found = []
    for step in range(120):
        if step and step % 10 == 0 and isinstance(factor, Plateau):
            factor.record_loss(1.0, step // 10)
        found.append(factor(step))
    return tuple(found)


CHANGED: dict[str, Any] = {"factor": 0.5, "patience": 2, "warmup_steps": 7}


@pytest.mark.parametrize("kind", ["constant", "cosine", "step", "plateau"])
@pytest.mark.parametrize("key", CHANGED)
def test_a_setting_of_the_schedule_changes_the_rate_or_is_refused(kind: str, key: str) -> None:
    own: dict[str, Any] = {"schedule": kind, **({"milestones": [2]} if kind == "step" else {})}
    changes = rates(**own) != rates(**own, **{key: CHANGED[key]})
    said = list(
        idle_sentences({"optimizer": own, "data": {"name": "x"}}, [f"optimizer.{key}={CHANGED[key]}"])
    )
    assert bool(said) != changes, said
    assert all(f"optimizer.{key}={CHANGED[key]} has no effect" in one for one in said)


def test_each_key_of_the_trainer_is_ours_or_lightnings_or_refused() -> None:
    lightnings = pl.Trainer.__init__.__wrapped__.__code__.co_varnames  # type: ignore[attr-defined]
    for key in TrainerSettings.model_fields:
        assert (key in TRAINER_OURS) != (key in lightnings) or key == "callbacks", key
        said = list(idle_sentences({"trainer": {"gradient_clip_val": 1.0}}, [f"+trainer.{key}=1"]))
        assert bool(said) == (key in UNUSED_BY_TRAINING), said


@pytest.mark.parametrize(
    ("override", "values"),
    [
        *product(["+logger.uri=x", "+logger.experiment=x"], [{"logger": {"name": "none"}}]),
        ("trainer.gradient_clip_algorithm=value", {"trainer": {"gradient_clip_val": None}}),
        *product(
            ["debug=fast", "preset=thesis"], [{"mode": {"name": "test"}}, {"mode": {"name": "predict"}}]
        ),
    ],
)
def test_what_another_setting_leaves_without_effect_is_said(override: str, values: dict[str, Any]) -> None:
    (said,) = idle_sentences(values, ["seed=1", override])
    assert override in said and "Leave this setting out" in said
    used = {
        "logger": {"name": "mlflow"},
        "trainer": {"gradient_clip_val": 1.0},
        "data": {"name": "moons"},
        "mode": {"name": "test"},
    }
    assert not list(idle_sentences(used, [override]))


class Fixed(torch.nn.Module):
    """Predictor that returns the same density for every input."""

    def __init__(self, density: Distribution) -> None:
        super().__init__()
        self.density = density

    def forward(self, inputs: torch.Tensor) -> Distribution:
        return self.density


@pytest.mark.parametrize(
    ("density", "idle"),
    [
        (Categorical(logits=torch.zeros(6, 3)), True),
        (Independent(Gumbel(torch.zeros(6, 2), torch.ones(6, 2)), 1), False),
    ],
)
def test_samples_that_a_closed_form_does_not_need_are_noted(
    density: Distribution, idle: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    for overrides in (["samples=50"], ["seed=1"]):
        config = Config(Settings(), Path(), overrides)
        predictor, cpu = cast(Any, Fixed(density)), torch.device("cpu")
        target = Target("class", ("a", "b", "c"))
        session = Session(config, {}, "", target, cast(Any, None), predictor, cpu, output())
        note_idle_samples(session, {"input": torch.zeros(6, 1)})
        noted = "note: samples=50 has no effect: the point predictions" in capsys.readouterr().out
        assert noted == (idle and overrides == ["samples=50"])
