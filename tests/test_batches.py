"""Order of batches and noise of steps, which are the same for any number of workers, ranks and interruptions.

Run as a script, this file trains: the tests that need a process to be killed start it so.
"""

import gc
import json
import os
import random
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pytorch_lightning as pl
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.utils.data import Dataset

from framework.data import Batch, Data
from framework.datasets.fields import Fields, as_batch
from framework.distributions.noise import seed_step
from framework.errors import ConfigError, DataError
from framework.target import Target
from framework.training.batches import Batches, SeededBatches, epoch_order
from framework.training.checkpoint import WholeCheckpoints
from framework.training.module import LoadedBatches

SAMPLES = 165  # ten batches of 16, and a rest


class Sums(Data):
    """Data set of rows of numbers, with their sums as targets."""

    bibtex = ""

    def __init__(self, *, single: bool = False) -> None:
        self.target = Target("real", ("sum",))
        self.single = single

    def prepare(self) -> None: ...

    def train(self) -> Dataset[Batch]:
        generator = torch.Generator().manual_seed(1)
        rows = torch.randn(SAMPLES, 8, generator=generator)
        fields = Fields(input=rows, target=rows.sum(1, keepdim=True), index=torch.arange(SAMPLES))
        return Single(fields) if self.single else fields

    def validation(self) -> Dataset[Batch]:
        return self.train()

    def test(self) -> Dataset[Batch]:
        return self.train()

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        return Fields(input=torch.zeros(len(files), 8), index=torch.arange(len(files)))

    def augment(self, batch: Batch) -> Batch:
        return batch

    def fingerprint(self) -> Mapping[str, str]:
        return {}

    def preview(self, inputs: torch.Tensor) -> np.ndarray:
        return np.zeros((1, 1, 3), np.uint8)


class Single(Dataset[Batch]):
    """Data set with the same samples, without fetching whole batches at once."""

    def __init__(self, fields: Fields) -> None:
        self.fields = fields

    def __len__(self) -> int:
        return len(self.fields)

    def __getitem__(self, index: int) -> Batch:
        return self.fields[index]


# ------------------------------------------------------------------------------------------------ order

sizes = st.tuples(st.integers(1, 80), st.integers(1, 30), st.integers(1, 4)).filter(
    lambda size: size[2] <= min(size[:2])
)


@settings(deadline=None, max_examples=200)
@given(sizes, st.integers(0, 2**31 - 1), st.integers(0, 10**6), st.booleans())
def test_every_epoch_is_a_permutation_shared_among_the_ranks(
    size: tuple[int, int, int], seed: int, epoch: int, drop_last: bool
) -> None:
    length, batch_size, ranks = size
    shares = [
        list(
            SeededBatches(
                length,
                batch_size,
                position=lambda batches: (epoch, 0),
                seed=seed,
                drop_last=drop_last,
                rank=rank,
                ranks=ranks,
            )
        )
        for rank in range(ranks)
    ]
    assert len({len(share) for share in shares}) == 1, (
        "ranks that differ in batches wait for each other for ever"
    )
    assert all(batch for share in shares for batch in share)
    whole = [[*chain(*batch)] for batch in zip(*shares, strict=True)]
    seen = [*chain(*whole)]
    assert seen == epoch_order(length, seed, epoch)[: len(seen)]
    assert sorted(epoch_order(length, seed, epoch)) == list(range(length))
    if drop_last and length >= batch_size:
        assert {len(batch) for batch in whole} == {batch_size}
        assert length - len(seen) < batch_size
    else:
        assert len(seen) == length
        assert all(len(batch) == batch_size for batch in whole[:-1])
        assert len(whole[-1]) < batch_size + ranks
    assert len(whole) == len(SeededBatches(length, batch_size, seed=seed, drop_last=drop_last, ranks=ranks))


@settings(deadline=None, max_examples=50)
@given(sizes, st.integers(0, 2**31 - 1), st.integers(0, 100), st.integers(0, 3))
def test_models_that_train_together_each_have_an_order(
    size: tuple[int, int, int], seed: int, epoch: int, first: int
) -> None:
    """The first model has the order of a model that trains alone, also after a resumption within an epoch."""
    length, batch_size, orders = size

    def batches(**more: Any) -> list[list[int]]:
        first_one = {
            "position": lambda batches: (epoch, min(first, batches)),
            "seed": seed,
            "drop_last": True,
        }
        return list(SeededBatches(length, batch_size, **first_one, **more))

    alone, together = batches(), batches(orders=orders)
    assert len(together) == len(alone)
    parts = [
        [batch[start : start + len(one)] for start in range(0, len(batch), len(one))]
        for batch, one in zip(together, alone, strict=True)
    ]
    assert [part[0] for part in parts] == alone
    for member in range(orders):
        order = epoch_order(length, seed, epoch, member)
        assert sorted(order) == list(range(length))
        seen = [*chain(*(part[member] for part in parts))]
        assert seen == order[min(first, max(1, length // batch_size)) * batch_size :][: len(seen)]
    if length > 20:
        assert len({tuple(epoch_order(length, seed, epoch, member)) for member in range(3)}) == 3


@settings(deadline=None, max_examples=100)
@given(sizes, st.integers(0, 2**31 - 1), st.integers(0, 100), st.booleans(), st.data())
def test_starting_at_any_batch_continues_the_same_order(
    size: tuple[int, int, int], seed: int, epoch: int, drop_last: bool, data: st.DataObject
) -> None:
    length, batch_size, ranks = size
    first = 0
    batches = SeededBatches(
        length,
        batch_size,
        position=lambda batches: (epoch, first),
        seed=seed,
        drop_last=drop_last,
        rank=ranks - 1,
        ranks=ranks,
    )
    whole = list(batches)
    first = data.draw(st.integers(0, len(whole)))
    assert list(batches) == whole[first:]


def test_the_order_is_of_seed_and_epoch_alone() -> None:
    state = torch.get_rng_state()
    order = epoch_order(100, 3, 7)
    assert torch.equal(torch.get_rng_state(), state), "the global generator is not drawn from"
    torch.manual_seed(5)
    assert epoch_order(100, 3, 7) == order
    others = [epoch_order(100, seed, epoch) for seed, epoch in ((3, 8), (4, 7), (7, 3), (37, 0), (0, 37))]
    assert all(other != order for other in others)
    assert epoch_order(4, None, 9) == [0, 1, 2, 3]
    # So that a checkpoint can be continued by a later version, on another machine.
    assert epoch_order(8, 0, 0) == [2, 7, 6, 1, 5, 3, 0, 4]


def test_the_position_is_asked_for_at_the_first_batch_and_not_before() -> None:
    asked = []

    def position(batches: int) -> tuple[int, int]:
        asked.append(batches)
        return 0, 0

    batches = SeededBatches(10, 3, position=position, seed=0, drop_last=False)
    iter(batches)
    iterator = iter(batches)
    assert asked == []
    next(iterator)
    list(iterator)
    assert asked == [4]


def test_too_few_samples_are_refused() -> None:
    with pytest.raises(ConfigError, match="batch_size = 3 over 4 devices"):
        SeededBatches(10, 3, seed=0, drop_last=False, ranks=4)
    with pytest.raises(DataError, match="3 samples for 4 devices"):
        SeededBatches(3, 4, seed=0, drop_last=False, ranks=4)
    with pytest.raises(DataError, match="0 samples for 1 devices"):
        SeededBatches(0, 4, seed=0, drop_last=False)


# ---------------------------------------------------------------------------------------------- loaders


def indices(loader: Any) -> list[list[int]]:
    return [batch["index"].tolist() for batch in loader]


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("single", [False, True], ids=["batched", "single items"])
def test_loaders_give_every_sample_with_its_target(workers: int, single: bool) -> None:
    data = Sums(single=single)
    batches = Batches(data, batch_size=16, workers=workers, seed=3)
    batches.attach(pl.Trainer(accelerator="cpu", logger=False, enable_checkpointing=False))
    assert indices(batches.train_dataloader()) == list(
        SeededBatches(SAMPLES, 16, seed=3, drop_last=True, position=lambda batches: (0, 0))
    )
    for loader in (batches.val_dataloader(), batches.test_dataloader()):
        found = as_batch([batch for batch in loader for batch in unstacked(batch)])
        assert found["index"].tolist() == list(range(SAMPLES))
        whole = Sums().train()
        assert isinstance(whole, Fields)
        assert torch.equal(found["input"], whole.fields["input"])
        assert torch.equal(found["target"], whole.fields["target"])


def unstacked(batch: Batch) -> list[Batch]:
    return [{name: tensor[row] for name, tensor in batch.items()} for row in range(len(batch["index"]))]


def test_batched_fetching_asks_each_batch_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    fetch = Fields.__getitems__

    def counted(self: Fields, indices: Sequence[int]) -> Mapping[str, torch.Tensor]:
        asked.append(len(indices))
        return fetch(self, indices)

    monkeypatch.setattr(Fields, "__getitems__", counted)
    monkeypatch.delattr(Fields, "__getitem__")
    list(Batches(Sums(), batch_size=50, workers=0, seed=3).val_dataloader())
    assert asked == [50, 50, 50, 15]


def test_loading_draws_nothing_from_the_global_generator() -> None:
    state = torch.get_rng_state()
    batches = Batches(Sums(), batch_size=16, workers=0, seed=3)
    list(batches.val_dataloader())
    list(batches.of(Sums().test()))
    assert torch.equal(torch.get_rng_state(), state)


def test_the_order_without_a_trainer_is_refused() -> None:
    with pytest.raises(ConfigError, match="attach"):
        list(Batches(Sums(), batch_size=16, workers=0, seed=3).train_dataloader())


# ------------------------------------------------------------------------------------------------ noise


def draws() -> tuple[float, float, float]:
    return torch.rand(()).item(), float(np.random.rand()), random.random()  # noqa: NPY002


def test_noise_is_of_seed_stage_and_step_alone() -> None:
    seed_step(1, 2, "train")
    first = draws()
    draws()
    seed_step(1, 2, "train")
    assert draws() == first
    others = []
    for seed, step, stage, rank in (
        (1, 3, "train", 0),
        (2, 2, "train", 0),
        (1, 2, "test", 0),
        (1, 2, "train", 1),
        (12, 0, "train", 0),
        (2**31 - 1, 2**40, "train", 0),
    ):
        seed_step(seed, step, stage, rank)
        others.append(draws())
    assert all(a != b for other in others for a, b in zip(first, other, strict=True))


def test_where_cuda_is_in_use_its_generator_is_seeded_too(monkeypatch: pytest.MonkeyPatch) -> None:
    seeds: list[int] = []
    monkeypatch.setattr(torch.cuda, "manual_seed", seeds.append)
    seed_step(1, 2, "train")
    assert seeds == [], "nor initialised"
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    seed_step(1, 2, "train")
    assert seeds == [torch.default_generator.initial_seed()]


# --------------------------------------------------------------------------------------------- resuming


class Regression(pl.LightningModule):
    """Network with dropout and batch norm, so that a wrong seed, order or statistic changes the losses."""

    def __init__(self, folder: Path, stop: tuple[str, int, int] | None) -> None:
        super().__init__()
        self.folder = folder
        self.stop = stop
        torch.manual_seed(0)
        self.net = nn.Sequential(
            nn.Linear(8, 16), nn.BatchNorm1d(16), nn.ReLU(), nn.Dropout(0.3), nn.Linear(16, 1)
        )

    def loss(self, batch: Batch) -> torch.Tensor:
        return (self.net(batch["input"]).squeeze(-1) - batch["target"]).square().mean()

    def training_step(self, batch: Batch, batch_index: int) -> torch.Tensor:
        seed_step(0, 1000 * self.current_epoch + batch_index, "train")
        loss = self.loss(batch)
        self.record("train", batch_index, loss, batch)
        if self.stop is not None and self.stop[1:] == (self.current_epoch, batch_index):
            if self.stop[0] == "SIGKILL":
                os.kill(os.getpid(), signal.SIGKILL)
            raise RuntimeError("stopped")
        return loss

    def validation_step(self, batch: Batch, batch_index: int) -> None:
        self.record("validation", batch_index, self.loss(batch), batch)

    def record(self, stage: str, batch_index: int, loss: torch.Tensor, batch: Batch) -> None:
        row = [self.current_epoch, batch_index, loss.item().hex(), batch["index"].tolist()]
        with (self.folder / f"{stage}.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def configure_optimizers(self) -> Any:
        optimizer = torch.optim.AdamW(self.parameters(), 1e-2)
        return [optimizer], [
            {"scheduler": torch.optim.lr_scheduler.StepLR(optimizer, 7, 0.9), "interval": "step"}
        ]


def train(folder: Path, case: dict[str, Any], resume: Path | None) -> None:
    """Train 3 epochs of 10 batches; unless it is a resumption, stop at the step of the case."""
    folder.mkdir(parents=True)
    stop = None if resume or "whole" in folder.name else tuple(case.get("stop", ())) or None
    checkpoints = pl.callbacks.ModelCheckpoint(
        folder,
        every_n_train_steps=case.get("every", 5),
        save_top_k=0,
        save_last=True,
        save_on_exception=True,
    )
    trainer = pl.Trainer(
        **{"max_epochs": 3, **case.get("trainer", {}), **({} if resume else case.get("first", {}))},
        accelerator="cpu",
        logger=False,
        callbacks=[checkpoints],
        plugins=[WholeCheckpoints()],
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        num_sanity_val_steps=0,
    )
    batches = Batches(Sums(), batch_size=16, workers=case.get("workers", 0), seed=3)
    module = Regression(folder, stop)
    trainer.fit(module, datamodule=LoadedBatches(batches, trainer), ckpt_path=resume)
    weights = torch.cat([tensor.double().flatten() for tensor in module.state_dict().values()])
    (folder / "end.json").write_text(
        json.dumps([trainer.global_step, [value.hex() for value in weights.tolist()]])
    )


CASES: dict[str, dict[str, Any]] = {
    "mid-epoch": {"stop": ["SIGKILL", 1, 7]},
    "mid-epoch, 2 workers": {"stop": ["SIGKILL", 1, 7], "workers": 2},
    "checkpoint on an epoch's last batch": {"stop": ["SIGKILL", 2, 0]},
    "checkpoint on an epoch's last batch, 2 workers": {"stop": ["SIGKILL", 2, 0], "workers": 2},
    "first batch of the second epoch": {"stop": ["SIGKILL", 1, 2], "every": 11},
    # With workers the first batches are asked for before Lightning has set its counters right, so most cases
    # have them.
    "exception": {"stop": ["exception", 1, 7]},
    "exception, 2 workers": {"stop": ["exception", 1, 7], "workers": 2},
    "exception on an epoch's last batch": {"stop": ["exception", 1, 9], "workers": 2},
    "exception on an epoch's first batch": {"stop": ["exception", 2, 0], "workers": 2},
    "a part of each epoch": {"stop": ["SIGKILL", 2, 2], "workers": 2, "trainer": {"limit_train_batches": 7}},
    "a fraction of each epoch": {
        "stop": ["SIGKILL", 1, 2],
        "workers": 2,
        "trainer": {"limit_train_batches": 0.5},
    },
    "steps, not epochs": {
        "stop": ["SIGKILL", 2, 0],
        "workers": 2,
        "trainer": {"max_epochs": -1, "max_steps": 30},
    },
    "accumulated gradients": {
        "stop": ["SIGKILL", 1, 7],
        "every": 3,
        "workers": 2,
        "trainer": {"accumulate_grad_batches": 2},
    },
    "validation in mid-epoch": {
        "stop": ["SIGKILL", 1, 7],
        "workers": 2,
        "trainer": {"val_check_interval": 0.5},
    },
    "finished, then trained for longer": {"first": {"max_epochs": 2}, "workers": 2},
    "overfitting": {"stop": ["SIGKILL", 2, 1], "every": 2, "trainer": {"overfit_batches": 3}},
}


OFTEN = (
    "mid-epoch",
    "checkpoint on an epoch's last batch, 2 workers",
    "exception, 2 workers",
    "accumulated gradients",
    "overfitting",
)
"""Cases that are always tested; the others are slow tests."""


def main(folder: Path, names: Sequence[str]) -> None:
    """Run the named cases in forks of one process, so that Lightning is imported only once."""
    torch.set_num_threads(1)
    gc.freeze()  # so that collecting a fork's garbage copies none of these pages
    wholes: dict[str, Path] = {}
    for name in names:
        case, here = CASES[name], folder / name
        # Trainings that differ only in workers and where they stop share the uninterrupted one.
        key = json.dumps(case.get("trainer", {}))
        if key not in wholes:
            wholes[key] = here / "whole"
            forked(here / "whole", case, None)
        forked(here / "stopped", case, None)
        forked(here / "resumed", case, here / "stopped" / "last.ckpt")
        (here / "whole.json").write_text(json.dumps(str(wholes[key])))


def forked(folder: Path, case: dict[str, Any], resume: Path | None) -> None:
    process = os.fork()
    if process == 0:
        try:
            train(folder, case, resume)
        finally:
            os._exit(0)
    os.waitpid(process, 0)


Trainings = Callable[[str], Path]


@pytest.fixture(scope="module")
def trainings(once: Callable[[str, Callable[[Path], None]], Path]) -> Trainings:
    """Return a function that returns the folder of a case, after all cases that are tested with it have been run."""

    def trained(name: str) -> Path:
        names = [case for case in CASES if (case in OFTEN) == (name in OFTEN)]

        def train_all(folder: Path) -> None:
            command = [sys.executable, "-W", "ignore", __file__, str(folder), *names]
            subprocess.run(command, check=True, capture_output=True, timeout=900)

        return once(f"trainings, {len(names)}", train_all) / name

    return trained


def history(folder: Path, stage: str) -> list[Any]:
    return [json.loads(line) for line in (folder / f"{stage}.jsonl").read_text().splitlines()]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in OFTEN else pytest.mark.slow) for name in CASES]
)
def test_a_resumed_training_gives_the_bits_of_the_uninterrupted(name: str, trainings: Trainings) -> None:
    folder = trainings(name)
    whole = Path(json.loads((folder / "whole.json").read_text()))
    expected = history(whole, "train")
    before = history(folder / "stopped", "train")
    after = history(folder / "resumed", "train")
    assert before == expected[: len(before)]
    assert after == expected[len(expected) - len(after) :]
    assert len(before) + len(after) >= len(expected), "no batch was skipped"
    assert 0 < len(after) < len(expected), "it did resume"
    if CASES[name].get("stop", [""])[0] != "exception":
        # After an exception in mid-step batch norm has seen that batch twice, which only evaluation shows.
        assert (folder / "resumed" / "end.json").read_text() == (whole / "end.json").read_text()
        validations = history(folder / "resumed", "validation")
        expected = history(whole, "validation")
        assert validations == expected[len(expected) - len(validations) :]


def test_every_epoch_has_its_own_order_except_when_overfitting(trainings: Trainings) -> None:
    rows = history(trainings("mid-epoch") / "whole", "train")
    epochs = [[row[3] for row in rows if row[0] == epoch] for epoch in range(3)]
    assert all(len(set(chain(*epoch))) == 160 for epoch in epochs)
    assert epochs[0] != epochs[1] != epochs[2]
    rows = history(trainings("overfitting") / "whole", "train")
    epochs = [[row[3] for row in rows if row[0] == epoch] for epoch in range(3)]
    assert epochs[0] == epochs[1] == epochs[2]
    assert len(epochs[0]) == 3


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
