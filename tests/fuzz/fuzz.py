"""Give damaged files to every reader, in processes with bounded memory and time.

    python -m tests.fuzz.fuzz

The script writes fuzz.md beside this file. A reader may read a damaged file, or refuse it with an error message.
These outcomes are faults: a crash; more than two seconds of processor time or 1 GiB of memory; another exception; a
message that does not name the file, is too long or has control characters; and silently other numbers. Silently other
numbers means that an undamaged array has changed, or that damaged content was accepted as if it were undamaged. Bytes
are flipped, cut, repeated, swapped and inserted, and lengths and counts are changed. In formats with checksums or
compression, half of the files are damaged inside, and the checksum is made right again.

For every plugin that stores arrays, a model is fitted and stored. One array of its checkpoint is damaged: numbers at
the limits, cycles, another type or shape, sparse, nested, quantised and expanded tensors, positions beyond their
storage. Then the checkpoint is loaded, and the model predicts.

`--files 400 --check` is the short form for tests: it writes nothing, exits with 1 if there is a fault, and prints the
modules that guard a file. `--only NAME` chooses readers. `--replay NUMBER` reads one file of the chosen reader again,
to find the cause of a fault.
"""

import argparse
import gc
import os
import signal
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

os.environ["OMP_NUM_THREADS"] = "1"  # before anything starts threads: readers run in forks

import torch

from benchmarks.pages import machine, write_page
from framework.storage.reading import translate_errors
from tests.fuzz.damage import Reader, Tally, fuzz, outcome_of, replay, scratch
from tests.fuzz.damaged_readers import readers


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--files", type=int, default=20_000)
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--replay", type=int)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    chosen = [
        one for one in readers() if not arguments.only or any(word in one.name for word in arguments.only)
    ]
    if arguments.replay is not None:
        replay(chosen[0], arguments.replay)
        return 0
    gc.collect()
    gc.freeze()  # the garbage collection of a child process touches, and so copies, all that this process has made
    found: dict[str, Tally] = {}
    guards: set[str] = set()
    began = time.perf_counter()
    for reader in chosen:
        if not reader.samples:
            continue
        count = max(1, round(reader.share * arguments.files)) if arguments.check else arguments.files
        with scratch() as folder:
            with record_guards(guards):
                whole(reader, folder)
            irregular(reader, folder)
            found[reader.name] = fuzz(reader, count, folder)
        tell(reader.name, found[reader.name])
        if not arguments.check and not arguments.only:
            report(found, (time.perf_counter() - began) / 60, arguments.files)
    if arguments.check:
        here = f"{Path(__file__).resolve().parents[2]}{os.sep}"
        files = sorted(file.removeprefix(here) for file in guards if file.startswith(here))
        sys.stdout.write(f"guards: {' '.join(files)}\n")
    return int(any(tally.bad for tally in found.values()))


@contextmanager
def record_guards(files: set[str]) -> Iterator[None]:
    """Add to `files` the modules that guard a file (`translate_errors`) inside the block."""
    code = translate_errors.__wrapped__.__code__  # type: ignore[attr-defined]

    def record(frame: FrameType, event: str, argument: object) -> None:
        # the caller is contextlib, and the caller of that guards the file
        if event == "call" and frame.f_code is code:
            files.add(frame.f_back.f_back.f_code.co_filename)  # type: ignore[union-attr]

    sys.setprofile(record)
    try:
        yield
    finally:
        sys.setprofile(None)


def whole(reader: Reader, folder: Path) -> None:
    """Require that a reader reads its undamaged samples."""
    file = folder / reader.file
    file.parent.mkdir(parents=True, exist_ok=True)
    for content in reader.samples:
        file.write_bytes(content)
        reader.read(file)


def irregular(reader: Reader, folder: Path) -> None:
    """Require that a reader refuses or leaves out a pipe, which would block, an endless device, and a folder.

    Raises:
        AssertionError: one is read.
    """
    file = folder / reader.file
    for make in (os.mkfifo, lambda path: path.symlink_to("/dev/zero"), Path.mkdir):
        file.unlink(missing_ok=True)
        make(file)
        signal.alarm(20)  # ends this process
        outcome, text = outcome_of(reader, file)
        signal.alarm(0)
        if (outcome == 0 and not reader.optional) or (outcome == 2 and str(file.parent) not in text):
            raise AssertionError(f"{reader.name}: {text or f'{make} is read'}")
    file.rmdir()


def tell(name: str, tally: Tally) -> None:
    faults = "".join(f"\n    {number}: {text}" for number, text in tally.faults[:12])
    sys.stdout.write(
        f"{name}: {tally.files} files, {tally.read} read, {tally.refused} refused, {tally.unclean} unclean, "
        f"{tally.silent} silent, {tally.crashes} crashes, {tally.hangs} hangs, slowest {tally.slowest:.2f} s{faults}\n"
    )
    sys.stdout.flush()


def report(found: dict[str, Tally], minutes: float, files: int) -> None:
    head = [
        "reader",
        "damaged files",
        "read",
        "refused with a sentence",
        "other errors",
        "silently other numbers",
        "crashes",
        "hangs",
        "slowest, s",
    ]
    rows = []
    for name, one in found.items():
        counts = (one.files, one.read, one.refused, one.unclean, one.silent, one.crashes, one.hangs)
        rows.append([name, *(f"{value:,}" for value in counts), f"{one.slowest:.2f}"])
    table = "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows))
    text = f"""# Damaged files

This page shows what each reader does with {files:,} randomly damaged files. `fuzz.py` describes how the files are
damaged. Each file may use two seconds of processor time, and 1 GiB of memory in addition to what the process already
has.

- *refused with a sentence*: the reader raises an error whose message names the file.
- *other errors*: any other exception. An error message counts here too if it does not name the file, has more than
  1,500 characters, contains control characters, or reports a failed allocation of memory.
- *silently other numbers*: the reader returns without an error, but arrays that were not damaged have changed, or a
  damaged type, shape or structure was accepted.

In the rows "arrays of …", one array in the checkpoint of a model with the named plugin is damaged. The model is then
loaded, and makes a prediction. All plugins that store arrays are included, except `inception_resnet_v2` (218 MB) and
`resnet` (45 MB), whose weights are read by the same code as those of other networks.

{table}

Measured by `python -m tests.fuzz.fuzz` in {minutes:.0f} minutes on {machine("numpy", "pillow", "h5py", "torch")}
"""
    write_page(__file__, text)


if __name__ == "__main__":
    sys.exit(main())
