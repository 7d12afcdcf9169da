"""Training with several ranks, which gives the noise, statistics and numbers of one process, and one record."""

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from framework.training.ranks import Share, WholeBatch
from tests.conftest import TINY, Done, Forks, Framework, command, paths_again
from tests.fuzz.kills import differences, status
from tests.test_kills import Lives

TWO = ("trainer=ddp", "trainer.devices=2", "trainer.accelerator=cpu")
QUIET = ("logger=none", "pictures=false")
DRAWS: dict[str, Callable[[Tensor], Tensor]] = {
    "rand": lambda x: torch.rand(len(x), 5),
    "rand of a list": lambda x: torch.rand([4, len(x)]),
    "randn in float64": lambda x: torch.randn((3, len(x), 2), dtype=torch.float64),
    "rand_like": torch.rand_like,
    "randn_like": torch.randn_like,
    "randint": lambda x: torch.randint(10, (len(x),)),
    "randint from low": lambda x: torch.randint(3, 10, size=(len(x),)),
    "normal": lambda x: torch.normal(x, torch.ones_like(x)),
    "bernoulli": lambda x: torch.bernoulli(x.sigmoid()),
    "uniform_": lambda x: torch.empty(len(x), 4).uniform_(-1, 1),
    "exponential_": lambda x: torch.empty(len(x)).exponential_(),
    "dropout": lambda x: F.dropout(x, 0.3),
    "alpha_dropout": lambda x: F.alpha_dropout(x, 0.3, training=True),
    "dropout1d": lambda x: F.dropout1d(x[..., None].expand(-1, -1, 3), 0.5),
    "a distribution": lambda x: torch.distributions.Normal(x, 2.0).rsample(),
}


@pytest.mark.parametrize("name", DRAWS)
def test_a_rank_draws_the_rows_that_one_process_would_give_it(name: str) -> None:
    inputs = torch.randn(23, 19, generator=torch.Generator().manual_seed(1))
    torch.manual_seed(5)
    whole = DRAWS[name](inputs)
    axis = whole.shape.index(23)
    for start, count in ((0, 11), (11, 12)):
        torch.manual_seed(5)
        with WholeBatch(Share(start, count, 23)):
            part = DRAWS[name](inputs[start : start + count])
        torch.testing.assert_close(part, whole.narrow(axis, start, count), rtol=0, atol=0)


def test_what_has_no_dimension_of_the_batch_is_the_same_on_all_ranks() -> None:
    torch.manual_seed(5)
    whole = torch.randn(7)
    torch.manual_seed(5)
    with WholeBatch(Share(11, 12, 23)):
        assert torch.equal(torch.randn(7), whole)
        assert torch.equal(F.dropout(torch.ones(12, 3), 0.5, training=False), torch.ones(12, 3))


STEPS = (*TINY, *QUIET, *TWO, "trainer.checkpoint_every_steps=1")


@pytest.fixture(scope="module")
def whole_of_two(forks: Forks, stranger_site: Path, tmp_path_factory: pytest.TempPathFactory) -> Done:
    """Train with two ranks without an interruption."""
    done = command(forks, stranger_site, tmp_path_factory.mktemp("two"))(*STEPS)
    assert done.code == 0, done.out
    return done


def numbers(done: Done, prefix: str) -> dict[str, float]:
    """Return the numbers of a run by name and step, from its journal."""
    found = {}
    for line in (done.folder / "journal.jsonl").read_text(encoding="utf-8").splitlines():
        record = json.loads(line)
        for key, value in record.get("values", {}).items():
            if key.startswith(prefix):
                found[f"{key} {record['step']}"] = float(value)
    return found


SAME = {
    "moons/vanilla_128": ("experiment=moons/vanilla_128", "trainer.max_epochs=2", "trainer.check_val_every_n_epoch=1"),
    # augmentation, dropout, batch norm, and batches that two ranks cannot halve; a small rate, since training amplifies
    # what two orders of summation round differently
    "pascal3d/von_mises": (
        "experiment=pascal3d/von_mises", "debug=fast", "batch_size=15", "trainer.log_every_steps=1",
        "optimizer.learning_rate=1e-4",
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    "name", ["moons/vanilla_128", pytest.param("pascal3d/von_mises", marks=pytest.mark.slow)]
)
def test_two_ranks_give_the_numbers_of_one_process(name: str, framework: Framework) -> None:
    one = framework(*SAME[name], *QUIET, "threads=1", folder="one")
    two = framework(*SAME[name], *QUIET, *TWO, folder="two")
    assert (one.code, two.code) == (0, 0), one.out + two.out
    for prefix in ("train/", "validation/", "test/"):
        wanted, found = numbers(one, prefix), numbers(two, prefix)
        assert wanted
        assert found.keys() == wanted.keys()
        for key, value in wanted.items():
            assert found[key] == pytest.approx(value, rel=2e-4, abs=1e-5, nan_ok=True), key
    results = [json.loads((done.folder / "results.json").read_text(encoding="utf-8")) for done in (one, two)]
    assert results[0].keys() == results[1].keys()
    assert "GLOBAL_RANK" not in two.out
    assert two.out.count("run folder:") == 2, "the first rank alone speaks: at the start and at the end"


KILLS = {
    "1|start|SIGKILL": "KILLED",  # the first waits for it
    "1|before the first step|SIGTERM": "KILLED",
    "1|between epochs|error": "FAILED",
    "0|in a checkpoint|SIGKILL": "KILLED",
    "1|collective|SIGKILL": "KILLED",
    "0|testing|SIGKILL": "KILLED",
}
"""Status of the run after a rank ended, by rank, moment and cause."""


@pytest.mark.slow
def test_a_rank_that_dies_ends_the_others_and_the_run_goes_on_to_the_same_bits(
    whole_of_two: Done, stranger_site: Path, tmp_path: Path
) -> None:
    lives = Lives(STEPS, tmp_path, stranger_site)
    for kill, wanted in KILLS.items():
        assert lives(kill) != 0
        assert status(lives.folder) == wanted, kill
    assert lives() == 0, lives.output()
    assert differences(lives.folder, whole_of_two.folder) == []
    said = lives.output()
    assert said.count("resuming from") == len(KILLS) - 2, "there was no checkpoint at the first three"
    assert said.count("Rank 1 of the training failed (exit code 1)") == 1


@pytest.mark.slow
def test_ranks_that_were_stopped_go_on_under_another_launcher_to_the_same_bits(
    whole_of_two: Done, framework: Framework, stranger_site: Path, tmp_path: Path
) -> None:
    marker = tmp_path / "marker"
    stop = ("+data.signal_at=14", "+data.signal_number=9", f"+data.signal_marker={marker}")
    broken = framework(*STEPS, *stop, folder="broken")
    assert broken.code != 0
    assert marker.exists()
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    environment = {**os.environ, "PYTHONPATH": str(stranger_site), "OMP_NUM_THREADS": "1"}
    resume = f"resume={broken.folder}"
    done = subprocess.run(
        [*launch, "-m", "framework", resume, *paths_again([resume])],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert (done.stdout + done.stderr).count("resuming from") == 1
    wanted, found = (numbers(done, "") for done in (whole_of_two, broken))
    exact = [key for key in wanted if not key.startswith("cost/")]
    assert len(exact) > 30
    assert {key: repr(found[key]) for key in exact} == {key: repr(wanted[key]) for key in exact}


def test_a_loss_that_is_not_finite_stops_all_ranks_with_one_sentence(framework: Framework) -> None:
    done = framework(*TINY, *QUIET, *TWO, "+data.bad_label=3")
    assert done.code == 1, done.out
    # one sentence for each rank; a rank that is ended because the other one has failed may print none
    assert done.out.count("The training loss became nan") in (1, 2)
    assert "samples [3] of the training split" in done.out
    info = json.loads((done.folder / "run.json").read_text(encoding="utf-8"))
    assert info["status"] == "FAILED"
    assert not math.isnan(info["started"])
