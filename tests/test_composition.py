"""Composed configs: every experiment composes, and Hydra's errors become sentences."""

import inspect
import json
import os
import re
import shlex
import statistics
import subprocess
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given as drawn
from hypothesis import strategies as st
from omegaconf import DictConfig, OmegaConf

from framework.configuration.command_line import command_line
from framework.configuration.composition import (
    describe_error,
    folder,
    in_quotes,
    plain,
    register,
)
from framework.configuration.config import Config
from framework.configuration.registry import installed, load
from framework.configuration.settings import (
    PRECISIONS,
    STRATEGIES,
    TRAINER_OURS,
    Settings,
    TrainerSettings,
)
from framework.errors import ConfigError
from framework.storage import cache
from tests.conftest import Framework, first_of_each

EXPERIMENTS = sorted(
    str(path.relative_to(folder() / "experiment").with_suffix(""))
    for path in (folder() / "experiment").rglob("*.yaml")
    if path.stem != "base"
)


def composed(*overrides: str) -> DictConfig:
    register()
    with initialize_config_dir(str(folder()), version_base="1.3"):
        # without hydra.main there are no runtime choices to interpolate
        return compose("config", overrides=["experiment_name=test", *overrides])


@pytest.mark.parametrize("name", first_of_each(EXPERIMENTS, lambda name: name.partition("/")[0]))
def test_every_experiment_composes_and_its_plugins_accept_it(name: str) -> None:
    from framework.configuration.assembly import assemble

    values = plain(composed(f"experiment={name}"))
    Settings.of(values)
    resolved = assemble(Settings.of(values)).parts
    assert resolved["metric"], "an experiment reports something"
    # otherwise the weights of the lowest validation loss, which are kept, are never those of the last epoch
    trainer = values["trainer"]
    assert trainer["keep"] == "last" or trainer["max_epochs"] % trainer["check_val_every_n_epoch"] == 0


@pytest.mark.parametrize("base", ["moons/vanilla_128", "images/turned_mixture", "pascal3d_outliers/ensemble"])
def test_an_experiment_in_a_folder_of_the_user_derives_from_one_of_the_project(
    base: str, tmp_path: Path
) -> None:
    (tmp_path / "experiment/mine").mkdir(parents=True)
    derived = f"# @package _global_\ndefaults:\n  - /experiment/{base}\n  - _self_\nbatch_size: 7\n"
    (tmp_path / "experiment/mine/own.yaml").write_text(derived, encoding="utf-8")
    own = plain(composed("experiment=mine/own", f"hydra.searchpath=[file://{tmp_path}]"))
    assert own == plain(composed(f"experiment={base}")) | {"batch_size": 7}


def test_the_experiment_file_of_the_documentation_composes(tmp_path: Path) -> None:
    text = (folder().parent / "docs/how_to/own_experiment.md").read_text(encoding="utf-8")
    example = re.search(r"(?ms)^```yaml\n(.*?)^```$", text)
    assert example
    (tmp_path / "experiment/mine").mkdir(parents=True)
    (tmp_path / "experiment/mine/wide.yaml").write_text(example[1], encoding="utf-8")
    own = plain(composed("experiment=mine/wide", f"hydra.searchpath=[file://{tmp_path}]"))
    assert own["encoder"]["mlp"]["widths"] == [256, 256] and own["optimizer"]["name"] == "sgd"


def test_the_project_names_the_bases_of_its_experiments_from_the_root() -> None:
    """Hydra reads a name without the group as a name below the folder of the experiment that derives from it."""
    relative = [
        path.name
        for path in (folder() / "experiment").rglob("*.yaml")
        if re.search(r"(?m)^  - (?!/experiment/|override |_self_|[\w@/]+:)", path.read_text(encoding="utf-8"))
    ]
    assert not relative


SMOKE_RUNS = {
    "caviar": "caviar/fixed_kappa",
    "idiap": "idiap/von_mises",
    "towncentre": "towncentre/von_mises",
    "cest": "cest/refined",
    "moons": "moons/vanilla_128",
    "modelnet40": "modelnet40/bps_extra_trees",
}
"""Experiments, one for each data set that is generated in seconds."""
NOT_RUN = {
    "coil20",
    "dales",
    "registration",
    "symmetric_solids",
    "faust",
    "pose_from_image",
    "human_scans",
    "labelled_points",
    "image_folder",
    "pascal3d",
    "table_tennis",
    "tabular",
    "turned_images",
    "uci",
}
"""The files of seven are the user's; four first make a body, which takes minutes; test_ranks.py runs pascal3d; of
flights no preset gives the thesis's setting."""


@pytest.mark.parametrize(
    "data",
    first_of_each(SMOKE_RUNS, lambda data: "heads" if data in ("caviar", "idiap", "towncentre") else data),
)
def test_a_smoke_run_goes_through_every_stage(data: str, framework: Framework) -> None:
    """Train with the thesis preset; settings that the preset does not contain come from the experiment."""
    run = ("preset=thesis", "debug=fast", "logger=none", "pictures=false", "samples=50", "threads=1")
    done = framework(f"experiment={SMOKE_RUNS[data]}", *run)
    assert done.code == 0, done.out
    results = json.loads((done.folder / "results.json").read_text(encoding="utf-8"))
    assert results["data"] == data, results


REFUSED = {
    "coil20": "data.root is not set",
    "dales": "data.root is not set",
    "images": "data.root is not set",
    "labelled_points": "data.root is not set",
    "moons/distillation": "objective.distillation.teacher is null",
    "tabular": "data.path is not set",
    "uci": "data.root is not set",
    "smplpix/thesis": "objective.perceptual.weights is null",
}
"""Messages of the experiments that require files or a run of the user, by the beginning of the experiment's name."""


HUGE = {"registration/large"}
"""Experiments with checkpoints of 1.5 GB, which differ from registration/quick only in numbers."""


SHORTENED = sorted({*EXPERIMENTS} - {*SMOKE_RUNS.values()} - HUGE)
FAMILIES = {name.partition("/")[0]: name for name in [*reversed(SHORTENED), *SMOKE_RUNS.values()]}
"""Return one experiment of each family: the quick one if there is one, otherwise the first."""


@pytest.mark.parametrize("name", sorted({*FAMILIES.values(), *HUGE}))
def test_an_experiment_of_each_family_can_be_shortened(name: str) -> None:
    """Shorten by the preset and by hand; a validation interval longer than the training becomes its length."""
    from framework.configuration.assembly import assemble

    values = plain(composed(f"experiment={name}", "debug=fast"))
    assemble(Settings.of(values))
    assert values["data"]["name"] in {*SMOKE_RUNS, *NOT_RUN}
    for epochs in (values["trainer"]["max_epochs"], 2):
        shortened = {**values, "trainer": {**values["trainer"], "max_epochs": epochs}}
        trainer = Settings.of(shortened).bounded_trainer
        assert 1 <= trainer["check_val_every_n_epoch"] <= epochs


@pytest.mark.parametrize(
    "name", sorted(name for name in installed("density_head") if load("density_head", name).knobs)
)
def test_a_density_head_takes_few_samples_or_steps_in_a_short_test(name: str) -> None:
    """A head whose knob keeps its default may take minutes, for example in the intervals of a mixture of ten models."""
    ordinary = plain(composed(f"density_head={name}"))["density_head"]
    short = plain(composed(f"density_head={name}", "debug=fast"))["density_head"]
    for knob, settings in load("density_head", name).knobs.items():
        assert short[knob] <= statistics.median(settings) and short[knob] < ordinary[knob]
    changed = {key for key in ordinary if ordinary[key] != short[key]}
    assert changed == set(load("density_head", name).knobs)
    asked = plain(composed(f"density_head={name}", f"density_head.{knob}={ordinary[knob]}", "debug=fast"))
    assert asked["density_head"][knob] == ordinary[knob]


SHORTER = {
    "caviar/": "batch_size=8",
    "faust/": "batch_size=4",
    "idiap/": "batch_size=8",
    "modelnet40/": "batch_size=4",
    "modelnet40/bps_conv3d_delta": "encoder.bps.points=4096",
    "modelnet40/bps_conv3d_ensemble": "encoder.bps.points=4096 uncertainty.ensemble.members=2",
    "modelnet40/bps_mlp_grid_32": "encoder.bps.points=512",
    "modelnet40/deepsets": "encoder.deepsets.points=128",
    "modelnet40/occ_mlp_32": "encoder.occupancy.side=12",
    "modelnet40/pointnet2": "encoder.pointnet2.width=0.25 encoder.pointnet2.centroids=[64,16]",
    "modelnet40/tdf_mlp_32": "encoder.tdf.side=12",
    "moons/ensemble": "uncertainty.ensemble.members=3",
    "moons/everything": "uncertainty.ensemble.members=2 uncertainty.mc_dropout.samples=2",
    "moons/mc_dropout": "uncertainty.mc_dropout.samples=3",
    "moons/swag": "uncertainty.swag.samples=3",
    "pascal3d": "batch_size=8",
    "rasterizer/fit_pose": "data.height=64 data.width=48",
    "smplpix/unet": "encoder.unet.width=4",
    "table_tennis/": "batch_size=8",
    "towncentre/": "batch_size=8",
}
"""Further settings by the beginning of the experiment's name: smaller networks, and fewer members or samples.

Without them, a run takes up to a minute. `bps_conv3d` and `bps_conv3d_unpadded` keep the size of their grid, which the
layers without padding must fit.
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", SHORTENED)
def test_every_experiment_runs_shortened(name: str, framework: Framework) -> None:
    """Run with the cache that all tests share, since generating bodies takes minutes."""
    done = framework(
        *(f"experiment={name}", "debug=fast", "logger=none", "pictures=false", "threads=1"),
        *(
            () if name.startswith("render/") else ("samples=20",)
        ),  # a mesh renderer refuses what it does not read
        *(
            setting
            for start, settings in SHORTER.items()
            if name.startswith(start)
            for setting in settings.split()
        ),
        more={"FRAMEWORK_CACHE": str(cache.folder(""))},
    )
    wanted = [said for start, said in REFUSED.items() if name.startswith(start)]
    if wanted:
        assert done.code != 0
        assert wanted[0] in done.out
        assert "Traceback" not in done.out
    else:
        assert done.code == 0, done.out
        assert (done.folder / "results.json").is_file()


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_an_experiment_is_its_differences(name: str) -> None:
    lines = (folder() / "experiment" / f"{name}.yaml").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 30
    assert re.search(f"python -m framework (-m )?experiment={name}", lines[1])
    assert re.match(r"# \S", lines[2]), "the page of experiments shows this description"


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["experiment=pascal3d/scva"],
            r"There is no config 'experiment/pascal3d/scva'\. Did you mean 'pascal3d/scvae'\?",
        ),
        (["density_head=mixtur"], r"Did you mean 'mixture'\?"),
        (["trainer.max_epoch=3"], r"trainer\.max_epoch: unknown key\. Did you mean 'max_epochs'\?"),
        (["sed=3"], r"sed: unknown key\. Did you mean 'seed'\?"),
        (["a=b=[", "x"], "."),
    ],
)
def test_a_mistake_becomes_a_sentence(overrides: list[str], message: str) -> None:
    with pytest.raises(Exception) as caught:
        composed(*overrides)
    said = describe_error(caught.value)
    assert said is not None
    assert re.search(message, said), said


def test_an_error_of_ours_is_not_taken_for_a_mistake() -> None:
    assert describe_error(RuntimeError("a bug")) is None


def test_what_a_replaced_choice_leaves_is_dropped() -> None:
    values = plain(composed("encoder=[mlp]", "+encoder.other.width=3"))
    assert list(values["encoder"]) == ["mlp"]


SETS_ITS_HEAD = [
    name
    for name in EXPERIMENTS
    if re.search("^density_head:", (folder() / f"experiment/{name}.yaml").read_text(encoding="utf-8"), re.M)
]


OTHER_HEADS = ("von_mises", "mixture", "gaussian", "categorical", "bernoulli_image")


@pytest.mark.parametrize(
    ("name", "head"),
    [
        pytest.param(name, head, marks=() if head == OTHER_HEADS[row % 5] else pytest.mark.slow)
        for row, name in enumerate(SETS_ITS_HEAD)
        for head in OTHER_HEADS
    ],
)
def test_what_an_experiment_sets_of_its_head_can_be_taken_out_for_another(name: str, head: str) -> None:
    """The message names each key that the new head does not have, with the arguments that remove the key."""
    from framework.configuration.assembly import assemble

    words: list[str] = []
    while True:
        values = plain(composed(f"experiment={name}", f"density_head={head}", *words))
        try:
            assemble(Settings.of(values))
        except ConfigError as error:
            unknown = re.search(r"(density_head\.\S+): unknown key", str(error))
            if unknown is None or OmegaConf.select(OmegaConf.create(values), unknown[1]) is None:
                break  # Hydra deletes no null
            found = re.search(r"If an experiment sets the key, (~density_head\.\S+) removes it", str(error))
            assert found is not None and found[1] not in words, error
            words.append(found[1])
        else:
            break


def test_plural_groups_keep_their_order() -> None:
    values = plain(composed("metric=[viewpoint,log_likelihood,angular_deviation]"))
    assert list(values["metric"]) == ["viewpoint", "log_likelihood", "angular_deviation"]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["seed=-1"], "seed = -1"),
        (["optimizer.learning_rate=nan"], r"optimizer\.learning_rate = nan"),
        (
            ["optimizer=adam", "+optimizer.momentum=0.9"],
            r"optimizer = .*momentum is a setting of sgd only, and the optimiser is adam",
        ),
        (["optimizer.name=adamm"], r"Did you mean 'r?adamw?'\?"),
        (["trainer.max_epochs=0"], r"trainer\.max_epochs = 0"),
        (["+typo=1"], "typo: unknown key"),
        (["+data._target_=os.system"], "must not be able to run code"),
    ],
)
def test_core_settings_are_checked(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Settings.of(plain(composed("data=pascal3d", *overrides)))


def test_an_unknown_trainer_argument_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"Did you mean 'max_steps'\?"):
        Settings.of({"trainer": {"max_step": 3}})


def test_the_trainer_takes_what_lightning_takes() -> None:
    """The core knows Lightning's names without importing it; what it leaves out it sets itself."""
    import pytorch_lightning as pl

    known = inspect.signature(pl.Trainer.__init__).parameters
    ours = {"self", "logger", "callbacks", "plugins", "enable_checkpointing", "use_distributed_sampler"}
    assert TrainerSettings.model_fields.keys() - TRAINER_OURS == known.keys() - ours - {"default_root_dir"}
    registered = pl.strategies.StrategyRegistry.available_strategies()
    assert set(STRATEGIES) - {"auto"} <= set(registered)
    for name in PRECISIONS:
        assert str(name) in str(known["precision"].annotation)


@pytest.mark.parametrize(
    "argument",
    ["hydra/job_logging=evil", "+hydra.job_logging.root=1", "hydra.hydra_logging.x=3", "~hydra/callbacks=x"],
)
def test_hydra_logging_cannot_be_changed(argument: str) -> None:
    with pytest.raises(ConfigError, match="can run code"):
        command_line(["seed=1", argument])


def test_resume_names_a_run_folder(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="does not exist"):
        command_line([f"resume={tmp_path}"])
    (tmp_path / "config.yaml").write_text("seed: 1")
    here = in_quotes(str(tmp_path))
    assert command_line([f"resume={tmp_path}"]) == [f"resume={here}", f"hydra.run.dir={here}"]
    assert command_line(["resume=auto"]) == ["resume=auto"]


def test_a_shadowed_plugins_package_is_named(tmp_path: Path) -> None:
    (tmp_path / "plugins.py").write_text("")
    done = subprocess.run(
        [sys.executable, "-m", "framework", "mode=plugins"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 2
    assert "hides it" in done.stderr


def test_single_values_beside_a_swept_experiment_are_swept_too() -> None:
    given = [
        "-m",
        "experiment=a,b",
        "data.x=1",
        "+y=[1,2]",
        "seed=0,1",
        "hydra.sweep.dir=d",
        "~z",
        "name='p,q'",
    ]
    wanted = [
        "-m",
        "experiment=a,b",
        "data.x=choice(1)",
        "+y=choice([1,2])",
        "seed=0,1",
        "hydra.sweep.dir=d",
        "~z",
    ]
    assert command_line(given) == [*wanted, "name=choice('p,q')"]


@pytest.mark.parametrize(
    "given", [["experiment=a,b", "x=1"], ["-m", "experiment=a", "x=1,2", "y=3"], ["-m", "x=[", "e"]]
)
def test_other_commands_are_left_as_they_are(given: list[str]) -> None:
    assert command_line(given) == given


@drawn(
    st.text(st.characters(exclude_categories=["Cc", "Cs"]) | st.sampled_from("'\\\"=,[]{}() "), min_size=1)
)
def test_any_text_in_quotes_is_read_as_it_stands(text: str) -> None:
    read = OverridesParser.create().parse_override(f"x={in_quotes(text)}").value()
    assert read == text


def test_what_cannot_be_read_is_told_in_quotes(framework: Framework) -> None:
    done = framework("mode=test", "checkpoint=runs/x=(1,é/model.ckpt")
    assert done.code == 2
    assert "If the whole value is one text, write \"checkpoint='runs" in done.out
    told = shlex.split(
        done.out.partition("If the whole value is one text, write ")[2].partition(".\nhelp:")[0]
    )
    assert "runs/x=(1,é/model.ckpt is neither a file" in framework("mode=test", *told).out


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ("experiment=pascal3d/scvae preset=thesis", "preset=thesis/pascal3d"),
        ("-m experiment=pascal3d/scvae,pascal3d/mixture preset=thesis", "preset=choice(thesis/pascal3d)"),
        (
            "-m experiment=choice(pascal3d/scvae,pascal3d/mixture) preset=thesis",
            "preset=choice(thesis/pascal3d)",
        ),
        ("-m experiment=pascal3d/scvae preset=choice(thesis)", "preset=thesis/pascal3d"),
        ("-m experiment=pascal3d/scvae +preset=thesis,thesis", "preset=thesis/pascal3d,thesis/pascal3d"),
    ],
)
def test_a_preset_is_that_of_the_data_however_it_is_chosen(given: str, wanted: str) -> None:
    assert wanted in command_line(given.split())


def test_a_preset_of_several_data_sets_is_refused() -> None:
    with pytest.raises(ConfigError, match="preset=thesis means several presets for these experiments"):
        command_line(["-m", "experiment=choice(pascal3d/scvae,moons/ensemble)", "preset=thesis"])


@pytest.mark.parametrize(
    ("experiment", "wrappers", "name"),
    [
        ("moons/ensemble", None, "ensemble"),
        ("moons/ensemble", "[ensemble,temperature]", "ensemble + temperature"),
        ("moons/vanilla_128", "[temperature]", "vanilla_128 + temperature"),
        (None, "[temperature]", "bernoulli + temperature"),
    ],
)
def test_the_name_of_a_method_holds_each_part_once(
    experiment: str | None, wrappers: str | None, name: str, tmp_path: Path
) -> None:
    from framework.runs.session import method_of

    arguments = (
        [f"experiment={experiment}"]
        if experiment
        else ["data=moons", "density_head=bernoulli", "encoder=[mlp]"]
    )
    arguments += [f"uncertainty={wrappers}"] if wrappers else []
    config = Config.of({**plain(composed(*arguments)), "experiment_name": experiment}, tmp_path, arguments)
    assert method_of(config, config.assembly.parts) == name
