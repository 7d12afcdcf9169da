"""A hundred and fifty mistaken commands: each ends with one message that tells what to do, and leaves no run."""

import os
import re
import shlex
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
import yaml
from hydra.core.global_hydra import GlobalHydra

from framework.app import FIRST_PAGE, PAGES, START, main, page_of
from framework.configuration import composition
from tests.conftest import first_of_each

MISTAKES = r"""
expriment=moons/everything | Did you mean 'experiment'?
experiments=moons/everything | Did you mean 'experiment'?
experiment=moons/everythin | Did you mean 'moons/everything'?
experiment=moon/everything | Did you mean 'moons/everything'?
experiment=moons | Did you mean 'moons/
experiment= | Available in experiment: caviar
experiment=null | A group takes a name
experiment==moons | expected key=value
experiment moons/vanilla_128 | 'experiment' cannot be read; expected key=value
moons/vanilla_128 | expected key=value
train | expected key=value
--experiment=moons/vanilla_128 | without dashes: experiment=moons/vanilla_128
seed 3 | expected key=value
'a=[1' | expected key=value
learning_rate=0.01 | Did you mean 'optimizer.learning_rate'?
lr=0.01 | lr: unknown key
optimizer.lr=0.01 | Did you mean 'learning_rate'?
optimizer.wd=0.1 | Did you mean 'weight_decay'?
optimizer.learning_rat=0.01 | Did you mean 'learning_rate'?
optimizer.learning_rate=fast | optimizer.learning_rate = 'fast'
optimizer.learning_rate=0 | greater than 0
optimizer.learning_rate=-0.1 | greater than 0
optimizer.weight_decay=-1 | optimizer.weight_decay = -1
optimizer.schedule=cosin | Did you mean 'cosine'?
optimizer.warmup_steps=1.5 | optimizer.warmup_steps = 1.5
+optimizer.momentum=0.9 | momentum is a setting of sgd only, and the optimiser is adamw
optimizer=adm | Did you mean 'adam'?
optimizer=adamax | Available in optimizer: adam, adamw, sgd
epochs=3 | Did you mean 'trainer.max_epochs'?
max_epochs=3 | Did you mean 'trainer.max_epochs'?
trainer.epochs=3 | Did you mean 'max_epochs'?
trainer.max_epochs=0 | greater than or equal to 1
trainer.max_epochs=many | trainer.max_epochs = 'many'
trainer.max_epochs=1.5 | trainer.max_epochs = 1.5
trainer.max_epochs=true | trainer.max_epochs = True
trainer.accelerator=tpus | Did you mean 'tpu'?
trainer.accelerator=gpu | PyTorch finds no such device
trainer.accelerator=cuda | PyTorch finds no such device
trainer.precision=bf16mixed | Did you mean 'bf16-mixed'?
trainer.precision=17 | trainer.precision = 17
trainer.strategy=dpp | Did you mean 'ddp'?
trainer=dpp | Did you mean 'ddp'?
+trainer.max_steps=abc | trainer.max_steps = 'abc'
+trainer.max_steps=-5 | trainer.max_steps = -5
+trainer.limit_train_batches=-3 | (an integer, 1 or more), or a share
+trainer.limit_train_batches=0 | (an integer, 1 or more), or a share
+trainer.limit_val_batches=1.5 | (an integer, 1 or more), or a share
trainer.devices=0 | expected a number of devices (1 or more)
trainer.devices=two | expected a number of devices (1 or more)
trainer.num_nodes=0 | trainer.num_nodes = 0
trainer.gradient_clip_val=-1 | trainer.gradient_clip_val = -1
+trainer.gradient_clip_algorithm=nrm | Did you mean 'norm'?
trainer.patience=0 | trainer.patience = 0
trainer.keep=beest | Did you mean 'best'?
+trainer.callbacks=[x] | there is no callback 'x'. The callbacks are early_stopping, weight_averaging
+trainer.accumulate_grad_batches=0 | trainer.accumulate_grad_batches = 0
+trainer.deterministic=maybe | trainer.deterministic = 'maybe'
+trainer.max_time=soon | trainer.max_time = 'soon'
mode=check checkpoint=run | mode=check reads no checkpoint; train, test, calibrate, predict,
experiment=moons/vanilla_128 checkpoint=outputs/run | outputs/run is neither a file, a folder nor an MLflow run id
seed=-1 | seed = -1
seed=one | seed = 'one'
seed=0,1 | To sweep over it, add --multirun
-m experiment=moons/vanilla_128 seed=0,one | seed=one. No job of the sweep was run
-m experiment=moons/vanilla_128 optimizer.learning_rate=0.1,0 | greater than 0
-m experiment=moons/vanilla_128 density_head=categorical,von_mises | von_mises describes targets of kind 'angle'
-m experiment=moons/vanilla_128 metric=[accuracy],[crps] | crps measures distances
batch_size=0 | batch_size = 0
batchsize=32 | Did you mean 'batch_size'?
bs=32 | Did you mean 'batch_size'?
num_workers=2 | Did you mean 'workers'?
threads=0 | threads = 0
samples=0 | samples = 0
pictures=perhaps | 'png', 'pdf' or 'svg'
pictures=svgg | Did you mean 'svg'?
resume=outputs/none | Give the folder of a run
logger=mflow | Did you mean 'mlflow'?
logger.url=x | Did you mean 'uri'?
debug=fats | Did you mean 'fast'?
debug=true | A group takes a name
experiment=coil20/mixture preset=thesis | no setting for data=coil20
experiment=pascal3d/scvae preset=thesis | weights is missing: give a file of weights trained on ImageNet
preset=thesi | Did you mean 'thesis'?
hydra/job_logging=x | can run code
hydra.verbos=true | Did you mean 'verbose'?
data=moon | Did you mean 'moons'?
data=moons | No density_head is chosen
data=moons density_head=bernoulli | No encoder is chosen
data=moons data.noize=0.3 | Did you mean 'noise'?
data=moons data.batch_size=32 | Did you mean 'batch_size'?
data@outlier=moons_outliers | data@outliers
data@outliers=moons_outlier | Did you mean 'moons_outliers'?
encoder=[mpl] | Did you mean 'mlp'?
encoder=[mlp] encoder.widths=[3] | Did you mean 'encoder.mlp.widths'?
density_head=bernouli | Did you mean 'bernoulli'?
uncertainty.ensemble.members=3 | No uncertainty is chosen
metrics=[accuracy] | Did you mean 'metric'?
metric=[acuracy] | Did you mean 'accuracy'?
experiment=moons/vanilla_128 metric=[accuracy,psnr] | CategoricalDensity of event_shape () provides no color
data=moons density_head=extra_trees metric=[psnr] | A metric reads the true 'color' of every image
objective=[outlier] | Did you mean 'outlier_exposure'?
renderer=zbufer | Did you mean 'zbuffer'?
experiment=moons/vanilla_128 density_head=scvae | density_head scvae cannot be built, because its part
experiment=pascal3d/scvae density_head=categorical | Choose another plugin for this target, or other data
experiment=pascal3d/scvae metric=[accuracy] | Choose another plugin for this target, or other data
experiment=moons/vanilla_128 +data._target_=os.system | must not be able to run code
experiment=moons/vanilla_128 data@outliers=pascal3d | outliers.data_seed: unknown key
mode=tran | Did you mean 'train'?
mode=test | mode=test needs checkpoint=
mode=test checkpoint=nowhere | Give the folder that a run printed at its start
mode=predict mode.file=x | Did you mean 'files'?
mode=predict mode.files=nowhere | Give a file, or a folder of files
mode=combine | mode.members is missing: give the folder of a sweep, or a list of runs
mode=report | mode.run is missing: give the folder of a run or of a sweep
mode=sync | mode.run is missing: give the folder of a run or of a sweep
mode=new | mode.plugin is missing: give registry/name of the plugin, such as density_head/my_head
mode=encode encoder=[bps] | mode.files is missing: give a folder of files or of shards
mode=combine mode.members=nowhere | at least two are required
mode=combine mode.members=nowhere uncertainty=[ensemble] | uncertainty=ensemble needs several models
mode=encode mode.files=a mode.into=b | data.name is missing
mode=sync mode.run=nowhere | is not a run folder
mode=check | needs a plugin, but none is chosen
--epochs 5 | without dashes: trainer.max_epochs=5
--epochs=5 | without dashes: trainer.max_epochs=5
--max-epochs 5 | without dashes: trainer.max_epochs=5
-lr 0.1 | without dashes: optimizer.learning_rate=0.1
--batch-size=3 | without dashes: batch_size=3
--seed | without dashes: seed=...
--gpus 1 | is an unknown flag
experiment=moons/vanilla_128 --seed 3 | without dashes: seed=3
--cfg | expected one argument
--cfg jobs | invalid choice: 'jobs'
--info everything | invalid choice: 'everything'
seed=1 --package | expected one argument
experiment=moons/vanilla_128 -m seed=range(3,3) | seed=range(3,3) has no value, so there is no job
-m experiment=moons/vanilla_128 'optimizer=glob(xyz*)' | optimizer=glob(xyz*) has no value
experiment=moons/vanilla_128 -m seed=0,one | seed=one. No job of the sweep was run
experiment=moons/vanilla_128 hydra.run.dir=/proc/self/x | /proc/self/x cannot be written
experiment=moons/vanilla_128 hydra.run.dir=/dev/null/x | /dev/null/x cannot be written
mode=test checkpoint=last | no run in that folder has a checkpoint
experiment=moons/vanilla_128 checkpoint=last | no run in that folder has a checkpoint
encoder=[resnet50] | 'encoder/resnet50'. Did you mean 'resnet'? Available in encoder
density_head=regression | 'density_head/regression'. Available in density_head
density_head=pit | 'density_head/pit'. Available in density_head
encoder=[transformer] | 'encoder/transformer'. Available in encoder
metric=[loss] | 'metric/loss'. Available in metric
experiment=imagenet/resnet | more.
experiment=zzz | more.
seed=1.5 | seed = 1.5
seed=null | seed = None
samples=many | samples = 'many'
workers=-1 | workers = -1
workers=100000 | less than or equal to 1024
batch_size=big | batch_size = 'big'
optimizer.schedule=step | milestones is empty
optimizer.milestones=[3] | milestones are a setting of schedule=step only
optimizer.factor=2 | optimizer.factor = 2
optimizer.patience=0 | optimizer.patience = 0
trainer.max_epoch=3 | Did you mean 'max_epochs'?
trainer.log_every_steps=0 | trainer.log_every_steps = 0
trainer.checkpoint_every_steps=-1 | trainer.checkpoint_every_steps = -1
+trainer.profiler=fast | trainer.profiler = 'fast'
+trainer.logger=true | trainer.logger: unknown key
logger.uri=http://me:secret@127.0.0.1 | was given with a password
mode=tests | Did you mean 'test'?
mode=predict checkpoint=nowhere | Give the folder that a run printed at its start
mode=work_precision | needs checkpoint=
renderer=opengl | 'renderer/opengl'. Available in renderer
uncertainty=[ensembl] | Did you mean 'ensemble'?
data=cifar10 | 'data/cifar10'. Available in data
experiment=moons/vanilla_128 'encoder.mlp.widths=[0]' | encoder
experiment=moons/vanilla_128 renderer=zbuffer | renderer=zbuffer: mode=train reads no renderer; render, check do
-m experiment=moons/vanilla_128 renderer=zbuffer,rasterizer | renderer=zbuffer: mode=train reads no renderer
mode=test checkpoint=nowhere density_head=bernoulli | mode=test reads no density_head; train, render, check do
mode=test checkpoint=nowhere encoder=[mlp] | mode=test reads no encoder; train, encode, render, check do
mode=test checkpoint=nowhere trainer.max_epochs=3 | mode=test reads no trainer.max_epochs; train, render do
mode=test checkpoint=nowhere optimizer=sgd | mode=test reads no optimizer; train, render do
mode=test checkpoint=nowhere debug=fast | debug=fast has no effect
mode=predict checkpoint=nowhere metric=[accuracy] | mode=predict reads no metric
mode=predict checkpoint=nowhere pictures=false | mode=predict reads no pictures
mode=predict checkpoint=nowhere metric.x.y=1 | metric.x.y=1: mode=predict reads no metric
mode=calibrate checkpoint=nowhere objective=[adversarial] | mode=calibrate reads no objective; train, render, check do
mode=combine mode.members=nowhere checkpoint=nowhere | mode=combine reads no checkpoint
mode=encode mode.files=a mode.into=b data=point_cloud_folder samples=3 | mode=encode reads no samples
mode=plugins data=moons | mode=plugins reads no data
mode=sync mode.run=nowhere data=moons | mode=sync reads no data
mode=render mode.files=a.obj | mode=render needs a renderer. Choose an installed one: renderer=
mode=render renderer=rasterizer | has no scenes to draw. Set mode.files
mode=render renderer=rasterizer mode.files=nowhere.obj | the file does not exist
mode=render renderer=rasterizer mode.files=a.obj mode.surface=colors | only the scenes of a data set have this option
mode=render renderer=rasterizer mode.files=a.obj mode.camera=b.json mode.fov=3 | mode.camera says the whole view
mode=render renderer=rasterizer mode.files=a.obj checkpoint=nowhere | renderer=rasterizer has no trained model
mode=render renderer=rasterizer mode.files=a.obj optimizer=adam | renderer=rasterizer learns nothing
mode=render renderer=rasterizer mode.files=a.obj metric=[psnr] | mode.truth names no true images
mode=render renderer=rasterizer mode.files=a.obj data=human_scans | mode.files is set
mode=render renderer=rasterizer mode.files=a.obj mode.background=whit | mode.background = 'whit'
mode=render renderer=rasterizer mode.files=a.obj mode.channels=[colour] | Did you mean 'color'?
mode=render renderer=rasterizer data=moons | data=moons has no scenes to draw
mode=render renderer=rasterizer data=human_scans mode.frames=3 | only scenes of mode.files have this option
mode=render renderer=smplpix mode.files=a.obj | renderer=smplpix draws with a trained model. Add checkpoint=
mode=render renderer=smplpix mode.files=a.obj checkpoint=nowhere | Give the folder that a run printed at its start
mode=render renderer=smplpix data=human_scans mode.surface=texture | draws with a trained model
mode=check data=moons samples=3 | mode=check reads no samples
+mode.files=a experiment=moons/vanilla_128 | mode.files: unknown key
experiment=moons/vanilla_128 optimizer.patience=3 | only the schedule plateau reads it
experiment=moons/vanilla_128 +trainer.limit_test_batches=3 | the test always covers its whole split
experiment=moons/vanilla_128 logger=none +logger.uri=x | logger=none has no store
experiment=moons/vanilla_128 metric=[accuracy] outliers.test=9 | no metric of this run reads outliers
data=moons density_head=extra_trees metric=[accuracy] trainer.max_epochs=3 | is fitted in one step, without gradient
data=moons density_head=extra_trees metric=[accuracy] optimizer=sgd | is fitted in one step, without gradient
experiment=moons/vanilla_128 encoder.mlp.width=3 | Did you mean 'widths'?
"""


ROOT = Path(__file__).parent.parent
FOLDERS = cache(composition.config_folders)
"""Found once for all commands."""


Said = Callable[[list[str]], str]


@pytest.fixture
def said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Said:
    """Return a function that runs a mistaken command in an empty folder and returns its one-line error message.

    The function checks that the folder stays empty.
    """

    def say(command: list[str]) -> str:
        monkeypatch.setattr(composition, "config_folders", FOLDERS)
        (tmp_path / "here").mkdir()
        monkeypatch.chdir(tmp_path / "here")
        monkeypatch.setattr(sys, "argv", ["framework", *command])
        monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
        try:
            with pytest.raises(SystemExit) as ended:
                main()
        finally:
            os.environ.pop("HYDRA_FULL_ERROR", None)
            GlobalHydra.instance().clear()
        said = capfd.readouterr().err
        assert ended.value.code in (1, 2)
        assert said.startswith("error: ")
        assert said.endswith("\n")
        assert said.count("\n") <= 2, said
        said, _, page = said.partition("\n")
        said += "\n"
        if page:
            assert page.startswith("help:  docs/") and page.endswith(".md\n"), page
            assert (ROOT / page.removeprefix("help:  ").strip()).is_file(), page
        assert not [*(tmp_path / "here").iterdir()], "a mistake is not a run"
        return said

    return say


def kind(row: str) -> str:
    """Return what a row has in common with rows that test nearly the same: the message without names and values, or the
    first part of the key if the message has nothing else."""
    command, _, wanted = row.partition(" | ")
    message = re.sub(
        r"'[^']*'|[-+\w.@/{}\[\]]*[.=]\S*|(reads no|Available in|wants|\d).*", r"\1", wanted
    ).strip()
    group = re.match(r"\W*(\w*)", shlex.split(command)[-1])
    assert group is not None
    return message or group[1]


@pytest.mark.parametrize("row", first_of_each(MISTAKES.strip().splitlines(), kind))
def test_a_mistake_gets_one_sentence(row: str, said: Said) -> None:
    command, _, wanted = row.partition(" | ")
    assert wanted in said(shlex.split(command))


TOP = b"# @package _global_\n"
DAMAGED = {
    "cut": (
        TOP + b"seed: [1, 2\n",
        r"mine\.yaml, line 3, column 1: while parsing a flow sequence, expected ',' or '\]'",
    ),
    "quote": (TOP + b'seed: "abc\n', r"mine\.yaml, line 3, column 1: while scanning a quoted scalar"),
    "tab": (TOP + b"trainer:\n\tmax_epochs: 1\n", r"mine\.yaml, line 3, column 1: .* found character '\\t'"),
    "twice": (TOP + b"seed: 1\nseed: 2\n", r"mine\.yaml, line 3, column 1: .* found duplicate key seed"),
    "two documents": (
        b"---\nseed: 1\n---\nseed: 2\n",
        r"mine\.yaml: .*\(line 3, column 1: .*another document",
    ),
    "alias": (TOP + b"seed: *none\n", r"mine\.yaml: cannot be read as a config \(the file contains an alias"),
    "tag": (
        TOP + b"seed: !!python/object:os.system x\n",
        r"mine\.yaml: .*\(line 2, column 7: the tag \S*python/object:os\.system is not allowed\)",
    ),
    "key": (TOP + b"? [1, 2]\n: 3\n", r"mine\.yaml: .*\(line 2, column 3: .* found unhashable key\)"),
    "null key": (TOP + b"null: 4\n", r"In 'experiment/mine': Incompatible key type 'NoneType'"),
    "null byte": (TOP + b"seed: 1\x00\n", r"#x0000: .*mine\.yaml\", position 27"),
    "latin-1": (
        TOP + b"seed: M\xfcller\n",
        r"line 2 contains the byte 0xfc, which is not UTF-8\. Save",
    ),
    "utf-16": ("seed: 1\n".encode("utf-16"), r"the file is text in UTF-16, but UTF-8 is required\. Save"),
    "list": (TOP + b"- seed\n- 1\n", r"In 'experiment/mine': .*A config consists of keys and values"),
    "list of keys": (TOP + b"- seed: 1\n", r"In 'experiment/mine': .*A config consists of keys and values"),
    "number": (
        TOP + b"3\n",
        r"In 'experiment/mine': Invalid loaded object type: int\. A config consists of keys and values",
    ),
    "text": (
        b"just words\n",
        r"chosen as experiment sets nothing at the top level\. Its first line must be `# @package _global_`",
    ),
    "no package": (
        b"seed: 1\n",
        r"chosen as experiment sets nothing at the top level\. Its first line must be `# @package _global_`",
    ),
    "nothing": (b"", r"chosen as experiment sets nothing at the top level"),
    "other package": (b"# @package nosuch\nseed: 1\n", r"nosuch: unknown key"),
    "unknown key": (TOP + b"seeds: 1\n", r"seeds: unknown key\. Did you mean 'seed'\?"),
    "open interpolation": (
        TOP + b"seed: ${oops\n",
        r"mine\.yaml contains '\$\{oops', which may read more than the config",
    ),
    "interpolation": (
        TOP + b"seed: ${nosuch.key}\n",
        r"'nosuch\.key' not found \(at seed\)\. Give the missing key a value",
    ),
    "resolver": (TOP + b"seed: ${nosuch:key}\n", r"mine\.yaml contains '\$\{nosuch:key\}', which may read"),
    "defaults is text": (
        TOP + b"defaults: moons\n",
        r"'experiment/mine', defaults must be a list .*A config consists",
    ),
    "defaults is a mapping": (
        TOP + b"defaults:\n  /data: moons\n",
        r"'experiment/mine', defaults must be a list",
    ),
    "default is a number": (
        TOP + b"defaults:\n  - 3\n",
        r"In 'experiment/mine': Unsupported type in defaults : int",
    ),
    "name is a number": (
        TOP + b"defaults:\n  - override /data: 3\n",
        r"'experiment/mine': Unsupported item value",
    ),
    "two in one": (
        TOP + b"defaults:\n  - /a: b\n    /c: d\n",
        r"experiment/mine: Too many keys in default item",
    ),
    "no such config": (
        TOP + b"defaults:\n  - override /data: mons\n",
        r"'data/mons'\. Did you mean 'moons'\?",
    ),
    "no such group": (
        TOP + b"defaults:\n  - override /dta: moons\n",
        r"'experiment/mine': Could not override 'dta'",
    ),
    "no override": (TOP + b"defaults:\n  - /data: moons\n", r"Multiple values for data\. To override"),
    "no data": (TOP + b"defaults:\n  - override /data: null\n", r"No data is chosen"),
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_a_file_that_is_no_config_gets_one_sentence(kind: str, said: Said, tmp_path: Path) -> None:
    content, wanted = DAMAGED[kind]
    (tmp_path / "own" / "experiment").mkdir(parents=True)
    (tmp_path / "own" / "experiment" / "mine.yaml").write_bytes(content)
    told = said([f"--config-dir={tmp_path / 'own'}", "experiment=mine"])
    assert re.search(wanted, told), told


def test_a_file_that_a_run_reads_is_not_taken_for_a_config() -> None:
    try:
        b"\xfc".decode()
    except UnicodeDecodeError as error:
        assert composition.describe_error(error) is None
    assert composition.describe_error(ValueError("Unsupported type in defaults : int")) is None
    try:
        raise RuntimeError("cannot go on") from yaml.parser.ParserError(
            "while reading", None, "no YAML", None
        )
    except RuntimeError as error:
        assert "no YAML. The file cannot be read as YAML" in str(composition.describe_error(error))


def test_there_are_a_hundred_and_fifty() -> None:
    assert len(set(MISTAKES.strip().splitlines())) >= 150


@pytest.mark.parametrize(
    ("command", "page"),
    [
        ("data=moons", "docs/start/by_task.md"),
        ("experiment=nope", "docs/start/by_task.md"),
        ("-m experiment=nope seed=0,1", "docs/how_to/sweeps.md"),
        ("-m experiment=nope hydra/launcher=slurm", "docs/engines.md"),
        ("mode=render", "docs/how_to/render.md"),
        ("mode=predict checkpoint=x budget.error=1", "docs/how_to/budgets.md"),
        ("mode=test", "docs/commands.md"),
        ("data=tabular +data.targt=y", "docs/tables.md"),
        ("experiment=moons/vanilla_128 logger=[csv,mlflw]", "docs/how_to/tracking.md"),
    ],
)
def test_an_error_leads_to_the_page_about_the_command(command: str, page: str) -> None:
    assert page_of(shlex.split(command)) == page


def test_the_texts_of_a_beginner_name_pages_that_exist(capsys: pytest.CaptureFixture[str]) -> None:
    """Check the command without arguments, `--help`, and every page that an error can name."""
    texts = [START, composition.help_text(), FIRST_PAGE, *PAGES.values()]
    for text in texts:
        pages = re.findall(r"docs/[\w/]+\.md", text)
        assert pages and all((ROOT / page).is_file() for page in pages), text
    for text in texts[:2]:
        assert "docs/start/by_task.md" in text and "docs/commands.md" in text
        assert all(len(line) <= 80 for line in text.splitlines())
