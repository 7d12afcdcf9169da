"""Tests of checkpoints: a checkpoint is complete or absent, even after an interruption or damage on the disk."""

import errno
import hashlib
import io
import multiprocessing
import os
import pickle
import random
import shutil
import signal
import time
import zipfile
from collections import Counter, OrderedDict
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from torch import nn
from torch.serialization import get_unsafe_globals_in_checkpoint

from framework.errors import CheckpointError
from framework.storage import plain_tensors
from framework.storage.checkpoints import MARK, latest_good, read, verify
from framework.storage.weights import describe_mismatch, read_weights
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


def test_removing_a_removed_checkpoint_is_no_error(saved: Path) -> None:
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
        with pytest.raises(
            CheckpointError, match=r"last\.ckpt cannot be used: the file is (empty|cut short)"
        ):
            read(saved)
    saved.write_bytes(whole + b"\0")
    with pytest.raises(CheckpointError, match="cut short, or it is not a checkpoint"):
        read(saved)


def test_a_refusal_names_the_newest_whole_checkpoint_beside_it(saved: Path) -> None:
    with pytest.raises(
        CheckpointError, match=r"no checkpoint .*none\.ckpt\. Use .*last\.ckpt, the newest undamaged"
    ):
        read(saved.with_name("none.ckpt"))
    saved.write_bytes(b"")
    with pytest.raises(
        CheckpointError,
        match=r"last\.ckpt cannot .*the file is empty\. The folder of this checkpoint contains no undamaged",
    ):
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
    with pytest.raises(CheckpointError, match=r"could run code.*did not write the file"):
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
    with pytest.raises(CheckpointError, match=r"last\.ckpt needs .* MB free.*unchanged"):
        WholeCheckpoints().save_checkpoint(contents, saved)
    assert same(read(saved), CONTENTS)
    # Room for twice as much is enough, and shared storage counts once.
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(10**9, 0, 2 * size + 50_000))
    WholeCheckpoints().save_checkpoint({**contents, "tied": contents}, saved)


@pytest.mark.parametrize(
    ("number", "message"),
    [
        (errno.ENOSPC, r"last\.ckpt needs .* MB free.* Free some space"),
        (
            errno.EFBIG,
            r"last\.ckpt needs .* a limit of the system is smaller \(File too large\)\..*ulimit -f",
        ),
        (errno.EDQUOT, r"last\.ckpt needs .* a limit of the system is smaller \(.*quota.*\)\."),
    ],
)
def test_a_disk_that_fills_up_while_writing(
    saved: Path, monkeypatch: pytest.MonkeyPatch, number: int, message: str
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(CheckpointError, match=message):
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


def test_a_mismatch_counts_missing_unknown_and_misshaped_weights() -> None:
    wanted = {"a": torch.zeros(2, 3), "b": torch.zeros(()), **{f"c{i}": torch.zeros(1) for i in range(9)}}
    assert describe_mismatch(wanted, dict(wanted)) is None
    assert describe_mismatch({}, {}) is None
    found = {"a": torch.zeros(3, 2), "b": torch.zeros(()), "d": torch.zeros(1)}
    assert describe_mismatch(wanted, found) == (
        "9 of 11 weights are missing: c0, c1, c2, c3, c4 and 4 more; "
        "1 of 3 weights of the file are unknown: d; "
        "1 of 11 weights have another shape: a (3×2 instead of 2×3)."
    )
    assert describe_mismatch({"b": torch.zeros(())}, {"b": torch.zeros(4)}) == (
        "1 of 1 weights have another shape: b (4 instead of scalar)."
    )
    assert describe_mismatch({"a.b": torch.zeros(2)}, {"a.b": torch.zeros(4), "a.c": 1}, ("a.",)) is None


KINDS = (
    torch.float16,
    torch.bfloat16,
    torch.float32,
    torch.float64,
    torch.complex64,
    torch.complex128,
    torch.bool,
)
KINDS += (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)


@pytest.mark.parametrize("wanted", KINDS, ids=str)
def test_numbers_of_another_kind_do_not_fit(wanted: torch.dtype) -> None:
    """Another floating-point type is accepted; a complex number would lose its imaginary part, and an integer its
    digits."""
    for found in KINDS:
        for any_shape in ((), ("a",)):
            said = describe_mismatch(
                {"a": torch.zeros(2, dtype=wanted)}, {"a": torch.zeros(2, dtype=found)}, any_shape
            )
            if wanted == found or (wanted.is_floating_point and found.is_floating_point):
                assert said is None
            else:
                kinds = f"a ({str(found)[6:]} instead of {str(wanted)[6:]})"
                assert said == f"1 of 1 weights have numbers of another type: {kinds}."


def signed(content: bytes, path: Path) -> Path:
    """Write a forged checkpoint with a right checksum."""
    path.write_bytes(content + MARK + hashlib.sha256(content).digest())
    return path


def packed(content: Any) -> bytes:
    stream = io.BytesIO()
    torch.save(content, stream)
    return stream.getvalue()


class Subclass(torch.Tensor):
    """Torch stores its class."""


STRUCTURED: dict[str, Callable[[], Any]] = {
    "sparse COO": lambda: torch.eye(4).to_sparse_coo(),
    "sparse CSR": lambda: torch.eye(4).to_sparse_csr(),
    "sparse CSC": lambda: torch.eye(4).to_sparse_csc(),
    "sparse BSR": lambda: torch.eye(4).to_sparse_bsr((2, 2)),
    "sparse BSC": lambda: torch.eye(4).to_sparse_bsc((2, 2)),
    "nested": lambda: torch.nested.nested_tensor([torch.zeros(2), torch.zeros(3)]),
    "jagged": lambda: torch.nested.nested_tensor([torch.zeros(2), torch.zeros(3)], layout=torch.jagged),
    "quantised": lambda: torch.quantize_per_tensor(torch.eye(4), 0.1, 0, torch.qint8),
    "quantised by channel": lambda: torch.quantize_per_channel(
        torch.eye(4), torch.ones(4), torch.zeros(4), 0, torch.qint8
    ),
    "conjugate": lambda: torch.ones(3, dtype=torch.complex64).conj(),
    "negative": lambda: torch.ones(3, dtype=torch.complex64).conj().imag,
    "meta": lambda: torch.empty(9, device="meta"),
    "a subclass": lambda: torch.zeros(2).as_subclass(Subclass),
    "float8": lambda: torch.zeros(2, dtype=torch.float8_e4m3fn),
    "expanded": lambda: torch.zeros(1).expand(10**9),
    "expanded in part": lambda: torch.zeros(3, 1).expand(3, 1000),
    "overlapping": lambda: torch.zeros(3000).as_strided((1000, 1000), (1, 1)),
    "a storage": lambda: torch.zeros(2).untyped_storage(),
    "a module": lambda: torch.nn.Linear(2, 3),
    "a path": lambda: Path("a"),
    "bytes": lambda: bytearray(b"a"),
}
"""Objects that torch stores and that are not dense arrays of plain numbers, stored number by number."""


@pytest.mark.filterwarnings("ignore")  # of torch, about kinds of tensors that are beta or deprecated
@pytest.mark.parametrize("kind", STRUCTURED)
def test_only_dense_tensors_are_written_and_read(kind: str, saved: Path) -> None:
    held = STRUCTURED[kind]()
    with pytest.raises(CheckpointError, match=r"last\.ckpt was not written: .* Convert other values"):
        WholeCheckpoints().save_checkpoint({"a": [held]}, saved)
    assert same(read(saved), CONTENTS)
    content = packed({"a": [held]})
    with pytest.raises(
        CheckpointError, match=r"forged\.ckpt (contains more than .* tensors: |cannot be used: a has )"
    ):
        read(signed(content, saved.with_name("forged.ckpt")))
    saved.with_name("one.pth").write_bytes(content)
    with pytest.raises(CheckpointError, match=r"one\.pth (contains more than plain tensors|is damaged)"):
        read_weights(str(saved.with_name("one.pth")))


@pytest.fixture(params=["torch 2.13", "torch 2.11"])
def _reader_of_torch(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run a test with the reader of this torch, and with one that lacks the method that torch 2.11 lacks."""
    if request.param == "torch 2.13":
        return
    whole = torch._C.PyTorchFileReader  # pyright: ignore[reportAttributeAccessIssue]

    class Reader:
        def __init__(self, file: Any) -> None:
            reader = whole(file)
            self.get_all_records, self.get_record = reader.get_all_records, reader.get_record
            self.get_record_header_offset = reader.get_record_header_offset

    monkeypatch.setattr(plain_tensors, "_reader", Reader)


@pytest.mark.usefixtures("_reader_of_torch")
def test_whatever_is_plain_is_read_as_torch_reads_it(saved: Path) -> None:
    """Every type of numbers, views, shared storage, parameters, and the plain values beside them."""
    numbers = torch.arange(24.0).reshape(4, 6)
    kinds = (*KINDS, torch.uint16, torch.uint32, torch.uint64)
    contents = {
        "kinds": {str(kind): torch.ones(3, dtype=kind) for kind in kinds},
        "views": [
            numbers.T,
            numbers[1:, ::2],
            numbers[:0],
            numbers[3, 5],
            numbers,
            torch.zeros(1).expand(30, 30),
        ],
        "parameters": OrderedDict(a=nn.Parameter(numbers), b=torch.zeros(2, requires_grad=True)),
        "state": nn.BatchNorm1d(3).state_dict(),  # has attributes of its own
        "values": [
            None,
            True,
            2**100,
            -1.5,
            float("inf"),
            "\x1bκ",
            b"bytes" * 99,
            1j,
            {1, "a"},
            (1, (2,)),
            Counter("aab"),
        ],
        "torch's": [torch.Size([2, 3]), torch.float16, torch.device("cuda:1")],
    }
    WholeCheckpoints().save_checkpoint(contents, saved)
    found, wanted = read(saved), torch.load(saved, weights_only=True, map_location="cpu")
    assert same(found, wanted) and same(found, contents)
    assert found["state"]._metadata == contents["state"]._metadata
    assert (
        found["views"][0].untyped_storage().data_ptr()
        == found["parameters"]["a"].untyped_storage().data_ptr()
    )
    assert [view.stride() for view in found["views"]] == [view.stride() for view in contents["views"]]
    assert isinstance(found["parameters"]["a"], nn.Parameter) and found["parameters"]["b"].requires_grad


def call(name: str, *arguments: Any) -> bytes:
    """Return a pickle that calls a function with these arguments."""
    module, word = name.rsplit(".", 1)
    return b"\x80\x02c%s\n%s\n" % (module.encode(), word.encode()) + pickle.dumps(arguments, 2)[2:-1] + b"R."


HARMFUL = {
    "a storage of 1 TB": call("torch.storage.UntypedStorage", 10**12),
    "a tensor that nobody filled": call("torch.Tensor", 10**5, 10**5),
    "a tensor by its old name": call("torch.FloatTensor", 10**5, 10**5),
    "bytes of 1 TB": call("builtins.bytearray", 10**12),
    "bytes by a slow codec": call("_codecs.encode", "a" * 10**5, "punycode"),
    "the same bytes again and again": call("_codecs.encode", "a" * 10**6, "latin1")[:-2]
    + b"q\x01" + b"Rc_codecs\nencode\nh\x01R" * 5000 + b".",
    "a meta tensor": call("torch._utils._rebuild_meta_tensor_no_storage", torch.float32, (9,), (1,), False),
    "a call of a value": b"\x80\x02}(K\x01tR.",
    "a command": call("os.system", "true"),
    "a command by a later protocol": pickle.dumps(os.system, 4),
    "a command by the first protocol": b"(S'true'\nios\nsystem\n.",
    "nothing": b"",
}  # fmt: skip


@pytest.mark.parametrize("name", HARMFUL)
def test_what_a_pickle_calls_is_refused_before_it_is_called(name: str, saved: Path) -> None:
    for before in (b"}X\x01\x00\x00\x00a", b""):
        pickled = HARMFUL[name]
        if before:  # as a value of a dictionary, which a checkpoint is
            pickled = pickled[:2] + before + pickled[2:-1] + b"s."
        stream = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(packed({}))) as sound, zipfile.ZipFile(stream, "w") as forged:
            for part in sound.infolist():
                forged.writestr(
                    part.filename, pickled if part.filename.endswith("data.pkl") else sound.read(part)
                )
        began = time.process_time()
        with pytest.raises(CheckpointError, match=r"forged\.ckpt (contains more than|cannot be used)"):
            read(signed(stream.getvalue(), saved.with_name("forged.ckpt")))
        assert time.process_time() - began < 1


@pytest.mark.usefixtures("_reader_of_torch")
def test_an_archive_that_can_be_read_in_two_ways_is_refused(saved: Path) -> None:
    """The inspected pickle must be the one that torch reads: repeated names, preceding bytes, and an older format."""
    sound, other = packed(CONTENTS), packed({"other": torch.zeros(3).to_sparse()})
    twice = io.BytesIO(sound)
    with zipfile.ZipFile(twice, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("archive/data.pkl", b"}.")
    old = io.BytesIO()
    torch.save({"a": torch.zeros(3).to_sparse()}, old, _use_new_zipfile_serialization=False)
    for content in (
        twice.getvalue(),
        other + sound,
        old.getvalue() + sound,
        b"PK\x03\x04" + sound,
        sound[:-22] + sound[-44:],
    ):
        with pytest.raises(CheckpointError, match=r"forged\.ckpt (contains more than|cannot be used)"):
            read(signed(content, saved.with_name("forged.ckpt")))
