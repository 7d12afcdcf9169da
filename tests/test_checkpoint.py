"""A checkpoint is whole or absent, whatever happens while it is written or lies on the disk."""

import errno
import hashlib
import multiprocessing
import os
import random
import shutil
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from torch.serialization import get_unsafe_globals_in_checkpoint

from framework.errors import CheckpointError
from framework.storage.checkpoints import latest_good, read, verify
from framework.storage.weights import describe_mismatch
from framework.training.checkpoint import WholeCheckpoints

CONTENTS: dict[str, Any] = {
    "state_dict": {f"layer{i}.weight": torch.linspace(-1, 1, 35 + i).reshape(-1, 1) for i in range(6)},
    "optimizer_states": [
        {"state": {0: {"step": torch.tensor(7.0)}}, "param_groups": [{"betas": (0.9, 0.999)}]}
    ],
    "epoch": 3,
    "framework": {"config": {"name": "a", "values": [1, 2.5, None, True, "κ"]}},
}


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "last.ckpt"
    WholeCheckpoints().save_checkpoint(CONTENTS, path)
    return path


def same(left: Any, right: Any) -> bool:
    if isinstance(left, torch.Tensor):
        return isinstance(right, torch.Tensor) and left.dtype == right.dtype and torch.equal(left, right)
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(same(left[key], right[key]) for key in left)
    if isinstance(left, list | tuple):
        return (
            type(left) is type(right)
            and len(left) == len(right)
            and all(same(a, b) for a, b in zip(left, right, strict=True))
        )
    return type(left) is type(right) and left == right


def test_what_is_saved_is_read(saved: Path) -> None:
    assert same(read(saved), CONTENTS)
    assert same(WholeCheckpoints().load_checkpoint(saved, weights_only=False), CONTENTS)
    assert verify(saved) is None
    assert [path.name for path in saved.parent.iterdir()] == ["last.ckpt"]


def test_other_programs_read_it_too(saved: Path) -> None:
    assert get_unsafe_globals_in_checkpoint(saved) == []
    assert same(torch.load(saved, weights_only=True), CONTENTS)


def test_the_bytes_depend_on_the_contents_alone(saved: Path, tmp_path: Path) -> None:
    other = tmp_path / "elsewhere" / "other-name.ckpt"
    WholeCheckpoints().save_checkpoint(CONTENTS, other)
    assert other.read_bytes() == saved.read_bytes()


def test_remove(saved: Path) -> None:
    WholeCheckpoints().remove_checkpoint(saved)
    WholeCheckpoints().remove_checkpoint(saved)
    assert not saved.exists()


def test_every_flipped_bit_is_refused(saved: Path, tmp_path: Path) -> None:
    whole = saved.read_bytes()
    damaged = tmp_path / "elsewhere" / "damaged.ckpt"
    damaged.parent.mkdir()
    chosen = random.Random(0)
    # All of the file, and more closely its end: the zip's directory and this framework's own trailer.
    bits = [chosen.randrange(8 * len(whole)) for _ in range(600)]
    bits += [chosen.randrange(8 * (len(whole) - 700), 8 * len(whole)) for _ in range(600)]
    for bit in bits:
        flipped = bytearray(whole)
        flipped[bit // 8] ^= 1 << bit % 8
        damaged.write_bytes(flipped)
        assert verify(damaged) is not None, f"bit {bit}"
        with pytest.raises(CheckpointError, match=r"damaged\.ckpt"):
            read(damaged)


def test_every_cut_is_refused(saved: Path, tmp_path: Path) -> None:
    whole = saved.read_bytes()
    for length in [*range(0, len(whole), 61), *range(len(whole) - 60, len(whole))]:
        saved.write_bytes(whole[:length])
        with pytest.raises(CheckpointError, match=r"last\.ckpt cannot be used: it is (empty|cut short)"):
            read(saved)
    saved.write_bytes(whole + b"\0")
    with pytest.raises(CheckpointError, match="cut short, or not a checkpoint"):
        read(saved)


def test_a_refusal_names_the_newest_whole_checkpoint_beside_it(saved: Path) -> None:
    with pytest.raises(
        CheckpointError, match=r"no checkpoint .*none\.ckpt\. Use .*last\.ckpt, the newest whole"
    ):
        read(saved.with_name("none.ckpt"))
    saved.write_bytes(b"")
    with pytest.raises(CheckpointError, match=r"last\.ckpt cannot .*it is empty\. No whole one .*train anew"):
        read(saved)
    with pytest.raises(CheckpointError, match="There is no checkpoint"):
        read(saved.parent / "no" / "folder.ckpt")


def test_latest_good_is_the_newest_that_verifies(tmp_path: Path) -> None:
    assert latest_good(tmp_path) is None
    assert latest_good(tmp_path / "missing") is None
    for age, name in ((30, "a.ckpt"), (20, "b.ckpt"), (10, "c.ckpt")):
        WholeCheckpoints().save_checkpoint(CONTENTS, tmp_path / name)
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    assert latest_good(tmp_path) == tmp_path / "c.ckpt"
    assert latest_good(tmp_path, names={"a.ckpt", "b.ckpt"}) == tmp_path / "b.ckpt"
    (tmp_path / "c.ckpt").write_bytes((tmp_path / "c.ckpt").read_bytes()[:-1])
    assert latest_good(tmp_path) == tmp_path / "b.ckpt"
    (tmp_path / "d.ckpt").mkdir()
    assert latest_good(tmp_path) == tmp_path / "b.ckpt"


def test_code_in_a_checkpoint_is_refused_unrun(saved: Path, tmp_path: Path) -> None:
    class Danger:
        def __reduce__(self) -> tuple[Callable[..., object], tuple[str]]:
            return os.mkdir, (str(tmp_path / "was run"),)

    torch.save({"state_dict": Danger()}, saved)
    with pytest.raises(CheckpointError, match="not a checkpoint of this framework"):
        read(saved)
    # A forger can write the checksum too.
    forged = saved.read_bytes()
    saved.write_bytes(forged + b"\nsha256 of above:" + hashlib.sha256(forged).digest())
    assert verify(saved) is None
    with pytest.raises(CheckpointError, match=r"could run code.*did not write it"):
        read(saved)
    assert not (tmp_path / "was run").exists()


def test_what_could_not_be_read_back_is_not_written(saved: Path) -> None:
    with pytest.raises(CheckpointError, match=r"pathlib\.PosixPath"):
        WholeCheckpoints().save_checkpoint({"folder": Path("a")}, saved)
    assert same(read(saved), CONTENTS)
    assert [path.name for path in saved.parent.iterdir()] == ["last.ckpt"]


class Usage(NamedTuple):
    total: int
    used: int
    free: int


@pytest.mark.parametrize(
    "contents",
    [
        CONTENTS,
        {"weights": torch.zeros(100_000)},
        {"view": torch.zeros(100_000)[:3]},
        {"small": [torch.tensor(float(i)) for i in range(500)]},
        {f"key {i}" * 10: ["text" * i, i, float(i)] for i in range(200)},
        {"numbers": [*range(10_000), *map(float, range(10_000)), *[2**40] * 10_000]},
        {"text": "κ" * 10_000, "bytes": b"0" * 10_000},
    ],
    ids=lambda contents: next(iter(contents)),
)
def test_a_disk_without_room_is_refused_before_writing(
    contents: dict[str, Any], saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    WholeCheckpoints().save_checkpoint(contents, saved.with_name("measured.ckpt"))
    size = saved.with_name("measured.ckpt").stat().st_size
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(10**9, 10**9 - size + 1, size - 1))
    with pytest.raises(CheckpointError, match=r"last\.ckpt needs .* MB free.*untouched"):
        WholeCheckpoints().save_checkpoint(contents, saved)
    assert same(read(saved), CONTENTS)
    # Room for twice as much is enough, and shared storage counts once.
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(10**9, 0, 2 * size + 50_000))
    WholeCheckpoints().save_checkpoint({**contents, "tied": contents}, saved)


def test_a_disk_that_fills_up_while_writing(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(CheckpointError, match=r"last\.ckpt needs .* MB free"):
        WholeCheckpoints().save_checkpoint({"epoch": 4}, saved)
    assert [path.name for path in saved.parent.iterdir()] == ["last.ckpt"]
    assert same(read(saved), CONTENTS)


FORK = multiprocessing.get_context("fork")


def kill_self(*args: object, **kwargs: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize(
    ("owner", "name", "survives"),
    [(torch, "save", "old"), (os, "fsync", "old"), (Path, "replace", "old"), (Path, "unlink", "new")],
    ids=["before writing", "before syncing", "before renaming", "after renaming"],
)
def test_killed_at_each_stage(owner: Any, name: str, survives: str, saved: Path) -> None:
    def save() -> None:
        setattr(owner, name, kill_self)
        WholeCheckpoints().save_checkpoint({"epoch": "new"}, saved)

    child = FORK.Process(target=save)
    child.start()
    child.join()
    assert child.exitcode == -signal.SIGKILL
    assert same(read(saved), CONTENTS if survives == "old" else {"epoch": "new"})
    WholeCheckpoints().save_checkpoint(CONTENTS, saved)
    assert [path.name for path in saved.parent.iterdir()] == ["last.ckpt"], "the part left behind is removed"


def test_killed_at_any_moment(tmp_path: Path) -> None:
    path = tmp_path / "last.ckpt"

    def save(started: Connection) -> None:
        for epoch in range(1_000_000):
            WholeCheckpoints().save_checkpoint(
                {"epoch": epoch, "a": torch.full((300_000,), epoch), "b": torch.full((300_000,), epoch)}, path
            )
            if epoch == 0:
                started.send("saved")

    moments = random.Random(0)
    for _ in range(10):
        started, sender = FORK.Pipe(duplex=False)
        child = FORK.Process(target=save, args=(sender,))
        child.start()
        sender.close()
        assert started.recv() == "saved"
        child.join(moments.uniform(0, 0.05))
        assert child.exitcode is None, "it saves until it is killed"
        child.kill()
        child.join()
        found = read(path)
        assert torch.equal(found["a"], torch.full((300_000,), found["epoch"]))
        assert torch.equal(found["b"], found["a"])
    assert len(list(tmp_path.iterdir())) <= 2, "at most the last one's part is left behind"


def test_another_process_in_the_middle_of_saving_is_left_alone(saved: Path) -> None:
    name = f".other.ckpt.{os.uname().nodename}.{os.getppid()}.partial"
    saved.with_name(name).write_bytes(b"")
    saved.with_name(".other.ckpt.elsewhere.1.partial").write_bytes(b"")
    WholeCheckpoints().save_checkpoint(CONTENTS, saved)
    assert len(list(saved.parent.iterdir())) == 3


def test_describe_mismatch() -> None:
    wanted = {"a": torch.zeros(2, 3), "b": torch.zeros(()), **{f"c{i}": torch.zeros(1) for i in range(9)}}
    assert describe_mismatch(wanted, dict(wanted)) is None
    assert describe_mismatch({}, {}) is None
    found = {"a": torch.zeros(3, 2), "b": torch.zeros(()), "d": torch.zeros(1)}
    assert describe_mismatch(wanted, found) == (
        "9 of 11 weights are missing: c0, c1, c2, c3, c4 and 4 more; "
        "1 of 3 weights found are unknown: d; "
        "1 of 11 weights have another shape: a (3×2, wanted 2×3)."
    )
    assert describe_mismatch({"b": torch.zeros(())}, {"b": torch.zeros(4)}) == (
        "1 of 1 weights have another shape: b (4, wanted scalar)."
    )
