"""Count the planted faults that contracts of other parts find, and their false alarms.

    python -m benchmarks.framework.check_parts GROUP [seeds, 20 by default] [names ...]

GROUP is data, metric, encoder, renderer, uncertainty or objective. This finds the planted faults of
tests/planted_*.py, and counts false alarms: every row of every part that is shipped, and right parts as strangers
write them, over seeds of everything that is drawn. Writes check_<group>.md beside this file, after each seed. With
names only those shipped parts are tried.
"""

import statistics
import sys
import time
from collections.abc import Callable, Iterator

import torch

from benchmarks.pages import machine, write_page
from framework.configuration.registry import installed
from framework.testing import finding
from framework.testing.contract import contract
from framework.testing.data import examine_data
from framework.testing.encoders import examine_encoder
from framework.testing.finding import Finding
from framework.testing.metrics import examine_metric
from framework.testing.objectives import examine_objective
from framework.testing.renderers import examine_renderer
from framework.testing.rows import EncoderRow, MetricRow, ObjectiveRow, RendererRow, WrapperRow
from framework.testing.wrappers import Plain, examine_wrapper
from tests import (
    planted_data,
    planted_encoders,
    planted_metrics,
    planted_objectives,
    planted_renderers,
    planted_wrappers,
)

Look = Callable[[], Iterator[Finding]]


def planted(group: str) -> dict[str, Look]:
    """Fault → its findings."""
    match group:
        case "data":
            return {
                fault.name: lambda fault=fault: examine_data(fault.row, fault.build)
                for fault in planted_data.ALL_FAULTS
            }
        case "metric":
            return {
                fault.name: lambda fault=fault: examine_metric(MetricRow("", fault.target), fault.build)
                for fault in planted_metrics.ALL_FAULTS
            }
        case "encoder":
            return {
                fault.name: lambda fault=fault: examine_encoder(EncoderRow("", fault.shape), fault.build)
                for fault in planted_encoders.ALL_FAULTS
            }
        case "uncertainty":
            return {
                fault.name: lambda fault=fault: examine_wrapper(
                    WrapperRow("", fault.target), lambda target: fault.kind(lambda: Plain(target)), None
                )
                for fault in planted_wrappers.ALL_FAULTS
            }
        case "objective":
            return {
                fault.name: lambda fault=fault: examine_objective(
                    ObjectiveRow("", fault.target), lambda factor: fault.kind(weight=factor)
                )
                for fault in planted_objectives.ALL_FAULTS
            }
    others = {
        fault.name: dict(planted_renderers.RIGHT["discs"][1]) if fault.by == "points" else {}
        for fault in planted_renderers.ALL_FAULTS
    }
    return {
        fault.name: lambda fault=fault: examine_renderer(
            RendererRow("", leave_out=others[fault.name]), fault.build
        )
        for fault in planted_renderers.ALL_FAULTS
    }


def strangers(group: str) -> dict[str, Look]:
    """Right part → its findings."""
    match group:
        case "data":
            return {
                name: lambda kind=kind, row=row: examine_data(row, lambda config: kind(**config))
                for name, (kind, row) in planted_data.RIGHT.items()
            }
        case "metric":
            return {
                name: lambda kind=kind, target=target: examine_metric(MetricRow("", target), kind)
                for name, (kind, target) in planted_metrics.RIGHT.items()
            }
        case "encoder":
            return {
                name: lambda kind=kind, shape=shape: examine_encoder(EncoderRow("", shape), kind)
                for name, (kind, shape) in planted_encoders.RIGHT.items()
            }
        case "uncertainty":
            return {
                f"{name}, {target.kind} {len(target.names)}": lambda kind=kind, target=target: (
                    examine_wrapper(WrapperRow("", target), lambda other: kind(lambda: Plain(other)), None)
                )
                for name, kind in planted_wrappers.RIGHT.items()
                for target in planted_wrappers.TARGETS
            }
        case "objective":
            return {
                f"{name}, {target.kind}": lambda kind=kind, target=target: examine_objective(
                    ObjectiveRow("", target), lambda factor: kind(weight=factor)
                )
                for name, kind in planted_objectives.RIGHT.items()
                for target in planted_wrappers.TARGETS[:3]
            }
    return {
        name: lambda build=build, rest=rest: examine_renderer(RendererRow("", leave_out=rest), build)
        for name, (build, rest) in planted_renderers.RIGHT.items()
    }


def shipped(group: str, names: list[str]) -> dict[str, Look]:
    """Part → the findings of all its rows."""

    def every(name: str) -> Iterator[Finding]:
        whole = contract(group, name)
        for row in whole.rows:
            yield from whole.findings(row)

    return {name: lambda name=name: every(name) for name in names or installed(group)}


def change_seed(seed: int) -> None:
    """Whoever imported it has a copy."""
    before = finding.SEED
    for module in list(sys.modules.values()):
        if getattr(module, "SEED", None) == before and module.__name__.startswith(
            ("framework.testing", "plugins")
        ):
            module.SEED = seed  # pyright: ignore[reportAttributeAccessIssue]


def write(
    group: str, found: dict[str, list[str]], seconds: dict[str, list[float]], alarms: list[str], rows: int
) -> None:
    seeds = max(map(len, seconds.values()), default=0)
    caught = sum(map(bool, found.values()))
    lines = [f"| {name} | {', '.join(by) or '**missed**'} |" for name, by in found.items()]
    costs = [
        f"| {name} | {statistics.median(each):.2f} | {min(each):.2f} to {max(each):.2f} |"
        for name, each in sorted(seconds.items(), key=lambda item: -statistics.median(item[1]))
    ]
    write_page(
        __file__,
        f"""# What `mode=check` finds in parts of the group {group}

`python -m benchmarks.framework.check_parts {group}`: {machine("torch")}

**Planted faults: {caught} of {len(found)} found ({100 * caught / max(len(found), 1):.1f} %).** A right part is changed
in one thing; the second column names every property that fails.

| fault | found by |
| --- | --- |
{chr(10).join(lines)}

**False alarms: {len(alarms)} findings** of {rows} rows of shipped parts and {len(strangers(group))} right parts of
strangers × {seeds} seeds.

{chr(10).join(f"- {alarm}" for alarm in alarms)}

Processor seconds of a part with all its rows, one thread, beside other work: median and range over the seeds.

| part | median | range |
| --- | --- | --- |
{chr(10).join(costs)}
""".replace("\n\n\n\n", "\n\n"),
        f"check_{group}",
    )


def main() -> None:
    torch.set_num_threads(1)
    group, seeds = sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 20
    parts = {
        **shipped(group, sys.argv[3:]),
        **{f"a stranger's: {name}": look for name, look in strangers(group).items()},
    }
    rows = sum(len(contract(group, name).rows) for name in parts if not name.startswith("a stranger's"))
    found = {
        name: list(dict.fromkeys(one.name for one in look() if not one.holds))
        for name, look in planted(group).items()
    }
    for name, by in found.items():
        sys.stdout.write(f"{name}: {', '.join(by) or 'MISSED'}\n")
    seconds: dict[str, list[float]] = {}
    alarms: list[str] = []
    for seed in range(seeds):
        change_seed(seed)
        for name, look in parts.items():
            start = time.process_time()
            failed = [str(one) for one in look() if not one.holds]
            seconds.setdefault(name, []).append(time.process_time() - start)
            alarms += [f"seed {seed}, {name}: {one}" for one in failed]
        write(group, found, seconds, alarms, rows)
        sys.stdout.write(f"seed {seed}: {len(alarms)} alarms\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
