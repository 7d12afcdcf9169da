"""Compare the speed of `mode=encode` on many point clouds with that of the encoder alone.

    python -m benchmarks.framework.encoding --folder /tmp/encoding make|measure|kill|files|page

The steps are separate commands, because the whole takes several minutes: `make` writes 100,000 clouds as shards,
`measure` encodes them five times and times the encoder alone in between, `kill` kills the same command five times and
compares the bytes, `files` encodes single files, and `page` writes encoding.md beside this file. Delete the folder (3
GB) afterwards.
"""

import json
import random
import shutil
import signal
import subprocess
import sys
import time
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks.commands import parse_step, timed_command
from benchmarks.pages import machine, write_page
from benchmarks.timing import ROUNDS, median_and_range

ROOT = Path(__file__).resolve().parents[2]
CLOUDS, POINTS, PART, BASIS = 100_000, 2048, 1000, 512
BATCH = 250
CORES = 2
FILES = 1000
SETTINGS = (
    *("mode=encode", "encoder=[bps]", f"encoder.bps.points={BASIS}", f"batch_size={BATCH}", "threads=1"),
    "logger=none",
)
SHARES = (
    "mode.share=" + ",".join(f"{share}/{CORES}" for share in range(1, CORES + 1)),
    f"hydra.launcher.jobs={CORES}",
)


def make(folder: Path) -> None:
    """Write the clouds as shards, and some of them as single files."""
    shutil.rmtree(folder, ignore_errors=True)
    draws = np.random.default_rng(0)
    for name in ("shards", "ply"):
        (folder / name).mkdir(parents=True)
    for number in range(CLOUDS // PART):
        clouds = draws.standard_normal((PART, POINTS, 3), dtype=np.float32)
        np.save(folder / "shards" / f"part-{number:06}.npy", clouds)
    index = {"version": 1, "files": CLOUDS, "part": PART, "columns": ["x", "y", "z"]}
    (folder / "shards" / "encoding.json").write_text(json.dumps(index), encoding="utf-8")
    names = b"".join(b"property float %c\n" % letter for letter in b"xyz")
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex %d\n%send_header\n" % (POINTS, names)
    for number, cloud in enumerate(draws.standard_normal((FILES, POINTS, 3), dtype=np.float32)):
        (folder / "ply" / f"{number:06}.ply").write_bytes(header + cloud.tobytes())


def encoder_rate(seed: int, count: int = 8000) -> float:
    """Return the clouds per second of the encoder alone, on one core, from clouds in memory."""
    import torch

    from plugins.encoder.bps.encoder import BPS

    torch.set_num_threads(1)
    encoder = BPS((POINTS, 3), points=BASIS).eval()
    clouds = torch.from_numpy(
        np.random.default_rng(seed).standard_normal((count, POINTS, 3), dtype=np.float32)
    )
    with torch.no_grad():
        encoder(clouds[:BATCH])
        start = time.perf_counter()
        for batch in clouds.split(BATCH):
            encoder(batch)
    return count / (time.perf_counter() - start)


def encoder_rates() -> tuple[float, float]:
    """Return the clouds per second of the encoder alone: in one process, and in one process for each core."""
    with get_context("spawn").Pool(1) as pool:
        alone = pool.map(encoder_rate, [0])[0]
    with get_context("spawn").Pool(CORES) as pool:
        return alone, sum(pool.map(encoder_rate, range(CORES), chunksize=1))


def command(folder: Path, into: Path, *words: str, several: bool = True) -> list[str]:
    """Return the command that encodes the shards, by one job for each core or by one command."""
    where = f"hydra.{'sweep' if several else 'run'}.dir={into}.run"
    start = [sys.executable, "-m", "framework", *(["-m", *SHARES] if several else [])]
    return [*start, *SETTINGS, f"mode.files={folder}", f"mode.into={into}", where, *words]


def rate_between_parts(into: Path, jobs: int) -> float:
    """Return the clouds per second of all jobs together, each timed from its first to its last written part."""
    times = [path.stat().st_mtime for path in sorted(into.glob("part-*.npy"))]
    shares = [times[job::jobs] for job in range(jobs)]
    return sum(PART * (len(share) - 1) / (max(share) - min(share)) for share in shares)


def measure(folder: Path) -> dict[str, Any]:
    """Encode the shards in several rounds, and time the encoder alone before each."""
    timed_command(command(folder / "shards", folder / "warm"))
    shutil.rmtree(folder / "warm")
    rounds = []
    for number in range(ROUNDS):
        alone, together = encoder_rates()
        into = folder / f"features-{number}"
        wall, processor = timed_command(command(folder / "shards", into))
        rounds.append([alone, together, rate_between_parts(into, CORES), wall, processor])
        if number:
            shutil.rmtree(into)
        shutil.rmtree(f"{into}.run")
    small = folder / "small"
    small.mkdir()
    shutil.copy(folder / "shards" / "part-000000.npy", small)
    index = {"version": 1, "files": PART, "part": PART, "columns": ["x", "y", "z"]}
    (small / "encoding.json").write_text(json.dumps(index), encoding="utf-8")
    starts = []
    for number in range(ROUNDS):
        starts.append(list(timed_command(command(small, folder / f"small-{number}", several=False))))
    return {"rounds": rounds, "starts": starts}


def kill(folder: Path) -> dict[str, Any]:
    """Kill the sweep at five moments, let it finish, and compare its bytes with those of an undisturbed sweep."""
    whole, into = folder / "features-0", folder / "killed"
    draw = random.Random(0)
    left = []
    words = command(folder / "shards", into)
    while len(left) < 5:
        process = subprocess.Popen(words, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        parts = len(list(into.glob("part-*.npy")))
        goal = parts + draw.randint(1, (CLOUDS // PART - parts) // (6 - len(left)))
        while len(list(into.glob("part-*.npy"))) < goal and process.poll() is None:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        process.wait()
        time.sleep(7)  # the jobs end by themselves
        left.append(len(list(into.glob("part-*.npy"))))
    timed_command(words)
    names = {path.name for path in whole.iterdir()}
    same = names == {path.name for path in into.iterdir()} and all(
        (whole / name).read_bytes() == (into / name).read_bytes() for name in names
    )
    return {"killed": left, "same": same, "compared": len(names)}


def files(folder: Path) -> dict[str, Any]:
    """Encode and pack single files by one command, in interleaved rounds."""
    rounds: dict[str, list[float]] = {"encode": [], "pack": []}
    for number in range(ROUNDS):
        for name, seconds in rounds.items():
            into = folder / f"{name}-{number}"
            words = command(folder / "ply", into, "data=point_cloud_folder", "mode.part=100", several=False)
            if name == "pack":
                words = [word for word in words if not word.startswith("encoder")] + ["mode.pack=true"]
            timed_command(words)
            times = [path.stat().st_mtime for path in sorted(into.glob("part-*.npy"))]
            seconds.append(100 * (len(times) - 1) / (max(times) - min(times)))
            shutil.rmtree(into)
    return {"files": rounds}


def page(results: dict[str, Any]) -> str:
    """Return the page."""
    alone, together, between, wall, _ = map(list, zip(*results["rounds"], strict=True))
    ratio = [rate / (CORES * single) for rate, single in zip(between, alone, strict=True)]
    ratio_together = [rate / both for rate, both in zip(between, together, strict=True)]
    whole = [CLOUDS / seconds / (CORES * single) for seconds, single in zip(wall, alone, strict=True)]
    starts = [seconds for _, seconds in results["starts"]]
    start_wall = [seconds for seconds, _ in results["starts"]]
    beyond = [seconds - CLOUDS / rate for seconds, rate in zip(wall, between, strict=True)]
    million = 1e6 / (median(beyond) + 1e6 / median(between)) / (CORES * median(alone))
    one_by_one = {name: [rate / median(alone) for rate in rates] for name, rates in results["files"].items()}
    return "\n".join(
        [
            "# Encoding many point clouds",
            "",
            "This page compares the speed of `mode=encode` with the speed of the encoder alone. The encoder is "
            f"`bps` with {BASIS} basis points. It encodes {CLOUDS:,} synthetic clouds of {POINTS:,} normally "
            f"distributed points ({CLOUDS * POINTS * 12 / 1e9:.1f} GB) in batches of {BATCH}. The clouds are in "
            f"{CLOUDS // PART} shards, which are files of many clouds. A sweep of {CORES} jobs with one thread "
            "each encodes them: `python -m framework -m " + " ".join((*SHARES, *SETTINGS)) + " "
            "mode.files=<shards> mode.into=<features>`. The encoder alone reads clouds in memory, in one process "
            "with one thread. The sweep and the encoder alone are measured in turn.",
            "",
            f"All numbers are medians of {ROUNDS} rounds, with the least and the largest in brackets.",
            "",
            "| | clouds per second | share of the encoder's |",
            "|---|---:|---:|",
            f"| encoder alone, one core | {median_and_range(alone, 4)} | 1 |",
            f"| encoder alone, {CORES} processes at once | {median_and_range(together, 4)} | "
            f"{median_and_range([rate / (CORES * single) for rate, single in zip(together, alone, strict=True)], 2)} |",
            f"| `mode=encode`, {CORES} jobs, from the first to the last part | {median_and_range(between, 4)} | "
            f"{median_and_range(ratio, 2)} |",
            f"| the same, whole command with its start | "
            f"{median_and_range([CLOUDS / seconds for seconds in wall], 4)} | {median_and_range(whole, 2)} |",
            "",
            "The last column is the rate of the row, divided by the rate of the encoder alone on the same number "
            f"of cores (for {CORES} cores: {CORES} × its rate on one core). Processes that run at once share the "
            f"memory of the machine, which can slow them down. This holds for {CORES} processes of the encoder as well "
            f"as for {CORES} jobs: the rate of the jobs is {median_and_range(ratio_together, 2)} times the rate of "
            f"{CORES} processes of the encoder at once.",
            "",
            f"Before and after the encoding, the command takes {median_and_range(beyond, 2)} s (imports, "
            "composition of the config, end of the sweep). This is about as long as the encoding of the "
            f"{CLOUDS:,} clouds itself. With a million clouds, the last column for the whole command would be "
            f"{million:.2f} (computed from these two times, not measured). A command without a sweep that encodes "
            f"{PART} clouds takes {median_and_range(starts, 2)} s of processor time and "
            f"{median_and_range(start_wall, 2)} s of wall time, nearly all of it its start.",
            "",
            "In another test, the command of the same sweep was killed five times (SIGKILL) and repeated each "
            f"time. After the kills, {', '.join(map(str, results['killed']))} of the {CLOUDS // PART} parts "
            f"existed; the last repetition finished the sweep. The bytes of all {results['compared']} files "
            + ("equal" if results["same"] else "DIFFER FROM")
            + " those of the undisturbed sweep.",
            "",
            f"Single files cost more than shards. The next table holds the rates of one command for {FILES:,} files "
            "in parts of 100 clouds, over the time from the end of the first part to the end of the last.",
            "",
            "| one cloud per file | share of the encoder's rate |",
            "|---|---:|",
            f"| encode binary `.ply` files | {median_and_range(one_by_one['encode'], 2)} |",
            f"| pack binary `.ply` files into shards (`mode.pack=true`) | {median_and_range(one_by_one['pack'], 2)} |",
            "",
            f"{machine('torch', 'numpy', 'numba')} Command: `python -m benchmarks.framework.encoding` with the steps "
            "`make`, `measure`, `kill`, `files` and `page`.",
            "",
        ]
    )


def main() -> None:
    steps = {"measure": measure, "kill": kill, "files": files}
    step, folder = parse_step(__doc__, ("make", *steps, "page"), "folder for the clouds and the results")
    stored = folder.with_suffix(".json")
    results = json.loads(stored.read_text(encoding="utf-8")) if stored.is_file() else {}
    if step == "make":
        make(folder)
    elif step == "page":
        write_page(__file__, page(results))
    else:
        results |= steps[step](folder)
        stored.write_text(json.dumps(results), encoding="utf-8")


if __name__ == "__main__":
    main()
