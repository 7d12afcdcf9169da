"""Journal of a run: the local file to which every number is written first."""

import json
import logging
import os
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

from framework.errors import DataError
from framework.storage.enclosed import open_plain, read_stream
from framework.storage.files import lock_within, replacing
from framework.storage.plain_values import is_number
from framework.storage.reading import translate_errors

_log = logging.getLogger(__name__)
# json.dumps with options builds a new encoder at each call; this encoder is built once.
_encode = json.JSONEncoder(separators=(",", ":"), allow_nan=False).encode
_NO_NUMBERS = ("nan", "inf", "-inf")
_BLOCK = 1 << 20  # bytes read at a time, which limits the memory of a reader that is far behind
_PATIENCE = 2.0  # seconds to wait for a process that is closing the run of a killed process (`ended`)
LARGEST, LONGEST = 1 << 30, 1 << 24
"""Largest size in bytes of a journal (about seven million lines) and of one line; `Journal` never writes more."""


@dataclass(frozen=True)
class Line:
    """Metrics that one call of `Journal.write` recorded: `values` by name, and `time` in seconds since 1970."""

    time: float
    step: int
    epoch: int
    values: dict[str, float]


class Journal:
    """Append-only file of JSON lines that survives a crash of its process.

    Every line has a number `n`, which grows by one and is never used twice, not even after `drop_after`. So one
    number suffices to say which lines are stored elsewhere: all up to this number. Lines of metrics contain `time`,
    `step`, `epoch` and `values`; a value that is not finite is the string "nan", "inf" or "-inf". Other lines contain
    the arguments of `append`.

    When `write` returns, the operating system has received the line, so the line survives SIGKILL. A thread syncs it to
    the disk within about a second, and from then on the line survives a power cut. A full disk does not stop the run:
    lines wait in memory until there is free space again.

    The first `write`, `append` or `drop_after` makes this process the only writer until `close`, and removes an
    incomplete last line that a crash has left. Reading changes nothing and is possible at any time, from any process.

    Args:
        path: Path of the file, which need not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.last = 0
        """Number of the newest line; 0 until the file is open for writing."""
        self._lock = threading.RLock()
        self._file = -1  # descriptor of the journal; -1 while it is not open for writing
        self._owner = -1  # descriptor of the lock file, whose content is the number of the writing process
        self._waiting = bytearray()  # bytes for which the disk had no room
        self._place = (0, 0)  # (n, byte offset behind line n) at which the last read ended
        self._rewritten = 0  # how often the file was replaced, which makes earlier offsets invalid
        self._unsynced = threading.Event()
        self._closing = threading.Event()
        self._syncer: threading.Thread | None = None

    def write(self, values: Mapping[str, float], step: int, epoch: int) -> None:
        """Append one line of metrics: `values` by name, with the optimiser step and the epoch.

        Raises:
            DataError: The file cannot be opened, or another process writes it; only the first call raises this.
        """
        with self._lock:
            self.open()
            self.last += 1
            # The training loop calls this method, and this formatting takes half the time of the JSON encoder.
            pairs = ",".join(
                [f"{_json_name(name)}:{_number_or_name(value)}" for name, value in values.items()]
            )
            self._write_line(
                f'{{"n":{self.last},"time":{time.time():.3f},"step":{int(step)},"epoch":{int(epoch)},'
                f'"values":{{{pairs}}}}}'
            )

    def append(self, **record: Any) -> None:
        """Append a line of plain JSON values other than metrics.

        Raises:
            DataError: The file cannot be opened, or another process writes it; only the first call raises this.
        """
        with self._lock:
            self.open()
            self.last += 1
            self._write_line(_encode({"n": self.last, "time": round(time.time(), 3), **record}))

    def read(self, after: int = 0) -> list[dict[str, Any]]:
        """Return the next lines whose number is greater than `after`, about a mebibyte at most; [] if there are none.

        An incomplete last line is left out, and damaged lines are skipped with a warning. If `after` is the number of
        the last line that the previous call returned, the call reads only the part of the file after this line.
        """
        with self._lock:
            position, offset = self._place
            if position != after:
                offset = 0
            rewritten = self._rewritten
            if not os.path.lexists(self.path):
                return []
            with translate_errors(self.path, "a journal"):
                # the descriptor still leads to the old file if drop_after replaces the file in the meantime
                file = read_stream(self.path)
        records: list[dict[str, Any]] = []
        with file:
            file.seek(offset)
            while not records and (block := _whole_lines(file)):
                offset += len(block)
                records = self._parse(block, after)
        with self._lock:
            if rewritten == self._rewritten:
                self._place = (records[-1]["n"] if records else after, offset)
        return records

    def lines(self) -> Iterator[Line]:
        """Yield all metrics in order, with NaN and infinities converted back to floats."""
        after = 0
        while records := self.read(after):
            for record in records:
                if "values" in record:
                    values = {name: float(value) for name, value in record["values"].items()}
                    yield Line(record["time"], record["step"], record["epoch"], values)
            after = records[-1]["n"]

    def drop_after(self, step: int) -> int:
        """Remove the metrics of steps after `step`, and return the number of removed lines.

        A run that is resumed from `step` repeats these steps. The file is replaced atomically, and a line
        `{"resumed_after": step}` records the removal.

        Raises:
            DataError: The file cannot be opened, or another process writes it; only the first call raises this.
            OSError: The disk is full; the file is unchanged.
        """
        with self._lock:
            self.open()
            self._flush()
            dropped = 0
            marker = {"n": self.last + 1, "time": round(time.time(), 3), "resumed_after": int(step)}
            with (
                replacing(self.path) as partial,
                partial.open("xb") as shortened,
                read_stream(self.path) as file,
            ):
                while line := file.readline(LONGEST):
                    record = _record(line)
                    if record is not None and record.get("step", step) > step:
                        dropped += 1
                    else:
                        # only lines that were parsed are removed, so damaged lines are copied too
                        shortened.write(line)
                shortened.write(_encode(marker).encode() + b"\n")
            self.last += 1
            self._reopen()
            return dropped

    def set_aside(self, path: Path) -> None:
        """Rename the file to `path` and begin a new one.

        Raises:
            DataError: The file cannot be opened, or another process writes it; only the first call raises this.
        """
        with self._lock:
            self.open()
            self._flush()
            self.path.replace(path)
            self.last = 0
            self._reopen()

    def open(self, after: int = 0) -> None:
        """Make this process the only writer; do nothing if it already is.

        Args:
            after: Number of the last line that is stored elsewhere; a power cut may have removed it from the file.

        Raises:
            DataError: The file cannot be opened, or another process writes it.
        """
        if self._file >= 0:
            return
        with self._lock:
            try:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self._owner = _lock_for_writing(self.path)
                self.last = max(self._remove_incomplete_line(), after)
                self._file = _append_to(self.path)
            except OSError as error:
                if self._owner >= 0:
                    os.close(self._owner)
                    self._owner = -1
                raise DataError(
                    f"The journal {self.path} cannot be written ({error.strerror}). Choose a run folder that can be "
                    "written, or free some space."
                ) from error
            self._closing.clear()
            self._syncer = threading.Thread(target=self._sync_every_second, name="journal", daemon=True)
            self._syncer.start()

    def close(self) -> None:
        """Sync the file to the disk and let other processes write; a later `write` opens the file again."""
        with self._lock:
            syncer, self._syncer = self._syncer, None
        if syncer is None:
            return
        self._closing.set()
        self._unsynced.set()
        syncer.join()
        with self._lock:
            self._flush()
            if self._waiting:
                lost = self._waiting.count(b"\n")
                _log.error("The last %d lines of %s are lost, because the disk is full.", lost, self.path)
                self._waiting.clear()
            self._sync(self._file)
            os.close(self._file)
            os.close(self._owner)
            self._file = self._owner = -1

    def _write_line(self, text: str) -> None:
        data = text.encode() + b"\n"
        if self._waiting:
            self._waiting += data
            self._flush()
            return
        fault = "the disk is full"
        try:
            written = os.write(self._file, data)
        except OSError as error:
            written, fault = 0, str(error.strerror)
        if written < len(data):
            _log.warning(
                "%s cannot be written (%s). The run continues and keeps its numbers in memory until there is space.",
                self.path,
                fault,
            )
            self._waiting += data[written:]
        if not self._unsynced.is_set():
            self._unsynced.set()

    def _flush(self) -> None:
        while self._waiting:
            try:
                written = os.write(self._file, self._waiting)
            except OSError:
                return
            del self._waiting[:written]
            self._unsynced.set()

    def _reopen(self) -> None:
        before, self._file = self._file, _append_to(self.path)
        os.close(before)
        self._rewritten += 1
        self._place = (0, 0)

    def _sync_every_second(self) -> None:
        while not self._closing.is_set():
            self._unsynced.wait()
            self._unsynced.clear()
            with (
                self._lock
            ):  # a descriptor of its own is needed, because `drop_after` may close the first one
                descriptor = os.dup(self._file)
            self._sync(descriptor)
            os.close(descriptor)
            self._closing.wait(1.0)

    def _sync(self, descriptor: int) -> None:
        try:
            os.fsync(descriptor)
        except OSError as error:
            _log.warning("%s could not be synced to its disk: %s.", self.path, error.strerror)

    def _remove_incomplete_line(self) -> int:
        """Remove an incomplete last line, and return the number of the last complete line."""
        if not os.path.lexists(self.path):
            return 0
        with os.fdopen(open_plain(self.path, os.O_RDWR), "r+b") as file:
            size = os.fstat(file.fileno()).st_size
            if size > LARGEST:
                raise DataError(
                    f"The journal {self.path} has {size:,} bytes, but at most {LARGEST:,} are read. Rename the file; "
                    "the run then begins a new journal."
                )
            start = max(0, size - 2 * LONGEST)
            file.seek(start)
            content = file.read()
            end = content.rfind(b"\n") + 1
            if end < len(content) and (end or not start):
                incomplete_bytes = len(content) - end
                _log.warning(
                    "Cut off an unfinished last line (%d bytes) of %s, left by a crash.",
                    incomplete_bytes,
                    self.path,
                )
                file.truncate(start + end)
        while end > 0:
            line = content.rfind(b"\n", 0, end - 1) + 1
            record = _record(content[line:end])
            if record is not None:
                return record["n"]
            end = line
        if start:
            raise DataError(
                f"The journal {self.path} has no readable line in its last {size - start:,} bytes. Rename the file; "
                "the run then begins a new journal."
            )
        return 0

    def _parse(self, block: bytes, after: int) -> list[dict[str, Any]]:
        records, damaged = [], []
        for line in block.splitlines():
            if _number(line) <= after:
                continue
            record = _record(line)
            if record is None:
                damaged.append(line)
            elif record["n"] > after:
                records.append(record)
        if damaged:
            _log.warning(
                "%s has %d damaged lines, which are skipped; the first begins with %r.",
                self.path,
                len(damaged),
                damaged[0][:80],
            )
        return records


def _append_to(path: Path) -> int:
    return open_plain(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)


def _lock_for_writing(path: Path) -> int:
    """Return a descriptor that makes this process the only writer of `path` until it is closed or the process dies.

    The lock is a POSIX record lock. Data-loading processes, which outlive a killed parent by seconds, do not inherit it
    (they would inherit flock). A separate file carries the lock, because closing any descriptor of a file releases the
    record lock of that file.
    """
    owner = open_plain(path.with_name(f".{path.name}.lock"), os.O_RDWR | os.O_CREAT)
    try:
        lock_within(owner, _PATIENCE)
    except (BlockingIOError, PermissionError):
        holder = os.pread(owner, 32, 0).decode(errors="replace").strip() or "unknown"
        os.close(owner)
        raise DataError(
            f"{path} is being written by another process (number {holder}). Wait until that process ends, stop it, or "
            "choose another run folder."
        ) from None
    except OSError as error:
        _log.warning(
            "The file system of %s does not support locks (%s). Let only one process write this run folder.",
            path,
            error.strerror,
        )
    os.ftruncate(owner, 0)
    os.pwrite(owner, str(os.getpid()).encode(), 0)
    return owner


def _whole_lines(file: BinaryIO) -> bytes:
    """Return the next block of complete lines, about a mebibyte; empty if there is no complete line."""
    block = file.read(_BLOCK)
    if not block.endswith(b"\n"):
        block += file.readline(LONGEST)
    return block[: block.rfind(b"\n") + 1]


def _number(line: bytes) -> int:
    """Return the number `n` of a line without parsing the rest of the line; 2**62 for a line without a number."""
    digits = line[5 : line.find(b",", 5)] if line.startswith(b'{"n":') else b""
    return int(digits) if digits.isdigit() and len(digits) < 19 else 1 << 62


def _record(line: bytes) -> dict[str, Any] | None:
    if not line.startswith(b"{"):
        return None
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(record, dict) or type(n := record.get("n")) is not int or not is_number(n):
        return None
    values = record.get("values", {})
    values_valid = isinstance(values, dict) and all(
        value in _NO_NUMBERS if isinstance(value, str) else is_number(value) for value in values.values()
    )
    numbers_valid = [is_number(record[key]) for key in ("time", "step", "epoch") if key in record]
    return record if values_valid and all(numbers_valid) and (len(numbers_valid) == 3 or not values) else None


@cache
def _json_name(name: str) -> str:
    return json.dumps(name)


def _number_or_name(value: float) -> str:
    number = float(value)
    # JSON has no NaN and no infinity.
    return repr(number) if number - number == 0 else f'"{number}"'
