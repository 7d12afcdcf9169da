"""The counts of the soak test, and its short form: two kills of jobs."""

import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import pytest

from tests.fuzz.kills import ROOT, Moments, Tally, killed, start
from tests.slurm_cluster import missing_programs
from tests.soak.__main__ import RECORD, Counts, State, read_tests
from tests.soak.kinds import all_kinds


def test_the_page_counts_the_kills_of_all_tests() -> None:
    """Compare the rows of the page with its record, soak.json."""
    together = Counts()
    for counts in read_tests(RECORD):
        together.add(counts)
    page = RECORD.with_suffix(".md").read_text("utf-8")
    rows = re.findall(r"^\| .+ \| SIG\w+ \| (\d+) \|", page, re.MULTILINE)
    events = re.findall(r"^\| .+ \| \d+ \| (\d+) \| \d+ \|$", page, re.MULTILINE)
    assert sum(map(int, (*rows, *events))) == together.total
    assert f"has killed {together.total} commands" in page


def test_counts_add_up_and_survive_their_file(tmp_path: Path) -> None:
    """The slowest end is the largest of both, an end that never came included; other counts are sums."""
    state = State(
        began="2026-01-01", tallies={"a": {9: Tally(2, 1, float("inf"), 2, 2)}}, events={"e": [1, 2, 0]}
    )
    (tmp_path / "state.json").write_text(json.dumps(asdict(state)))
    assert State.load(tmp_path / "state.json") == state
    other = Counts(tallies={"a": {9: Tally(1, 1, 3.0, 1, 0)}, "b": {15: Tally(4)}}, faults=["a fault"])
    other.add(state.counts())
    assert other.tallies == {"a": {9: Tally(3, 2, float("inf"), 3, 2)}, "b": {15: Tally(4)}}
    assert (other.events, other.faults, other.total) == ({"e": [1, 2, 0]}, ["a fault"], 9)


@pytest.mark.skipif(bool(missing_programs()), reason="SLURM and MUNGE are not installed")
def test_a_soak_test_that_is_terminated_ends_its_cluster(tmp_path: Path) -> None:
    with tempfile.TemporaryDirectory(prefix="soak") as folder:  # a short path, because it holds sockets
        words = [
            sys.executable,
            "-m",
            "tests.soak",
            "200",
            "--folder",
            str(tmp_path / "soak"),
            "--only",
            "SLURM",
        ]
        soak = subprocess.Popen(words, cwd=ROOT, env={**os.environ, "TMPDIR": folder})
        deadline = time.monotonic() + 60
        names = ("munge", "slurmctld", "slurmd.n1", "slurmd.n2")
        while len(pids := _pids(Path(folder), names)) < len(names) or not (tmp_path / "soak").exists():
            assert soak.poll() is None and time.monotonic() < deadline
            time.sleep(0.05)
        soak.terminate()
        assert soak.wait(timeout=60) == 128 + signal.SIGTERM
        assert [pid for pid in pids if Path(f"/proc/{pid}").exists()] == []


def _pids(folder: Path, names: Sequence[str]) -> list[int]:
    paths = [path for name in names for path in folder.glob(f"*/{name}.pid")]
    return [int(text) for path in paths if (text := path.read_text().strip())]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="/proc lists the processes that are killed")
def test_jobs_that_are_killed_end_with_the_results_of_undisturbed_jobs(tmp_path: Path) -> None:
    soaked = {soaked.kind.name: soaked for soaked in all_kinds(tmp_path, {})}
    kind = soaked["a sweep on the pool, a job"].kind
    whole = tmp_path / "whole" / "it"
    whole.parent.mkdir()
    command = start(kind, whole)
    assert command.process.wait(timeout=300) == 0, command.output.read_text()
    moments = Moments.measured(kind, whole, 60.0)
    tallies: dict[int, Tally] = {}
    assert killed(kind, tmp_path / "killed", whole, moments, 2, random.Random(0), tallies) == []
    [tally] = tallies.values()
    assert tally.kills == tally.closed == tally.same >= 1
