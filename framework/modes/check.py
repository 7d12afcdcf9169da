"""mode=check: test whether plugins satisfy their contract, also in extreme cases, and fail if one does not."""

import math
import time
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from rich import box
from rich.console import Console, Group
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from framework.configuration.config import Config, Options
from framework.configuration.registry import load
from framework.configuration.settings import Settings
from framework.configuration.signature import untyped
from framework.errors import ConfigError, UserError, count_of
from framework.reports.table import write_csv
from framework.storage.log_messages import log_each_message_once
from framework.storage.progress import PlainConsole
from framework.testing.contract import CONTRACTS, Contract, Row, contract
from framework.testing.finding import Finding, describe_error
from framework.testing.rows import HeadRow

COLUMNS = {
    "plugin": "plugin",
    "row": "row",
    "property": "property",
    "worst": "worst case",
    "error": "error",
    "limit": "limit",
    "verdict": "verdict",
}

UNCOMPARED = (
    "rows.py provides no independent log-densities. Only integral, samples, loss and float32 were compared with "
    "log_prob; they also agree if the head interprets its parameters wrongly"
)


class ContractBroken(UserError):
    """Error for a plugin that breaks the contract of its registry."""


def run(config: Config) -> None:
    """Check every plugin chosen on the command line, and print a table for each.

    Raises:
        ConfigError: No plugin with a contract is chosen.
        ContractBroken: A property does not hold; the table names the property and the case.
    """
    config.options(Options)
    # the tensors of most checks are too small for several threads, which would only add processor time
    torch.set_num_threads(config.settings.threads or 1)
    chosen = _chosen_plugins(config.settings)
    if not chosen:
        raise ConfigError(
            "mode=check needs a plugin, but none is chosen. Add one, for example `mode=check density_head=<name>`. "
            f"There are contracts for {', '.join(CONTRACTS)}; mode=plugins lists the installed plugins."
        )
    console, lines, failed = PlainConsole(), [], []
    for group, part in chosen:
        plain = {key: value for key, value in part.items() if key != "name"}
        try:
            report, findings, broken = examine(contract(group, part["name"], plain), console)
        except UserError:
            raise
        except Exception as error:  # such as an error of the constructor
            raise ContractBroken(
                f"The {group} {part['name']!r} cannot be checked, because it cannot be built: {describe_error(error)}. "
                "Mend this line."
            ) from error
        console.print(report)
        if note := describe_untyped(group, part["name"]):
            console.print(note, soft_wrap=True)
        lines += findings
        failed += broken
    config.folder.mkdir(parents=True, exist_ok=True)
    write_csv(lines, COLUMNS, config.folder / "check.csv")
    console.print(f"all findings, with the worst case of each: {config.folder / 'check.csv'}", soft_wrap=True)
    if failed:
        raise ContractBroken(
            f"{len(failed)} of {len(lines)} checks failed: {_listed(dict.fromkeys(failed))}. The lines that begin with "
            "FAILS name the cases; begin with the first, which may cause the others. The docstring of the base class "
            "in framework/ states the contract."
        )


def _listed(names: Iterable[str], most: int = 6) -> str:
    """Return the first `most` names, and the number of the others."""
    first = list(names)
    more = f" and {len(first) - most} more" if len(first) > most else ""
    return ", ".join(first[:most]) + more


def describe_untyped(group: str, name: str) -> str:
    """Return a note about the parameters of a plugin's constructor that have no annotation; "" if all have one."""
    names = untyped(load(group, name))
    if not names:
        return ""
    return (
        f"note: {group} {name}: the parameters {', '.join(names)} have no annotation, so that a value is compared at "
        "most with the type of the default. Annotate them with their types and ranges, which are checked before any "
        "data are read."
    )


@log_each_message_once()
def examine(plugin: Contract, console: Console) -> tuple[Group, list[dict[str, object]], list[str]]:
    """Return a plugin's report (worst case of each tested property), all test results, and the failed properties."""
    start = time.perf_counter()
    worst: dict[str, tuple[Row, Finding]] = {}
    lines: list[dict[str, object]] = []
    failed: list[str] = []
    for row in plugin.rows:
        with console.status(f"{plugin.group} {plugin.name}: {row.name}"):
            for finding in plugin.findings(row):
                lines.append(_line(plugin, row, finding))
                if not finding.holds:
                    failed.append(f"{plugin.name}: {finding.name}")
                before = worst.get(finding.name)
                if before is None or _excess(finding) > _excess(before[1]):
                    worst[finding.name] = (row, finding)
    seconds = time.perf_counter() - start
    return _report(plugin, worst, seconds), lines, failed


def _chosen_plugins(settings: Settings) -> list[tuple[str, Mapping[str, Any]]]:
    """Return registry and config of every chosen plugin that has a contract."""
    plugins = []
    for group in CONTRACTS:
        config = getattr(settings, group)
        if not config:
            continue
        parts = [config] if "name" in config else list(config.values())
        plugins += [(group, part) for part in parts]
    return plugins


def _excess(finding: Finding) -> tuple[bool, float]:
    """Return a sort key for test results: first whether the property failed, then the ratio of error to limit."""
    error = math.inf if math.isnan(finding.error) else finding.error
    return not finding.holds, error / finding.limit if finding.limit > 0 else error


def _line(plugin: Contract, row: Row, finding: Finding) -> dict[str, object]:
    return {
        "plugin": f"{plugin.group} {plugin.name}",
        "row": row.name,
        "property": finding.name,
        "worst": finding.worst,
        "error": finding.error,
        "limit": finding.limit,
        "verdict": "holds" if finding.holds else "FAILS",
    }


def _report(plugin: Contract, worst: Mapping[str, tuple[Row, Finding]], seconds: float) -> Group:
    """Return the table of all properties, and below it the case of each failure and what was not checked."""
    count = count_of(len(plugin.rows), "row")
    title = f"{plugin.group} {plugin.name}: {count}, {seconds:.1f} s"
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left")
    table.add_column("property", overflow="fold")
    for heading in ("error", "limit"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("verdict", no_wrap=True)
    notes: list[tuple[str, str, str]] = []
    failures: dict[str, list[str]] = {}
    for name, (row, finding) in worst.items():
        verdict = Text("holds", "green") if finding.holds else Text("FAILS", "bold red")
        table.add_row(name, f"{finding.error:.2g}", f"{finding.limit:g}", verdict)
        if not finding.holds:
            failures.setdefault(f"{row.name}: {finding.worst}", []).append(name)
    notes += [("FAILS", "bold red", f"{', '.join(names)}: {case}") for case, names in failures.items()]
    reasons: dict[str, list[str]] = {}
    for row in plugin.rows:
        for name, reason in row.leave_out.items():
            if name not in worst and name not in reasons.setdefault(reason, []):
                reasons[reason].append(name)
    notes += [
        ("left out", "yellow", f"{', '.join(names)}: {reason}") for reason, names in reasons.items() if names
    ]
    uncompared = [row.name for row in plugin.rows if isinstance(row, HeadRow) and row.cases is None]
    if uncompared:
        notes.append(("no reference", "yellow", f"{', '.join(uncompared)}: {UNCOMPARED}"))
    return Group(table, *(_note(*note) for note in notes))


def _note(label: str, style: str, text: str) -> Padding:
    """Return a labelled line; its continuation lines are indented."""
    grid = Table.grid(padding=(0, 2, 0, 0))
    grid.add_column(no_wrap=True)
    grid.add_column(overflow="fold")
    grid.add_row(Text(label, style), Text(text))
    return Padding(grid, (0, 0, 0, 2))
