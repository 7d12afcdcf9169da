"""Damage files, read them in processes with bounded memory and time, and count the outcomes."""

import contextlib
import json
import mmap
import os
import re
import resource
import signal
import struct
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from framework.errors import UserError

SEED = 13
MEMORY = 2**30
"""Limit of the memory for reading one file, in addition to the memory of the process, bytes."""
SECONDS = 2.0
"""Limit of the processor time for reading one file, seconds."""
BLOCKED = 20.0
"""Time without progress after which a process counts as blocked, seconds."""
LONGEST_MESSAGE = 1500
OUT_OF_MEMORY = re.compile(
    r"not enough memory|unable to allocate|can't allocate|bad_alloc|out of memory", re.IGNORECASE
)
"""Messages of libraries that failed to allocate memory; an error made from such a message shows that no limit was
checked."""
CANARY = (16, 64, 256, 1024, 4096, 16384) * 8
"""Sizes of guard arrays, which only an access out of bounds can change."""
EXTREME = (
    0,
    1,
    2,
    0x7F,
    0xFF,
    0x7FFF,
    0xFFFF,
    10**6,
    10**9,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**40,
    2**63 - 1,
    2**64 - 1,
)
WORDS = (
    b"0",
    b"-1",
    b"1e9",
    b"1e308",
    b"nan",
    b"inf",
    b"2147483648",
    b"1000000000",
    b"99999999999999999999",
    b"x",
    b"",
)


class Silent(Exception):
    """Exception for a damaged file that was read without an error, but with other numbers."""


Damage = Callable[[bytes, np.random.Generator], bytes]


@dataclass(frozen=True)
class Reader:
    """A reader of ours.

    Attributes:
        name: of the format and who reads it.
        file: what the file is called.
        made: whole files, or what makes them.
        read: reads one, wholly.
        inner: damage that keeps what the format checks first (checksums, compression); used for half of the files.
        crafted: files that were made to do harm; read before the damaged ones.
        told: what a refusal must name; None: the file.
        optional: whether a pipe, a device or a folder in its place is left out, with a note.
        share: of the damaged files that are asked for; there are many readers of one kind.
        all_inner: whether each damage is one of the inner ones.
    """

    name: str
    file: str
    made: Sequence[bytes] | Callable[[], Sequence[bytes]]
    read: Callable[[Path], object]
    inner: Sequence[Damage] = ()
    crafted: Sequence[bytes] = ()
    told: str | None = None
    optional: bool = False
    share: float = 1.0
    all_inner: bool = False

    @property
    def samples(self) -> Sequence[bytes]:
        return self.made() if callable(self.made) else self.made


@dataclass
class Tally:
    """Counts of the outcomes of the files of one reader; `faults` holds the number and message of the first fault of
    each kind."""

    files: int = 0
    read: int = 0
    refused: int = 0
    unclean: int = 0
    silent: int = 0
    crashes: int = 0
    hangs: int = 0
    slowest: float = 0.0
    faults: list[tuple[int, str]] = field(default_factory=list)

    @property
    def bad(self) -> int:
        return self.unclean + self.silent + self.crashes + self.hangs


def damaged(reader: Reader, number: int) -> bytes:
    """Return file `number` of a reader, the same at every call; the crafted files come first."""
    if number < len(reader.crafted):
        return reader.crafted[number]
    random = np.random.default_rng([SEED, zlib.crc32(reader.name.encode()), number])
    whole = reader.samples[int(random.integers(len(reader.samples)))]
    if reader.inner and (reader.all_inner or random.random() < 0.5):
        return reader.inner[int(random.integers(len(reader.inner)))](whole, random)
    return spoilt(whole, random)


def spoilt(content: bytes, random: np.random.Generator) -> bytes:
    """Return the bytes with one to three random faults."""
    for _ in range(int(random.choice([1, 1, 2, 3]))):
        content = FAULTS[int(random.integers(len(FAULTS)))](content, random)
    return content


def _flipped(content: bytes, random: np.random.Generator) -> bytes:
    found = bytearray(content)
    for place in random.integers(0, max(len(found), 1), int(random.integers(1, 9))) if found else ():
        found[place] ^= 1 << int(random.integers(8))
    return bytes(found)


def _replaced(content: bytes, random: np.random.Generator) -> bytes:
    found = bytearray(content)
    for place in random.integers(0, max(len(found), 1), int(random.integers(1, 4))) if found else ():
        found[place] = int(random.integers(256))
    return bytes(found)


def _cut(content: bytes, random: np.random.Generator) -> bytes:
    return content[: int(random.integers(len(content) + 1))]


def _run(content: bytes, random: np.random.Generator) -> bytes:
    """Insert random bytes."""
    length = int(2 ** random.uniform(0, 12))
    kinds = (
        b"\0" * length,
        b"\xff" * length,
        random.bytes(length),
        b" 9" * (length // 2),
        b"(" * length,
        b"\n" * length,
    )
    place = int(random.integers(len(content) + 1))
    return content[:place] + kinds[int(random.integers(len(kinds)))] + content[place:]


def _field(content: bytes, random: np.random.Generator) -> bytes:
    """Replace a field of one to eight bytes, which may be a length, by another number."""
    width = int(random.choice([1, 2, 4, 8]))
    if len(content) < width:
        return content
    value = EXTREME[int(random.integers(len(EXTREME)))] % 256**width
    place = int(random.integers(len(content) - width + 1))
    if random.random() < 0.5:
        place -= place % width
    order = "little" if random.random() < 0.5 else "big"
    return content[:place] + value.to_bytes(width, order) + content[place + width :]


def _block(content: bytes, random: np.random.Generator) -> bytes:
    """Swap two blocks, repeat one block, or remove one block."""
    if len(content) < 4:
        return content
    a, b, c, d = np.sort(random.integers(0, len(content) + 1, 4)).tolist()
    kind = random.random()
    if kind < 0.4:
        return content[:a] + content[c:d] + content[b:c] + content[a:b] + content[d:]
    return content[:b] + (content[a:b] if kind < 0.7 else b"") + content[b if kind < 0.7 else c :]


def _word(content: bytes, random: np.random.Generator) -> bytes:
    """Replace a number in a text by another one, more often near the beginning, where counts stand."""
    within = len(content) if random.random() < 0.5 else min(len(content), 200)
    found = list(re.finditer(rb"-?\d+(\.\d+)?", content[:within]))
    if not found:
        return _flipped(content, random)
    one = found[int(random.integers(len(found)))]
    return content[: one.start()] + WORDS[int(random.integers(len(WORDS)))] + content[one.end() :]


FAULTS: tuple[Damage, ...] = (_flipped, _replaced, _cut, _run, _field, _field, _block, _word)


def fuzz(reader: Reader, count: int, folder: Path, first: int = 0) -> Tally:
    """Read the damaged files `first` to `count`, in forks of this process, which must not have started threads."""
    tally = Tally(files=count - first)
    shared = mmap.mmap(-1, 64)
    log = folder / "faults.jsonl"
    log.unlink(missing_ok=True)
    while first < count:
        child = os.fork()
        if child == 0:
            _child(reader, first, count, folder, shared, log)
        status = _waited(child, shared)
        number, *counts = struct.unpack_from("<5q", shared)
        (slowest,) = struct.unpack_from("<d", shared, 40)
        for name, found in zip(("read", "refused", "unclean", "silent"), counts, strict=True):
            setattr(tally, name, getattr(tally, name) + found)
        tally.slowest = max(tally.slowest, slowest)
        if status == 0:
            break
        killed = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
        hang = killed in (signal.SIGPROF, signal.SIGKILL)
        tally.hangs += hang
        tally.crashes += not hang
        what = signal.Signals(killed).name if killed else f"exit {status >> 8}"
        tally.faults.append((number, f"{'hangs' if hang else 'crashes'} ({what})"))
        first = number + 1
    if log.exists():
        tally.faults += [tuple(json.loads(line)) for line in log.read_text(encoding="utf-8").splitlines()]
    return tally


def _waited(child: int, shared: mmap.mmap) -> int:
    """Return the exit status of the child process, which is killed if it makes no progress."""
    before, since = -1, time.monotonic()
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return status
        (number,) = struct.unpack_from("<q", shared)
        if number != before:
            before, since = number, time.monotonic()
        elif time.monotonic() - since > BLOCKED:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.02)


def _child(reader: Reader, first: int, count: int, folder: Path, shared: mmap.mmap, log: Path) -> None:
    """Read files from number `first` on; never returns."""
    code = 1
    try:
        _limit()
        file = folder / reader.file
        counts, slowest, seen = [0, 0, 0, 0], 0.0, set()
        canary = [np.full(size, number, np.uint8) for number, size in enumerate(CANARY)]
        for number in range(first, count):
            struct.pack_into("<5q", shared, 0, number, *counts)
            struct.pack_into("<d", shared, 40, slowest)
            file.write_bytes(damaged(reader, number))
            before = time.process_time()
            signal.setitimer(signal.ITIMER_PROF, SECONDS)
            outcome, text = outcome_of(reader, file)
            signal.setitimer(signal.ITIMER_PROF, 0)
            slowest = max(slowest, time.process_time() - before)
            for value, array in enumerate(canary):
                if (array != value).any():
                    outcome, text = 3, "an array that has nothing to do with the file changed"
                    array.fill(value)
            counts[outcome] += 1
            key = re.sub(r"\d+", "0", text)[:60]
            if outcome >= 2 and key not in seen and len(seen) < 30:
                seen.add(key)
                with log.open("a", encoding="utf-8") as stream:
                    stream.write(json.dumps([number, text[:400]]) + "\n")
        struct.pack_into("<5q", shared, 0, count, *counts)
        struct.pack_into("<d", shared, 40, slowest)
        code = 0
    finally:
        os._exit(code)


def outcome_of(reader: Reader, file: Path) -> tuple[int, str]:
    """Return the outcome of reading a file, and its message. 0: read; 1: refused with a message that names the file;
    2: any other error; 3: other numbers."""
    try:
        reader.read(file)
    except UserError as error:
        text = str(error)
        wanted = reader.file if reader.told is None else reader.told
        if len(text) - len(str(file)) > LONGEST_MESSAGE:
            return 2, f"a message of {len(text)} characters: {text}"
        if not text.isprintable():
            return 2, f"a message with control characters: {text!r}"
        if wanted not in text:
            return 2, f"a message without the file: {text}"
        if wanted_memory(error):
            return 2, f"more than {MEMORY / 2**30:g} GiB: {text}"
        return 1, ""
    except Silent as error:
        return 3, str(error)
    except BaseException as error:
        frames = []
        trace = error.__traceback__
        while trace is not None:
            frames.append(f"{Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}")
            trace = trace.tb_next
        return 2, f"{type(error).__name__}: {error}"[:250] + f" at {' '.join(frames[-4:])}"
    return 0, ""


def wanted_memory(error: BaseException | None) -> bool:
    """Return whether an error comes from a failed allocation; a MemoryError of Python's parser only means too deep
    nesting."""
    while error is not None:
        trace = error.__traceback__
        while trace is not None and trace.tb_next is not None:
            trace = trace.tb_next
        parser = trace is not None and Path(trace.tb_frame.f_code.co_filename).name == "ast.py"
        if (isinstance(error, MemoryError) and not parser) or OUT_OF_MEMORY.search(str(error)):
            return True
        error = error.__cause__ or error.__context__
    return False


def _limit() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)


@contextlib.contextmanager
def scratch():
    """Yield a temporary folder, in memory if possible."""
    shm = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=shm if shm.is_dir() else None) as folder:
        yield Path(folder)


def replay(reader: Reader, number: int) -> None:
    """Read one damaged file in this process, to find the cause of a fault."""
    with scratch() as folder:
        (folder / reader.file).write_bytes(damaged(reader, number))
        sys.stdout.write(f"{reader.read(folder / reader.file)!r}\n"[:2000])
