"""Count the planted faults that the contracts of the other groups find, and their false alarms.

    python -m benchmarks.framework.check_parts GROUP [seeds, 20 by default] [names ...]

GROUP is data, metric, encoder, renderer, uncertainty or objective. The planted faults are in tests/planted_*.py. False
alarms are counted over the rows of all plugins of the group and over correct plugins that are not part of this project
(RIGHT in tests/planted_*.py), with several random seeds. The results are written to check_<group>.md beside this file
after each seed. If names are given, only these plugins are tested, and only the page's last section is written. It is
about such a later run, and says its machine and date.
"""

import statistics
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import torch

from benchmarks.pages import machine, replace_section, write_page
from framework.configuration.registry import installed
from framework.testing import finding
from framework.testing.contract import contract
from framework.testing.data import examine_data
from framework.testing.encoders import examine_encoder
from framework.testing.finding import Finding
from framework.testing.metrics import examine_metric
from framework.testing.objectives import examine_objective
from framework.testing.plain import Plain
from framework.testing.renderers import examine_renderer
from framework.testing.rows import EncoderRow, MetricRow, ObjectiveRow, RendererRow, WrapperRow
from framework.testing.wrappers import examine_wrapper
from tests import (
    planted_data,
    planted_encoders,
    planted_metrics,
    planted_objectives,
    planted_renderers,
    planted_wrappers,
)

Examine = Callable[[], Iterator[Finding]]
LATER_RUN = "## Plugins tested in a later run"
"""Heading of the section about plugins that were added or changed after the run of the whole page."""


def planted_faults(group: str) -> dict[str, Examine]:
    """Return, for each planted fault of a group, a function that tests a plugin with this fault."""
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
    left_out = {
        fault.name: dict(planted_renderers.RIGHT["discs"][1]) if fault.by == "points" else {}
        for fault in planted_renderers.ALL_FAULTS
    }
    return {
        fault.name: lambda fault=fault: examine_renderer(
            RendererRow("", leave_out=left_out[fault.name]), fault.build
        )
        for fault in planted_renderers.ALL_FAULTS
    }


def external_plugins(group: str) -> dict[str, Examine]:
    """Return, for each correct plugin outside of this project, a function that tests it."""
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


def own_plugins(group: str, names: list[str]) -> dict[str, Examine]:
    """Return, for each plugin of a group, a function that tests all its rows."""

    def examine_rows(name: str) -> Iterator[Finding]:
        whole = contract(group, name)
        for row in whole.rows:
            yield from whole.findings(row)

    return {name: lambda name=name: examine_rows(name) for name in names or installed(group)}


def change_seed(seed: int) -> None:
    """Set the random seed of the tests in every module that has imported it."""
    before = finding.SEED
    for module in list(sys.modules.values()):
        if getattr(module, "SEED", None) == before and module.__name__.startswith(
            ("framework.testing", "plugins")
        ):
            module.SEED = seed  # pyright: ignore[reportAttributeAccessIssue]


def write(
    group: str,
    failed_properties: dict[str, list[str]],
    seconds: dict[str, list[float]],
    alarms: list[str],
    rows: int,
) -> None:
    """Write the page of a group.

    Args:
        group: Name of the group.
        failed_properties: Name of each planted fault, with the properties whose tests failed.
        seconds: Name of each correct plugin, with its processor time for each random seed.
        alarms: Description of each false alarm.
        rows: Number of rows of the plugins of this project.
    """
    seeds, external = max(map(len, seconds.values()), default=0), len(external_plugins(group))
    caught, count = sum(map(bool, failed_properties.values())), len(failed_properties)
    lines = [
        f"| {name} | {', '.join(properties) or '**missed**'} |"
        for name, properties in failed_properties.items()
    ]
    costs = [
        f"| {name} | {statistics.median(durations):.2f} | {min(durations):.2f} to {max(durations):.2f} |"
        for name, durations in sorted(seconds.items(), key=lambda item: -statistics.median(item[1]))
    ]
    write_page(
        __file__,
        f"""# What `mode=check` finds in plugins of the registry `{group}`

This page shows how well `mode=check` finds errors in plugins of the registry `{group}`. The benchmark counts two
things: the planted faults that `mode=check` finds, and its false alarms. A planted fault is a known error that is put
into a correct plugin. A false alarm is a failed test of a correct plugin.

## Planted faults

`mode=check` found {caught} of {count} planted faults ({100 * caught / max(count, 1):.1f} %).

The table lists the planted faults. For each row, one thing is changed in a correct plugin of the registry `{group}`.
The column `fault` names the change, and `failed properties` lists every property whose test by `mode=check` failed.

| fault | failed properties |
| --- | --- |
{chr(10).join(lines)}

## False alarms

The number of false alarms of `mode=check`, which are failed tests of correct plugins, is {len(alarms)}. `mode=check`
tested {rows} constructions of the plugins of this project and {external} correct
{"plugin" if external == 1 else "plugins"} that {"is" if external == 1 else "are"} not part of it, with {seeds} random
seeds each.

{chr(10).join(f"- {alarm}" for alarm in alarms)}

## Run time

The table shows the processor time that `mode=check` needs on one thread to test a plugin of the registry `{group}` in
all its constructions. It holds the median and the range over the random seeds. Other processes ran on the machine at
the same time.

| plugin | median, s | range, s |
| --- | --- | --- |
{chr(10).join(costs)}

{machine("torch", "numpy")} Command: `python -m benchmarks.framework.check_parts {group}`.
""".replace("\n\n\n\n", "\n\n"),
        f"check_{group}",
    )


def write_later_run(page: Path, group: str, names: list[str], seeds: int, command: str) -> None:
    """Test some plugins of a group with several random seeds, and write the section LATER_RUN after each seed.

    Args:
        page: Page of the group.
        group: Name of the group.
        names: Names of the plugins.
        seeds: Number of random seeds.
        command: Command that ran this script, for the page.
    """
    if LATER_RUN not in page.read_text(encoding="utf-8").splitlines():
        page.write_text(page.read_text(encoding="utf-8") + f"\n{LATER_RUN}\n", encoding="utf-8")
    seconds: dict[str, list[float]] = {name: [] for name in names}
    alarms: dict[str, list[str]] = {name: [] for name in names}
    for seed in range(seeds):
        change_seed(seed)
        for name, examine in own_plugins(group, names).items():
            start = time.process_time()
            failed = [f"- seed {seed}, {name}: {result}" for result in examine() if not result.holds]
            seconds[name].append(time.process_time() - start)
            alarms[name] += failed
        rows = [
            f"| {name} | {len(contract(group, name).rows)} | {seed + 1} | {len(alarms[name])} | "
            f"{statistics.median(durations):.2f} | {min(durations):.2f} to {max(durations):.2f} |"
            for name, durations in seconds.items()
        ]
        text = f"""
These plugins were added or changed after the run that the sections above describe, and were tested in a run of their
own. For these plugins, the table replaces what the sections above say. The processor time is that of one thread for all
constructions, with the median and the range over the random seeds. Other processes ran on the machine at the same time.

| plugin | constructions | seeds | false alarms | median, s | range, s |
| --- | --- | --- | --- | --- | --- |
{chr(10).join(rows)}

{chr(10).join(alarm for part in alarms.values() for alarm in part)}

{machine("torch", "numpy")} Command: `{command}`.
"""
        replace_section(page, LATER_RUN, text.replace("\n\n\n\n", "\n\n"))
        sys.stdout.write(f"seed {seed}: {sum(map(len, alarms.values()))} alarms\n")
        sys.stdout.flush()


def main() -> None:
    torch.set_num_threads(1)
    group, seeds = sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 20
    if names := sys.argv[3:]:
        page = Path(__file__).with_name(f"check_{group}.md")
        command = f"python -m benchmarks.framework.check_parts {group} {seeds} {' '.join(names)}"
        write_later_run(page, group, names, seeds, command)
        return
    plugins = {
        **own_plugins(group, []),
        **{f"external: {name}": examine for name, examine in external_plugins(group).items()},
    }
    rows = sum(len(contract(group, name).rows) for name in plugins if not name.startswith("external: "))
    failed_properties = {
        name: list(dict.fromkeys(result.name for result in examine() if not result.holds))
        for name, examine in planted_faults(group).items()
    }
    for name, properties in failed_properties.items():
        sys.stdout.write(f"{name}: {', '.join(properties) or 'MISSED'}\n")
    seconds: dict[str, list[float]] = {}
    alarms: list[str] = []
    for seed in range(seeds):
        change_seed(seed)
        for name, examine in plugins.items():
            start = time.process_time()
            failed = [str(result) for result in examine() if not result.holds]
            seconds.setdefault(name, []).append(time.process_time() - start)
            alarms += [f"seed {seed}, {name}: {result}" for result in failed]
        write(group, failed_properties, seconds, alarms, rows)
        sys.stdout.write(f"seed {seed}: {len(alarms)} alarms\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
