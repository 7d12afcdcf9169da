"""Count the planted faults that the contract of density heads finds, and its false alarms.

    python -m benchmarks.framework.check [seeds, 50 by default] [more | names ...]

The planted faults are in tests/planted_faults.py and tests/planted_questions.py. False alarms are counted over the rows
of all density heads of this project and over the correct density heads of tests/right_heads.py, with several random
seeds. The results are written to check.md beside this file. With `more` the script continues after the last seed of
that file, which is valid only if the code has not changed. If names are given, only these density heads are tested, and
only the page's last section is written, which is about such later runs.
"""

import re
import sys
import time
from pathlib import Path

import torch

from benchmarks.framework.check_parts import change_seed, write_later_run
from benchmarks.pages import machine, write_page
from framework.configuration.registry import installed
from framework.testing.contract import contract
from tests.planted_faults import ALL_FAULTS
from tests.planted_questions import FURTHER_FAULTS
from tests.right_heads import HEADS, right_findings

PAGE = Path(__file__).with_suffix(".md")


def examine_faults() -> list[str]:
    """Return one table row for each planted fault, and print it."""
    lines = []
    for fault in (*ALL_FAULTS, *FURTHER_FAULTS):
        failed = list(dict.fromkeys(result.name for result in fault.findings() if not result.holds))
        name = fault.name.replace("|", r"\|")  # a bare | would end the cell
        lines.append(
            f"| {name} | {len(fault.target.names)} {fault.target.kind} | {', '.join(failed) or '**missed**'} |"
        )
        sys.stdout.write(lines[-1] + "\n")
    return lines


def find_alarms(seed: int) -> list[str]:
    """Return the failed tests of correct density heads with a random seed."""
    change_seed(seed)
    failed = []
    for name in installed("density_head"):
        whole = contract("density_head", name)
        for row in whole.rows:
            failed += [f"{name}, {row.name}: {result}" for result in whole.findings(row) if not result.holds]
    for name, (_, targets) in HEADS.items():
        for target in targets:
            label = f"{name} (not shipped), {target.listed_names}"
            failed += [f"{label}: {result}" for result in right_findings(name, target) if not result.holds]
    return failed


def write(lines: list[str], seeds: int, failed: dict[str, list[int]], minutes: float) -> None:
    """Write the page.

    Args:
        lines: Table rows of the planted faults.
        seeds: Number of random seeds with which false alarms were counted.
        failed: Name of each false alarm, with the seeds at which it occurred.
        minutes: Run time so far.
    """
    rows = sum(len(contract("density_head", name).rows) for name in installed("density_head"))
    right_rows = sum(len(targets) for _, targets in HEADS.values())
    alarm_lines = [
        f"- seed {', '.join(map(str, alarm_seeds))}: {alarm}" for alarm, alarm_seeds in failed.items()
    ]
    found_count = sum("**missed**" not in line for line in lines)
    text = f"""# What `mode=check` finds in density heads

This page shows how well `mode=check` finds errors in density heads. `mode=check` tests the properties that every
density head must have. The benchmark counts two things: the planted faults that `mode=check` finds, and its false
alarms. A planted fault is a known error that is put into a correct density head. A false alarm is a failed test of a
correct density head.

## Planted faults

`mode=check` found {found_count} of {len(lines)} planted faults ({100 * found_count / len(lines):.1f} %).

The table lists the planted faults. For each row, one thing is changed in a correct density head. The column `fault`
names the change, `target` names the predicted quantity, and `failed properties` lists every property whose test
failed. κ is the concentration of a von Mises density, μ is its mean direction, and σ is the standard deviation of a
normal density. A row with **missed** is a planted fault that `mode=check` did not find.

| fault | target | failed properties |
| --- | --- | --- |
{chr(10).join(lines)}

## False alarms

The number of false alarms of `mode=check`, which are failed tests of correct density heads, is
{sum(map(len, failed.values()))}. `mode=check` tested {rows} configurations of the density heads of this project with
{seeds} random seeds each. It also tested {right_rows} configurations of correct density heads that are not part of this
project (tests/right_heads.py). Each line of the following list names the random seeds, the density head, its
configuration and the property whose test failed:
{chr(10).join(alarm_lines)}

{machine("torch", "numpy")} Command: `python -m benchmarks.framework.check`. Run time: {minutes:.0f} minutes.
""".replace("\n\n\n", "\n\n")
    write_page(__file__, text)


def read_page() -> tuple[list[str], int, dict[str, list[int]], float]:
    """Return the arguments of `write` that an earlier run has written to the page."""
    text = PAGE.read_text(encoding="utf-8")
    lines = [
        line
        for line in text.splitlines()
        if line.startswith("| ") and not line.startswith(("| fault", "| ---"))
    ]
    (seeds,) = re.findall(r"with\s+(\d+)\s+random\s+seeds\s+each", text)
    (minutes,) = re.findall(r"(\d+) minutes\.$", text, re.MULTILINE)
    alarm_matches = re.findall(r"^- seeds? ([\d, ]+): (.*)$", text, re.MULTILINE)
    return (
        lines,
        int(seeds),
        {alarm: [int(seed) for seed in alarm_seeds.split(", ")] for alarm_seeds, alarm in alarm_matches},
        float(minutes),
    )


def main() -> None:
    torch.set_num_threads(1)
    start = time.perf_counter()
    if names := [name for name in sys.argv[2:] if name != "more"]:
        command = f"python -m benchmarks.framework.check {sys.argv[1]} {' '.join(names)}"
        write_later_run(PAGE, "density_head", names, int(sys.argv[1]), command)
        return
    if "more" in sys.argv:
        lines, first, failed, before = read_page()
    else:
        lines, first, failed, before = examine_faults(), 0, {}, 0.0
    for seed in range(first, int(sys.argv[1]) if len(sys.argv) > 1 else 50):
        for alarm in find_alarms(seed):
            sys.stdout.write(f"seed {seed}: {alarm}\n")
            failed.setdefault(alarm.partition(" FAILS")[0], []).append(seed)
        # after each seed, so that an interrupted run keeps its results
        write(lines, seed + 1, failed, before + (time.perf_counter() - start) / 60)


if __name__ == "__main__":
    main()
