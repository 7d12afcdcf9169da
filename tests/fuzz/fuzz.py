"""Give damaged files to every reader, in processes with bounded memory and time.

    python -m tests.fuzz.fuzz

Writes fuzz.md beside this file. A file may be read or refused with a sentence; a crash, more than two seconds of
processor time, more than 1 GiB, another error, a message that does not name the file, drowns in damage or has control
characters is a fault, and so are silently other numbers: an array elsewhere that changed, or damage that answers as if
it were whole. Beside bytes that are flipped, cut, repeated, swapped and put in, lengths and counts are changed, and
half of the files of formats with checksums or compression are damaged inside them, so that the checksum is right.

Of every plugin that stores arrays a model is fitted and stored, one array damaged (numbers at the limits, cycles,
another type or shape, sparse, nested, quantised and expanded tensors, places beyond their storage), and the checkpoint
loaded to predict.

`--files 400 --check` is the short form for tests: it writes nothing and ends with 1 where there is a fault.
`--only NAME` chooses readers, `--replay NUMBER` reads one file of the only one here, for whoever mends its fault.
"""

import argparse
import os
import signal
import sys
import time
import warnings
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # before anything starts threads: readers run in forks

import torch

from benchmarks.pages import machine, write_page
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
    found: dict[str, Tally] = {}
    began = time.perf_counter()
    for reader in chosen:
        if not reader.samples:
            continue
        count = max(1, round(reader.share * arguments.files)) if arguments.check else arguments.files
        with scratch() as folder:
            whole(reader, folder)
            irregular(reader, folder)
            found[reader.name] = fuzz(reader, count, folder)
        tell(reader.name, found[reader.name])
        if not arguments.check and not arguments.only:
            report(found, (time.perf_counter() - began) / 60, arguments.files)
    return int(any(tally.bad for tally in found.values()))


def whole(reader: Reader, folder: Path) -> None:
    """What is not damaged is read."""
    file = folder / reader.file
    file.parent.mkdir(parents=True, exist_ok=True)
    for content in reader.samples:
        file.write_bytes(content)
        reader.read(file)


def irregular(reader: Reader, folder: Path) -> None:
    """A pipe, which would block, a device that goes on without end, and a folder are refused, or left out.

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

{files:,} damaged files for each reader, each read with 1 GiB of memory beyond what the process has and two seconds of
processor time; see `fuzz.py` for how they are damaged. A message that does not name the file counts among other errors,
and so do one of more than 1,500 characters, one with control characters, and one that was made of a failed allocation.
"Silently other numbers" are arrays elsewhere that changed, and damage to a type, shape or structure that is taken.
"Arrays of" are checkpoints of every plugin that stores some, one of them damaged, loaded and asked to predict; those of
inception_resnet_v2 (218 MB) are left out, since they are read as the weights of every network are.

{table}

{minutes:.0f} minutes on {machine("numpy", "pillow", "h5py", "torch")}
"""
    write_page(__file__, text)


if __name__ == "__main__":
    sys.exit(main())
