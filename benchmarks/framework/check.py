"""Count the planted faults that the contract of density heads finds, and its false alarms.

    python -m benchmarks.framework.check [seeds, 50 by default] [more]

Finds the planted faults of tests/planted_faults.py and tests/planted_questions.py, and counts false alarms: every row
of every head that is shipped, and the right heads of tests/right_heads.py, over seeds of everything that is drawn.
Writes check.md beside this file. With `more` it goes on where that file ends, which is fair as long as the code is the
same.
"""

import re
import sys
import time
from pathlib import Path

import torch

from benchmarks.pages import machine, write_page
from framework.configuration.registry import installed
from framework.testing import finding
from framework.testing.contract import contract
from tests.planted_faults import ALL_FAULTS
from tests.planted_questions import FURTHER_FAULTS
from tests.right_heads import HEADS, right_findings

PAGE = Path(__file__).with_suffix(".md")


def faults() -> list[str]:
    """A line of the table for each planted fault."""
    lines = []
    for fault in (*ALL_FAULTS, *FURTHER_FAULTS):
        failed = list(dict.fromkeys(one.name for one in fault.findings() if not one.holds))
        lines.append(
            f"| {fault.name} | {len(fault.target.names)} {fault.target.kind} | {', '.join(failed) or '**missed**'} |"
        )
        sys.stdout.write(lines[-1] + "\n")
    return lines


def alarms(seed: int) -> list[str]:
    """What fails of the shipped rows and of the right heads of others with this seed."""
    before = finding.SEED
    for module in list(sys.modules.values()):  # whoever imported it has a copy
        if getattr(module, "SEED", None) == before and module.__name__.startswith(
            ("framework.testing", "plugins")
        ):
            module.SEED = seed  # pyright: ignore[reportAttributeAccessIssue]
    failed = []
    for name in installed("density_head"):
        whole = contract("density_head", name)
        for row in whole.rows:
            failed += [f"{name}, {row.name}: {one}" for one in whole.findings(row) if not one.holds]
    for name, (_, targets) in HEADS.items():
        for target in targets:
            what = f"{name} of somebody else, {target.listed_names}"
            failed += [f"{what}: {one}" for one in right_findings(name, target) if not one.holds]
    return failed


def write(lines: list[str], seeds: int, failed: dict[str, list[int]], minutes: float) -> None:
    rows = sum(len(contract("density_head", name).rows) for name in installed("density_head"))
    others = sum(len(targets) for _, targets in HEADS.values())
    told = [f"- seeds {', '.join(map(str, at))}: {what}" for what, at in failed.items()]
    found = sum("**missed**" not in line for line in lines)
    text = f"""# What `mode=check` finds in density heads

`python -m benchmarks.framework.check`: {machine("torch")} {minutes:.0f} minutes.

**Planted faults: {found} of {len(lines)} found ({100 * found / len(lines):.1f} %).** A sound head is changed in one
thing; the third column names every property that fails.

| fault | target | found by |
| --- | --- | --- |
{chr(10).join(lines)}

**False alarms: {sum(map(len, failed.values()))} findings** of {rows} rows of shipped heads × {seeds} seeds,
and of {others} rows of right heads that are not shipped (tests/right_heads.py).

{chr(10).join(told)}
"""
    write_page(__file__, text)


def written() -> tuple[list[str], int, dict[str, list[int]], float]:
    """What an earlier run has written: as `write` takes it."""
    text = PAGE.read_text(encoding="utf-8")
    lines = [
        line
        for line in text.splitlines()
        if line.startswith("| ") and not line.startswith(("| fault", "| ---"))
    ]
    (seeds,) = re.findall(r"shipped heads × (\d+) seeds", text)
    (minutes,) = re.findall(r"(\d+) minutes\.$", text, re.MULTILINE)
    told = re.findall(r"^- seeds ([\d, ]+): (.*)$", text, re.MULTILINE)
    return (
        lines,
        int(seeds),
        {what: [int(seed) for seed in at.split(", ")] for at, what in told},
        float(minutes),
    )


def main() -> None:
    torch.set_num_threads(1)
    start = time.perf_counter()
    if "more" in sys.argv:
        lines, first, failed, before = written()
    else:
        lines, first, failed, before = faults(), 0, {}, 0.0
    for seed in range(first, int(sys.argv[1]) if len(sys.argv) > 1 else 50):
        for one in alarms(seed):
            sys.stdout.write(f"seed {seed}: {one}\n")
            failed.setdefault(one.partition(" FAILS")[0], []).append(seed)
        # after each seed, so that what was found is kept when it is ended
        write(lines, seed + 1, failed, before + (time.perf_counter() - start) / 60)


if __name__ == "__main__":
    main()
