"""Callbacks of Lightning that a config chooses by name."""

import io
import math
import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import pytorch_lightning as pl
import torch
from rich.console import Console

from framework.configuration.command_line import _add_trainer_keys, _name_callbacks
from framework.configuration.settings import (
    REFUSED_CALLBACKS,
    CallbackSettings,
    GradientAccumulationSettings,
    ModelSummarySettings,
    Settings,
    WeightAveragingSettings,
)
from framework.errors import ConfigError
from framework.storage import checkpoints
from framework.training.callbacks import AccumulateGradients, AverageWeights, PrintSummary
from tests.conftest import TINY, Framework

QUIET = [*TINY, "logger=none"]


def test_a_list_of_names_is_a_mapping_whose_keys_can_be_set() -> None:
    written = [
        "trainer.callbacks=[weight_averaging,model_summary]",
        "trainer.callbacks.weight_averaging.decay=0.9",
    ]
    assert _add_trainer_keys(_name_callbacks(written)) == [
        "++trainer.callbacks={weight_averaging:{},model_summary:{}}",
        "++trainer.callbacks.weight_averaging.decay=0.9",
    ]


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ("weight_averagin", "Did you mean 'weight_averaging'"),
        ("os.system", "there is no callback 'os.system'"),
        ("lr_monitor", "train/learning_rate"),
        ("swa", "weight_averaging with decay=null"),
        ("model_pruning", "same bits"),
        ("lambda_callback", "holds no code"),
    ],
)
def test_other_names_are_refused(names: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        _name_callbacks([f"trainer.callbacks=[{names}]"])
    for value in ([names], {names: {}}):  # in a file
        with pytest.raises(ConfigError, match=said):
            Settings.of({"trainer": {"callbacks": value}})


def test_every_callback_of_lightning_is_known() -> None:
    """A callback of Lightning that is neither chosen nor refused by name would only get the nearest name."""
    own = {
        "Callback", "BaseFinetuning", "BasePredictionWriter", "Checkpoint", "EMAWeightAveraging", "ProgressBar",
        "WeightAveraging", "EarlyStopping", "GradientAccumulationScheduler", "ModelSummary", "LambdaCallback",
        "SpikeDetection",
    }  # fmt: skip
    refused = {name.replace("_", "") for name in REFUSED_CALLBACKS}
    for name in set(pl.callbacks.__all__) - own:
        assert name.lower() in refused, name


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"weight_averaging": {"decay": 1.5}}, "decay"),
        ({"weight_averaging": {"deca": 0.5}}, "Did you mean 'decay'"),
        ({"early_stopping": {"min_delta": -1}}, "min_delta"),
        ({"gradient_accumulation": {}}, "batches"),
        ({"gradient_accumulation": {"batches": {"0": 0}}}, "batches"),
        ({"model_summary": {"max_depth": -2}}, "max_depth"),
    ],
)
def test_settings_are_checked(values: object, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        Settings.of({"trainer": {"callbacks": values}})


@pytest.mark.parametrize("depth", [0, 1, 2, -1])
def test_the_summary_counts_parameters_and_states_no_flops_that_it_has_not_measured(depth: int) -> None:
    module = pl.LightningModule()
    module.predictor = torch.nn.Sequential(
        torch.nn.Linear(300, 10), torch.nn.Linear(10, 1).requires_grad_(False)
    )
    out = io.StringIO()
    summary = PrintSummary(ModelSummarySettings(max_depth=depth), Console(file=out, width=80))
    summary.on_fit_start(pl.Trainer(logger=False, enable_checkpointing=False, accelerator="cpu"), module)
    printed = out.getvalue()
    assert "parameters: 3,021, of which 3,010 are trained" in printed
    assert "flop" not in printed.lower()
    assert bool(re.search(r"predictor +Sequential +3,021\b", printed)) == (depth != 0)
    assert bool(re.search(r"predictor\.1 +Linear +11\b", printed)) == (depth in (2, -1))


CASES = {
    "averaged": [
        "trainer.callbacks=[weight_averaging]",
        "trainer.callbacks.weight_averaging.decay=0.8",
        "trainer.callbacks.weight_averaging.first_epoch=1",
    ],
    "mean of the last": ["trainer.callbacks=[weight_averaging]", "trainer.keep=last",
                         "trainer.callbacks.weight_averaging.decay=null"],
    "accumulated": [
        "trainer.callbacks=[gradient_accumulation]",
        "trainer.callbacks.gradient_accumulation.batches={1:2,2:3}",
    ],
    "stops": [
        "trainer.callbacks=[early_stopping,model_summary]",
        "trainer.callbacks.early_stopping.min_delta=0.2",
        "trainer.patience=1",
        "trainer.max_epochs=9",
    ],
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_a_resumed_run_continues_with_the_same_bits(framework: Framework, tmp_path: Path, name: str) -> None:
    """The run is killed in the middle of its second epoch, after a checkpoint within this epoch."""
    settings = [*QUIET, *CASES[name], "trainer.checkpoint_every_steps=2"]
    whole = framework(*settings, folder="whole")
    assert whole.code == 0, whole.out
    killed = framework(
        *settings, "+data.signal_at=14", f"+data.signal_number={int(signal.SIGKILL)}",
        f"+data.signal_marker={tmp_path / 'marker'}", folder="killed",
    )  # fmt: skip
    assert killed.code == -signal.SIGKILL
    resumed = framework(f"resume={killed.folder}")
    assert resumed.code == 0, resumed.out
    assert "resuming from" in resumed.out
    for key in ("train/loss", "validation/loss", "train/learning_rate", "test/log_likelihood"):
        assert killed.values(key) == whole.values(key) != {}
    weights = [
        torch.load(run.folder / "checkpoints" / "model.ckpt", weights_only=True)["state_dict"]
        for run in (whole, killed)
    ]
    assert all(torch.equal(weights[0][key], weights[1][key]) for key in weights[0])
    if name == "accumulated":
        assert max(whole.losses()) == 9 + 5 + 3
    if name == "stops":
        assert "stopped early" in whole.out
        assert re.search(r"parameters: [\d,]+, of which [\d,]+ are trained", whole.out)
        assert len(whole.values("validation/loss")) < 9
    if name == "averaged":
        plain = framework(*QUIET, folder="plain")
        assert plain.losses() == whole.losses(), "the average changes no step"
        validated = [list(run.values("validation/loss").values()) for run in (plain, whole)]
        assert validated[0][0] == validated[1][0], "before the average begins"
        assert validated[0][1] != validated[1][1]


@pytest.mark.parametrize("decay", [0.7, None])
def test_the_average_is_that_of_its_formula(decay: float | None) -> None:
    """Constants stay the same to the last bit, and whole numbers are copied."""
    average = AverageWeights(WeightAveragingSettings(decay=decay))
    values = torch.randn(6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    mean = values[0]
    for count, value in enumerate(values[1:], 1):
        mean = average._average(mean, value, torch.tensor(count))
    weights = (
        [1 / 6] * 6 if decay is None else [decay**5, *((1 - decay) * decay ** (5 - n) for n in range(1, 6))]
    )
    assert math.isclose(
        float(mean), sum(w * float(v) for w, v in zip(weights, values, strict=True)), rel_tol=1e-12
    )
    constant = torch.tensor([0.1, 1e30, -3.0])
    assert torch.equal(average._average(constant, constant.clone(), torch.tensor(3)), constant)
    assert torch.equal(average._average(torch.tensor(5), torch.tensor(9), 1), torch.tensor(9))


def test_accumulated_batches_follow_the_epoch() -> None:
    chosen = AccumulateGradients(GradientAccumulationSettings(batches={2: 4}))
    assert [chosen.get_accumulate_grad_batches(epoch) for epoch in range(4)] == [1, 1, 4, 4]


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["trainer.callbacks=[early_stopping]", "trainer.patience=null"], "trainer.patience=null"),
        (
            [
                "trainer.callbacks=[gradient_accumulation]",
                "trainer.callbacks.gradient_accumulation.batches={0:2}",
                "trainer.accumulate_grad_batches=2",
            ],
            "Leave one of them out",
        ),
        (
            [
                "trainer.callbacks=[weight_averaging]",
                "uncertainty=[swag]",
                "trainer.keep=last",
                "trainer.patience=null",
                "encoder.mlp.batch_norm=false",
            ],
            "Swag collects weights itself",
        ),
    ],
)
def test_contradictions_are_refused(framework: Framework, settings: list[str], said: str) -> None:
    done = framework(*QUIET, *settings)
    assert done.code == 2, done.out
    assert said in done.out


def test_no_callback_is_chosen_by_default() -> None:
    assert Settings().callbacks == CallbackSettings()


DAMAGES: dict[str, Callable[[dict[str, Any]], object]] = {
    "optimiser": lambda state: state["optimizer_states"][0]["state"][0].update(exp_avg=None),
    "groups": lambda state: state["optimizer_states"][0].update(param_groups=math.nan),
    "loops": lambda state: state["loops"]["fit_loop"].update({"epoch_loop.batch_progress": [[1]]}),
    "schedule": lambda state: state.update(lr_schedulers=[math.nan]),
    "average": lambda state: state.update(current_model_state=1e308),
    "callbacks": lambda state: state.update(callbacks={key: [1] for key in state["callbacks"]}),
    "counter": lambda state: state["loops"]["fit_loop"]["epoch_loop.state_dict"].update(
        _batches_that_stepped=None
    ),
    "step": lambda state: state.update(global_step="x"),
}


@pytest.mark.parametrize(
    "damage", [pytest.param(name, marks=() if name == "loops" else pytest.mark.slow) for name in DAMAGES]
)
def test_a_foreign_state_of_a_training_gets_a_sentence(
    framework: Framework, tmp_path: Path, damage: str
) -> None:
    killed = framework(
        *QUIET, *CASES["averaged"], "trainer.checkpoint_every_steps=2", "+data.signal_at=14",
        f"+data.signal_number={int(signal.SIGKILL)}", f"+data.signal_marker={tmp_path / 'marker'}", folder="killed",
    )  # fmt: skip
    folder = killed.folder / "checkpoints"
    state = checkpoints.read(folder / "last.ckpt")
    DAMAGES[damage](state)
    for name in ("last.ckpt", "previous.ckpt"):
        checkpoints.write(state, folder / name)
    resumed = framework(f"resume={killed.folder}")
    assert resumed.code == 1 and "Traceback" not in resumed.out, resumed.out
    assert "previous.ckpt: " in resumed.out and "Start a new run if the checkpoint is damaged" in resumed.out
