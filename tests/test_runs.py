"""Runs that finish, fail or are killed: no number is lost, and the next run continues at the same place."""

import json
import os
import re
import shlex
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from framework.configuration.composition import in_quotes
from framework.configuration.settings import Settings, store_experiment
from framework.runs.run import run_name
from framework.training.checkpoint import WholeCheckpoints
from tests.conftest import TINY, Done, Framework, listed, wait_for

QUIET = [*TINY, "logger=none"]


def status(done: Done) -> str:
    return json.loads((done.folder / "run.json").read_text(encoding="utf-8"))["status"]


def store_of(done: Done) -> Path:
    """Return the MLflow store of a run."""
    uri = json.loads((done.folder / "run.json").read_text(encoding="utf-8"))["uri"]
    return Path(uri.removeprefix("sqlite:///"))


def stored_statuses(done: Done) -> list[str]:
    """Return the status of every run in a store."""
    with closing(sqlite3.connect(store_of(done))) as store:
        return [status for (status,) in store.execute("select status from runs")]


def test_the_same_seed_gives_the_same_bits_and_another_seed_does_not(
    framework: Framework, whole: Done
) -> None:
    again = framework(*QUIET, "workers=2", "pictures=true", folder="again")
    other = framework(*QUIET, "seed=1", folder="other")
    assert again.code == 0, again.out
    assert again.losses() == whole.losses()
    assert len(again.losses()) == 27
    assert again.losses() != other.losses()
    results = [json.loads((done.folder / "results.json").read_text()) for done in (again, whole)]
    assert results[0]["log_likelihood"] == results[1]["log_likelihood"]


def test_another_run_in_a_used_folder_takes_nothing_of_the_earlier_one(
    framework: Framework, whole: Done, tmp_path: Path
) -> None:
    shutil.copytree(whole.folder, tmp_path / "used")
    other = [
        *QUIET,
        "encoder.mlp.widths=[8]",
        "+data.signal_at=2",
        f"+data.signal_marker={tmp_path / 'marker'}",
    ]
    killed = framework(*other, f"+data.signal_number={signal.SIGKILL.value}", folder="used")
    assert killed.code == -signal.SIGKILL
    assert not list(killed.folder.glob("checkpoints/*.ckpt"))
    assert not (killed.folder / "results.json").exists(), "it would be read as this run's"
    for name in ("checkpoints/model.ckpt", "results.json", "config.yaml"):
        assert (killed.folder / "earlier.1" / name).read_bytes() == (whole.folder / name).read_bytes()
    refused = framework("mode=predict", f"checkpoint={killed.folder}", "logger=none", folder="predicted")
    assert refused.code == 1, refused.out
    resumed = framework(f"resume={killed.folder}")
    assert resumed.code == 0, resumed.out
    assert "nothing to resume from yet" in resumed.out
    assert (killed.folder / "results.json").exists()
    again = framework(*QUIET, "resume=never", f"hydra.run.dir={killed.folder}", folder="used")
    assert again.code == 0, again.out
    assert again.losses() == whole.losses()
    assert (killed.folder / "earlier.2" / "results.json").exists()


@pytest.mark.parametrize("stray", ["RANK", "SLURM_PROCID"])
def test_a_stray_variable_makes_no_run_a_second_rank(framework: Framework, whole: Done, stray: str) -> None:
    done = framework(*QUIET, more={stray: "1"})
    assert done.code == 0, done.out
    assert done.losses() == whole.losses()
    assert (done.folder / "results.json").exists()


@pytest.mark.parametrize(
    ("workers", "at"),
    [
        pytest.param(2, 14, id="2 workers, mid-epoch"),
        pytest.param(0, 18, id="no workers, last batch"),
        pytest.param(0, 14, id="no workers, mid-epoch", marks=pytest.mark.slow),
        pytest.param(2, 18, id="2 workers, last batch", marks=pytest.mark.slow),
    ],
)
def test_a_killed_run_goes_on_with_the_same_bits(
    framework: Framework, whole: Done, tmp_path: Path, workers: int, at: int
) -> None:
    arguments = [
        *QUIET,
        f"workers={workers}",
        "trainer.checkpoint_every_steps=4",
        f"+data.signal_at={at}",
        f"+data.signal_marker={tmp_path / 'marker'}",
    ]
    killed = framework(*arguments)
    assert killed.code == -signal.SIGKILL
    wait_for(lambda: status(killed) == "KILLED")
    resumed = framework(f"resume={killed.folder}", f"workers={2 - workers}", "threads=1")
    assert resumed.code == 0, resumed.out
    assert "resuming from" in resumed.out
    assert killed.losses() == whole.losses()  # one journal holds both lives of the run
    assert status(killed) == "FINISHED"


STOPS = ["trainer.patience=1", "trainer.max_epochs=30", "optimizer.learning_rate=0.3"]
"""Settings of a run whose validation loss soon rises."""


@pytest.mark.parametrize("every", [1, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "further", [[], ["+trainer.min_epochs=16", "trainer.keep=last"]], ids=["stops", "goes on"]
)
def test_a_run_killed_after_it_stopped_early_trains_no_further(
    framework: Framework, tmp_path: Path, every: int, further: list[str]
) -> None:
    killed = framework(
        *(*QUIET, "pictures=true", *STOPS, *further, f"trainer.check_val_every_n_epoch={every}"),
        *("+data.signal_at=0", f"+data.signal_marker={tmp_path / 'marker'}"),
    )
    assert killed.code == -signal.SIGKILL, "in its pictures"
    told = re.compile(r"^stopped early at epoch \d+; kept the weights of epoch \d+\b.*$", re.MULTILINE)
    losses, results = killed.losses(), (killed.folder / "results.json").read_text()
    resumed = framework(f"resume={killed.folder}")
    assert resumed.code == 0, resumed.out
    assert killed.losses() == losses
    assert told.findall(resumed.out) == told.findall(killed.out) != []
    again = (killed.folder / "results.json").read_text()
    assert json.loads(again)["log_likelihood"] == json.loads(results)["log_likelihood"]
    for name in ("test/log_likelihood", "cost/milliseconds_per_sample"):
        assert list(killed.values(name)) == [0], "logged once"


def test_a_killed_run_still_knows_how_long_it_has_waited(framework: Framework, tmp_path: Path) -> None:
    """The run is killed in the epoch after its first validation without improvement; the second one would end it."""
    patient = [*QUIET, *STOPS, "trainer.patience=2"]
    whole = framework(*patient, folder="whole")
    assert whole.code == 0, whole.out
    validated = list(whole.values("validation/loss").items())
    worse = next(
        step for (step, loss), (_, before) in zip(validated[1:], validated, strict=False) if loss >= before
    )
    killed = framework(
        *patient,
        f"+data.signal_at={worse + 3}",
        f"+data.signal_marker={tmp_path / 'marker'}",
        folder="killed",
    )
    assert killed.code == -signal.SIGKILL
    resumed = framework(f"resume={killed.folder}")
    assert resumed.code == 0, resumed.out
    assert killed.losses() == whole.losses()


def test_a_rate_that_waits_for_the_validation_loss_goes_on_with_the_same_bits(
    framework: Framework, tmp_path: Path
) -> None:
    """The run is killed in the epoch after a reduction of the rate, when the last checkpoint is from the epoch
    before."""
    plateau = [
        "trainer.max_epochs=6",
        "optimizer.learning_rate=0.3",
        "optimizer.schedule=plateau",
        "optimizer.warmup_steps=0",
        "optimizer.patience=1",
        "optimizer.factor=0.5",
    ]
    whole = framework(*QUIET, *plateau, folder="whole")
    assert whole.code == 0, whole.out
    rates = whole.values("train/learning_rate")
    first = next(step for step in rates if rates[step] < 0.3)
    assert first % 9 == 1, "reduced between epochs, at once"
    signalled = [f"+data.signal_at={first + 3}", f"+data.signal_marker={tmp_path / 'marker'}"]
    killed = framework(*QUIET, *plateau, *signalled, folder="killed")
    assert killed.code == -signal.SIGKILL
    resumed = framework(f"resume={killed.folder}")
    assert resumed.code == 0, resumed.out
    assert killed.losses() == whole.losses()
    assert killed.values("train/learning_rate") == rates


def test_what_a_resumed_run_computes_is_not_changed(
    framework: Framework, whole: Done, tmp_path: Path
) -> None:
    shutil.copytree(whole.folder, tmp_path / "copy")
    done = framework(f"resume={tmp_path / 'copy'}", "threads=1", "batch_size=4")
    assert done.code == 2
    assert "batch_size=4 would change" in done.out
    assert "Only threads, workers, logger.uri, trainer.devices," in done.out


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130), (signal.SIGHUP, 129)]
)
def test_a_signal_saves_and_says_so(
    framework: Framework, whole: Done, tmp_path: Path, number: int, code: int
) -> None:
    arguments = [
        *QUIET,
        "+data.signal_at=14",
        f"+data.signal_number={int(number)}",
        f"+data.signal_marker={tmp_path / 'm'}",
    ]
    stopped = framework(*arguments)
    assert stopped.code == code, stopped.out
    assert status(stopped) == "KILLED"
    assert "resume=" in stopped.out
    content = torch.load(stopped.folder / "checkpoints" / "last.ckpt", weights_only=True)
    assert content["global_step"] == 14, "the batch in hand was finished and saved"
    assert "optimizer_states" in content
    best = stopped.folder / "checkpoints" / "best.ckpt"
    assert "optimizer_states" not in torch.load(best, weights_only=True), "nobody trains on from it"
    if number == signal.SIGINT:  # as version 0.1 left it, with the later ones damaged
        best.with_name("last.ckpt").replace(best)
        best.with_name("previous.ckpt").unlink()
    again = framework(*arguments)
    assert again.code == 0, again.out
    assert stopped.losses() == whole.losses()
    assert [path.name for path in best.parent.iterdir()] == ["model.ckpt"], (
        "a finished run keeps its model alone"
    )


@pytest.mark.parametrize(
    "name",
    [
        "it's é {x} \\",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("run", "lr=0.1,b=[2]", "50%25 'a'")),
    ],
)
def test_a_run_is_resumed_where_it_stopped_whatever_its_folder_is_called(
    framework: Framework, whole: Done, tmp_path: Path, name: str
) -> None:
    """The run continues even if it was started with resume=never."""
    stop = [
        "+data.signal_at=14",
        f"+data.signal_number={int(signal.SIGTERM)}",
        f"+data.signal_marker={tmp_path / 'm'}",
    ]
    folder = in_quotes(str(tmp_path / name))
    stopped = framework(*QUIET, *stop, "resume=never", f"hydra.run.dir={folder}", folder=name)
    assert stopped.code == 143, stopped.out
    (told,) = re.findall("python -m framework (resume=.*|'resume=.*)", stopped.out)
    resumed = framework(*shlex.split(told), folder=name)
    assert resumed.code == 0, resumed.out
    assert "resuming from" in resumed.out
    assert stopped.losses() == whole.losses()
    again = framework(f"resume={folder}", folder=name)
    assert again.code == 2
    assert "that run has finished" in again.out


def test_a_nan_label_stops_before_the_weights_are_touched(framework: Framework) -> None:
    done = framework(*TINY, "+data.bad_label=40")
    assert done.code == 1
    assert "The training loss became nan" in done.out
    assert "[40]" in done.out
    assert "Traceback" not in done.out
    assert stored_statuses(done) == ["FAILED"]


def test_a_damaged_checkpoint_is_named_and_the_one_before_is_taken(
    framework: Framework, whole: Done, tmp_path: Path
) -> None:
    arguments = [
        *QUIET,
        "trainer.checkpoint_every_steps=4",
        "+data.signal_at=14",
        f"+data.signal_marker={tmp_path / 'm'}",
    ]
    killed = framework(*arguments)
    last = killed.folder / "checkpoints" / "last.ckpt"
    content = bytearray(last.read_bytes())
    content[len(content) // 2] ^= 4
    last.write_bytes(content)
    tested = framework("mode=test", f"checkpoint={last}", "logger=none", folder="tested")
    assert tested.code == 1
    assert str(last) in tested.out
    assert "Traceback" not in tested.out
    resumed = framework(*arguments)
    assert resumed.code == 0, resumed.out
    assert "previous.ckpt" in resumed.out
    assert killed.losses() == whole.losses()


def test_a_checkpoint_of_another_model_is_refused(framework: Framework, whole: Done, tmp_path: Path) -> None:
    content = torch.load(whole.folder / "checkpoints" / "model.ckpt", weights_only=True)
    content["framework"]["config"]["encoder"][0]["widths"] = [32]
    changed = tmp_path / "changed.ckpt"
    WholeCheckpoints().save_checkpoint(content, changed)
    tested = framework("mode=test", f"checkpoint={changed}", "logger=none", folder="tested")
    assert tested.code == 1
    assert "belongs to another model" in tested.out
    assert "(16 instead of 32)" in tested.out


def test_a_stored_config_cannot_run_code(framework: Framework, whole: Done, tmp_path: Path) -> None:
    content = torch.load(whole.folder / "checkpoints" / "model.ckpt", weights_only=True)
    content["framework"]["config"]["density_head"]["_target_"] = "os.system"
    changed = tmp_path / "changed.ckpt"
    WholeCheckpoints().save_checkpoint(content, changed)
    tested = framework("mode=test", f"checkpoint={changed}", "logger=none", folder="tested")
    assert tested.code == 2
    assert "must not be able to run code" in tested.out


def test_test_and_predict_repeat_what_training_reported(framework: Framework) -> None:
    """The results are equal even if latent variables, dropout, medians and scores are random."""
    drawn = [
        "density_head=scvae",
        "density_head.samples=4",
        "encoder=[mlp]",
        "encoder.mlp.dropout=0.2",
        "seed=3",
    ]
    wrapped = ["uncertainty=[mc_dropout]", "uncertainty.mc_dropout.samples=2", "samples=20"]
    metrics = "metric=[log_likelihood,angular_deviation,crps]"
    trained = framework(
        *("data=dial", *drawn, *wrapped, metrics, "batch_size=16", "trainer.max_epochs=1", "logger=none"),
        "pictures=false",
    )
    assert trained.code == 0, trained.out

    def numbers(done: Done) -> dict[str, object]:
        assert done.code == 0, done.out
        model = re.search(r"framework\.load\('(.+)'\)", done.out)
        listed = re.search(r"run folder: .*\((.+)\)", done.out)
        assert model and (Path(model[1]) / "checkpoints" / "model.ckpt").is_file()
        assert listed and all((done.folder / name).exists() for name in listed[1].split(", "))
        found = json.loads((done.folder / "results.json").read_text())
        others = {"milliseconds", "memory", "folder", "columns", "better", "seconds"}
        return {key: value for key, value in found.items() if not any(word in key for word in others)}

    test = ("mode=test", f"checkpoint={trained.folder}", "logger=none", "pictures=false")
    wanted = numbers(trained)
    assert wanted["method"] == "scvae + mc_dropout"
    assert numbers(framework(*test, folder="tested")) == wanted
    smaller = numbers(framework(*test, "batch_size=7", folder="smaller"))
    assert smaller == wanted | {"batch_size": 7}
    alone = numbers(framework(*test, "metric=[crps]", folder="alone"))
    assert {key for key in alone if "crps" in key}
    assert {key: wanted[key] for key in alone} == alone, "what one metric draws depends on the others"
    other = numbers(framework(*test, "seed=4", folder="other"))
    assert all(other[key] != wanted[key] for key in alone if "crps" in key)

    points = []
    for folder in ("predicted", "again"):
        predict = ("mode=predict", f"checkpoint={trained.folder}", "logger=none")
        done = framework(*predict, f"workers={len(folder) % 2}", folder=folder)
        assert done.code == 0, done.out
        points.append((done.folder / "predictions.csv").read_text())
    assert points[0] == points[1]
    refused = framework(*predict, "batch_size=7", folder="refused")
    assert refused.code == 2 and "batch_size=7: mode=predict reads no batch_size" in refused.out
    rows = points[0].splitlines()
    assert rows[0] == "sample,needle_deg,entropy_nats"
    assert len(rows) == 49


def test_a_notebook_loads_a_run_without_hydra(whole: Done, stranger_site: Path) -> None:
    code = f"""
import sys, torch, framework
model = framework.load({str(whole.folder)!r})
density = model(torch.zeros(3, 2))
print(tuple(density.batch_shape), model.training, "hydra" in sys.modules, "mlflow" in sys.modules)
"""
    printed = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "PYTHONPATH": str(stranger_site)},
    )
    assert printed.stdout.split("\n")[-2] == "(3,) False False False", printed.stdout + printed.stderr


def test_a_run_imports_only_what_it_names_and_is_stored_with_all_it_needs_to_be_repeated(
    stranger_site: Path, tmp_path: Path
) -> None:
    run = f"hydra.run.dir={tmp_path / 'run'}"
    listing = listed(*TINY, "pictures=true", run, folder=tmp_path, site=stranger_site)
    assert listing.code == 0, listing.out
    plugins = {".".join(name.split(".")[1:3]) for name in listing.modules if name.startswith("plugins.")}
    assert plugins - {"encoder", "metric"} == {"encoder.mlp", "metric.log_likelihood", "metric.angular"}
    assert not {"mlflow", "numba", "trimesh", "sklearn", "kornia"} & {
        name.split(".")[0] for name in listing.modules
    }
    done = Done(0, listing.out, tmp_path / "run")
    assert stored_statuses(done) == ["FINISHED"], "another process has sent it"
    with closing(sqlite3.connect(store_of(done))) as store:
        steps = store.execute("select count(*) from metrics where key = 'train/loss'").fetchone()[0]
        tags = dict(store.execute("select key, value from tags").fetchall())
        parameters = dict(store.execute("select key, value from params").fetchall())
    assert steps == 27
    assert tags["data.synthetic"] == "true"
    assert tags["version.torch"] == torch.__version__
    assert tags["overrides"].startswith("data=dial")
    assert parameters["density_head.name"] == "wrapped_cauchy"


@pytest.mark.slow
def test_a_store_locked_while_training_costs_no_number(framework: Framework) -> None:
    first = framework(*TINY, "trainer.max_epochs=1", folder="first")
    assert first.code == 0, first.out
    store = sqlite3.connect(store_of(first), check_same_thread=False, isolation_level=None)
    store.execute("begin exclusive")
    released = threading.Timer(22, lambda: store.execute("rollback"))  # MLflow tries for 20 s
    released.start()
    try:
        second = framework(*TINY, folder="second")
    finally:
        released.join()
        store.close()
    assert second.code == 0, second.out
    with closing(sqlite3.connect(store_of(first))) as found:
        stored = found.execute(
            "select metrics.step, metrics.value from metrics join runs using (run_uuid) "
            "where metrics.key = 'train/loss' and runs.status = 'FINISHED' and runs.artifact_uri not like ?",
            (f"%{json.loads((first.folder / 'run.json').read_text())['run_id']}%",),
        ).fetchall()
    assert dict(stored) == second.losses()


@pytest.mark.parametrize("more", [(), ("debug=fast",)], ids=["whole", "short"])
def test_a_short_run_says_that_its_numbers_mean_little(framework: Framework, more: tuple[str, ...]) -> None:
    done = framework(*QUIET, *more)
    assert done.code == 0, done.out
    assert ("note: this is a short run" in done.out) == bool(more)


@pytest.mark.parametrize("every", [1, 2])
def test_a_log_shows_life_and_a_terminal_a_bar(framework: Framework, every: int) -> None:
    stopping = ("trainer.patience=1", "trainer.max_epochs=9", "optimizer.learning_rate=0.3")
    log = framework(*QUIET, *stopping, f"trainer.check_val_every_n_epoch={every}", folder="log").out
    lines = [line for line in log.splitlines() if line.startswith("epoch ")]
    number = r"-?[\d.e+-]+"
    for epoch, line in enumerate(lines, 1):  # a validation loss only after the epoch that it belongs to
        validated = f", validation loss {number}" if epoch % every == 0 else ""
        assert re.fullmatch(f"epoch {epoch} of 9: loss {number}{validated}", line), line
    ended = re.search(
        r"^stopped early at epoch (\d+); kept the weights of epoch (\d+), which have the lowest validation loss$",
        log,
        re.MULTILINE,
    )
    assert ended, log
    assert int(ended[1]) == len(lines) == int(ended[2]) + every
    losses = {
        epoch: float(line.rpartition(" ")[2])
        for epoch, line in enumerate(lines, 1)
        if "validation loss" in line
    }
    assert min(losses.values()) == losses[int(ended[2])]
    bar = framework(*QUIET, "trainer.max_epochs=2", folder="bar", more={"FORCE_COLOR": "1"}).out
    assert "━━━" in bar
    assert "epoch 2 of 2: loss" in bar
    assert "ended at epoch" in bar


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("encoder.mlp.widths=[0]", "encoder.mlp.widths.0 = 0"),
        ("+density_head.larges=0.5", "Did you mean 'largest'?"),
        ("density_head.largest=1.5", "density_head.largest = 1.5"),
        ("+trainer.max_step=3", "Did you mean 'max_steps'?"),
    ],
)
def test_a_wrong_key_or_value_is_said_before_any_data_is_read(
    framework: Framework, argument: str, message: str
) -> None:
    done = framework(*QUIET, argument)
    assert done.code == 2, done.out
    assert message in done.out
    assert "Traceback" not in done.out
    assert not done.folder.exists(), "a mistake is not a run"


def test_a_run_is_named_by_what_tells_it_from_its_neighbours() -> None:
    chosen = Settings(seed=3, experiment_name="faces/mixture")
    overrides = [
        "experiment=faces/mixture",
        "data.category=car",
        "threads=1",
        "+trainer.max_steps=5",
        "seed=3",
    ]
    assert run_name(chosen, "train", overrides) == "mixture, category=car, max_steps=5, seed=3"
    assert run_name(Settings(), "test", []) == "test, seed=0"
    assert store_experiment({"experiment_name": "faces/mixture"}) == "faces"
    assert store_experiment({"experiment_name": None, "logger": {"experiment": None}}) == "Default"
    assert store_experiment({"experiment_name": "a/b", "logger": {"experiment": "mine"}}) == "mine"


def test_predictions_of_a_folder_leave_out_what_is_no_input(framework: Framework, tmp_path: Path) -> None:
    from PIL import Image

    model = ("encoder=[biternion_vgg]", "density_head=von_mises", "metric=[log_likelihood]", "samples=10")
    small = ("debug=fast", "data=caviar", "data.image_size=32", "pictures=false", "threads=1", "logger=none")
    trained = framework(*small, *model, folder="trained")
    assert trained.code == 0, trained.out
    folder = tmp_path / "images"
    folder.mkdir()
    for name in ("one", "two"):
        Image.new("RGB", (30, 30), "red").save(folder / f"{name}.png")
    (folder / "broken.png").write_bytes(b"no picture")
    for name in ("README", "angles.csv", ".hidden.png"):
        (folder / name).write_text("file,gaze\none.png,3\n")
    predict = ("mode=predict", f"checkpoint={trained.folder}", f"mode.files={folder}", "logger=none")
    refused = framework(*predict, folder="predicted")
    assert refused.code == 1
    assert "broken.png" in refused.out
    (folder / "broken.png").rename(folder / "broken.webp")  # alone in its kind, which is one of pictures
    refused = framework(*predict, folder="predicted")
    assert refused.code == 1
    assert "broken.webp" in refused.out.partition("error: ")[2]
    (folder / "broken.webp").rename(folder / "broken.png")
    skip = ("data=caviar", "data.image_size=32", "data.skip_unreadable=true")
    done = framework(*predict, *skip, folder="predicted")
    assert done.code == 0, done.out
    assert "2 files ignored, because they are of another kind: README, angles.csv" in done.out
    assert (done.folder / "unreadable.txt").read_text() == f"{folder / 'broken.png'}\n"
    rows = (done.folder / "predictions.csv").read_text().splitlines()[1:]
    assert [row.partition(",")[0] for row in rows] == [str(folder / "one.png"), str(folder / "two.png")]


@pytest.mark.slow
def test_a_run_killed_while_it_was_closed_is_sent_by_resume(framework: Framework) -> None:
    done = framework(*TINY, "trainer.max_epochs=1")
    assert done.code == 0, done.out
    info = json.loads((done.folder / "run.json").read_text(encoding="utf-8"))
    with closing(sqlite3.connect(store_of(done))) as store:
        store.execute("update runs set status = 'RUNNING'")
        store.commit()
    (done.folder / "run.json").write_text(json.dumps({**info, "sent": info["sent"] - 2}), encoding="utf-8")
    resumed = framework(f"resume={done.folder}")
    assert resumed.code == 0, resumed.out
    assert "2 journal lines" in resumed.out
    assert stored_statuses(done) == ["FINISHED"]
    again = framework(f"resume={done.folder}")
    assert again.code == 2
    assert "that run has finished" in again.out


@pytest.mark.slow
def test_a_sweep_that_was_killed_closes_its_parent_when_it_is_repeated(
    stranger_site: Path, tmp_path: Path
) -> None:
    sweep = tmp_path / "outputs" / "sweep"
    arguments = ["-m", *TINY, "trainer.max_epochs=1", "seed=0", f"hydra.sweep.dir={sweep}"]
    command = [sys.executable, "-m", "framework", *arguments]
    options: dict[str, Any] = {
        "cwd": tmp_path,
        "env": {**os.environ, "PYTHONPATH": str(stranger_site), "FRAMEWORK_CACHE": str(tmp_path / "cache")},
        "stdout": subprocess.DEVNULL,
    }
    first = subprocess.Popen(command, **options)
    wait_for(lambda: (sweep / "0" / "journal.jsonl").exists())
    first.kill()
    first.wait()
    parent = Done(0, "", sweep)
    assert (status(parent), stored_statuses(parent)[0]) == ("RUNNING", "RUNNING")
    subprocess.run(command, check=True, timeout=300, **options)
    assert (status(parent), stored_statuses(parent)) == ("FINISHED", ["FINISHED", "FINISHED"])
    with closing(sqlite3.connect(store_of(parent))) as store:
        of_parent = "run_uuid not in (select run_uuid from tags where key = 'mlflow.parentRunId')"
        numbers = store.execute(f"select count(*) from metrics where {of_parent}").fetchone()
        (said,) = store.execute(
            f"select value from tags where key = 'mlflow.note.content' and {of_parent}"
        ).fetchone()
    assert numbers == (0,), "they would be charts of the parent alone"
    assert said.startswith(f"A sweep in `{sweep}`: 1 run over")
    assert "| method | data |" in said


def test_a_strangers_run_is_not_resumed_into_the_store_that_it_names(framework: Framework) -> None:
    killed = framework(*QUIET, "+data.signal_at=2", "+data.signal_number=9", "+data.signal_marker=marker")
    config = yaml.safe_load((killed.folder / "config.yaml").read_text(encoding="utf-8"))
    config["logger"] = {"name": "mlflow", "uri": "https://attacker.example", "experiment": None}
    (killed.folder / "config.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    resumed = framework(f"resume={killed.folder}")
    assert resumed.code == 2, resumed.out
    assert "If this is your store, add logger.uri=https://attacker.example" in resumed.out


def test_answers_that_are_not_finite_get_a_sentence(framework: Framework) -> None:
    """Half precision gives parameters that are not finite, because its largest number is 65,504."""
    done = framework(
        *("experiment=moons/vanilla_128", "debug=fast", "logger=none", "pictures=false"),
        *("trainer.precision=16-true", "optimizer.learning_rate=1e3"),
    )
    assert done.code == 1
    assert "The raw parameters are not finite in batch row" in done.out
    assert "trainer.precision=32-true" in done.out
    assert "Traceback" not in done.out


@pytest.mark.parametrize("fork", ["true", pytest.param("false", marks=pytest.mark.slow)])
def test_a_job_of_a_sweep_gives_the_bits_of_a_run_by_itself(
    framework: Framework, whole: Done, tmp_path: Path, fork: str
) -> None:
    sweep = ["seed=0,1", f"hydra.launcher.fork={fork}", "hydra.sweep.dir=sweep"]
    swept = framework("-m", *QUIET, *sweep, folder="sweep/0")
    assert swept.code == 0, swept.out
    assert swept.losses() == whole.losses()
    results = re.compile("^(?:epoch .* loss|ended at|.* ↑|.* ↓).*$", re.MULTILINE)
    of_job, alone = (
        [line for line in results.findall(output) if "ms / sample" not in line]
        for output in ((swept.folder / "console.log").read_text(encoding="utf-8"), whole.out)
    )
    assert of_job == alone
    assert len(alone) == 8  # three epochs, the end, and four results


@pytest.mark.parametrize("at", [2, 14])
def test_a_run_that_started_from_weights_goes_on_without_them(
    framework: Framework, whole: Done, tmp_path: Path, at: int
) -> None:
    """Once it has a checkpoint of its own."""
    shutil.copytree(whole.folder, tmp_path / "start")
    tuned = [*QUIET, f"checkpoint={tmp_path / 'start'}"]
    kill = [f"+data.signal_at={at}", "+data.signal_number=9", f"+data.signal_marker={tmp_path / 'marker'}"]
    if at == 14:
        kill.append("trainer.checkpoint_every_steps=3")
        tuned.append("trainer.checkpoint_every_steps=3")
    without = framework(*tuned, folder="without")
    assert without.code == 0, without.out
    killed = framework(*tuned, *kill)
    assert killed.code == -signal.SIGKILL
    shutil.rmtree(tmp_path / "start")
    resumed = framework(f"resume={killed.folder}")
    if at == 2:
        assert resumed.code == 1, resumed.out
        assert f"error: {tmp_path / 'start'}" in resumed.out
        return
    assert resumed.code == 0, resumed.out
    assert "resuming from" in resumed.out
    assert "starting a new training" not in resumed.out
    assert killed.losses() == without.losses()
