"""A hundred mistyped commands: each ends with one sentence that says what to do, and is no run."""

import os
import shlex
import sys
from functools import cache
from pathlib import Path

import pytest
from hydra.core.global_hydra import GlobalHydra

from framework.app import main
from framework.configuration import composition

MISTAKES = r"""
expriment=moons/everything | Did you mean 'experiment'?
experiments=moons/everything | Did you mean 'experiment'?
experiment=moons/everythin | Did you mean 'moons/everything'?
experiment=moon/everything | Did you mean 'moons/everything'?
experiment=moons | Did you mean 'moons/
experiment= | Available in experiment: caviar
experiment=null | A group takes a name
experiment==moons | wanted key=value
experiment moons/vanilla_128 | 'experiment' cannot be read; wanted key=value
moons/vanilla_128 | wanted key=value
train | wanted key=value
--experiment=moons/vanilla_128 | without dashes: experiment=moons/vanilla_128
seed 3 | wanted key=value
'a=[1' | wanted key=value
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
+optimizer.momentum=0.9 | momentum is a setting of sgd, adamw has none
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
trainer.accelerator=gpu | PyTorch sees none
trainer.accelerator=cuda | PyTorch sees none
trainer.precision=bf16mixed | Did you mean 'bf16-mixed'?
trainer.precision=17 | trainer.precision = 17
trainer.strategy=dpp | Did you mean 'ddp'?
trainer=dpp | Did you mean 'ddp'?
+trainer.max_steps=abc | trainer.max_steps = 'abc'
+trainer.max_steps=-5 | trainer.max_steps = -5
+trainer.limit_train_batches=-3 | from 1 on, or a share
+trainer.limit_train_batches=0 | from 1 on, or a share
+trainer.limit_val_batches=1.5 | from 1 on, or a share
trainer.devices=0 | wanted how many, from 1 on
trainer.devices=two | wanted how many, from 1 on
trainer.num_nodes=0 | trainer.num_nodes = 0
trainer.gradient_clip_val=-1 | trainer.gradient_clip_val = -1
+trainer.gradient_clip_algorithm=nrm | Did you mean 'norm'?
trainer.patience=0 | trainer.patience = 0
trainer.keep=beest | Did you mean 'best'?
+trainer.callbacks=[x] | trainer.callbacks: unknown key
+trainer.accumulate_grad_batches=0 | trainer.accumulate_grad_batches = 0
+trainer.deterministic=maybe | trainer.deterministic = 'maybe'
+trainer.max_time=soon | trainer.max_time = 'soon'
mode=check checkpoint=outputs/run | mode=check reads none, train, test, predict, work_precision do
experiment=moons/vanilla_128 checkpoint=outputs/run | outputs/run is neither a file, a folder nor an MLflow run id
seed=-1 | seed = -1
seed=one | seed = 'one'
seed=0,1 | To sweep over it, add --multirun
-m experiment=moons/vanilla_128 seed=0,one | seed=one; none of the sweep was run
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
experiment=pascal3d/scvae preset=thesis | wanted a file of weights trained on ImageNet
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
experiment=moons/vanilla_128 metric=[accuracy,psnr] | Categorical of event_shape () draws no color
data=moons density_head=extra_trees metric=[psnr] | The true 'color' of every image was asked for
objective=[outlier] | Did you mean 'outlier_exposure'?
renderer=zbufer | Did you mean 'zbuffer'?
experiment=moons/vanilla_128 density_head=scvae | density_head scvae, of which
experiment=pascal3d/scvae density_head=categorical | Choose another one, or other data
experiment=pascal3d/scvae metric=[accuracy] | Choose another one, or other data
experiment=moons/vanilla_128 +data._target_=os.system | must not be able to run code
experiment=moons/vanilla_128 data@outliers=pascal3d | outliers.data_seed: unknown key
mode=tran | Did you mean 'train'?
mode=test | mode=test needs checkpoint=
mode=test checkpoint=nowhere | Give the folder a run printed at its start
mode=predict mode.file=x | Did you mean 'files'?
mode=predict mode.files=nowhere | Give a file, or a folder of files
mode=combine | mode.members is missing
mode=combine mode.members=nowhere | wanted at least two
mode=encode mode.files=a mode.into=b | data.name is missing
mode=sync mode.run=nowhere | Give the folder of a run
mode=check | name a plugin
"""


FOLDERS = cache(composition.config_folders)
"""Found once for all commands."""


@pytest.mark.parametrize("row", MISTAKES.strip().splitlines())
def test_a_mistake_gets_one_sentence(
    row: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(composition, "config_folders", FOLDERS)
    command, _, wanted = row.partition(" | ")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["framework", *shlex.split(command)])
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    try:
        with pytest.raises(SystemExit) as ended:
            main()
    finally:
        os.environ.pop("HYDRA_FULL_ERROR", None)
        GlobalHydra.instance().clear()
    said = capsys.readouterr().err
    assert ended.value.code in (1, 2)
    assert said.startswith("error: ")
    assert said.endswith("\n")
    assert said.count("\n") == 1, said
    assert wanted in said
    assert not [*tmp_path.rglob("*.*")], "a mistake is no run"


def test_there_are_a_hundred() -> None:
    assert len(set(MISTAKES.strip().splitlines())) >= 100
