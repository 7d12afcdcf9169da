"""Report on a run or a sweep: a self-contained HTML page, and its table in Markdown and LaTeX."""

import io
import math
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from framework.errors import ConfigError, DataError, count_of, escape_undecodable, escape_unprintable, shorten
from framework.evaluation.pareto import NOISE, TIME_NOISE, front
from framework.evaluation.significance import ROUNDING, holm, mean, paired_difference
from framework.reports.page import PNG, folded, page, paragraph, picture, plain_table, preformatted, wide
from framework.reports.table import COST_COLUMNS, format_number, html, latex, machine, markdown
from framework.runs.job import find_job_folders, read_record
from framework.storage.enclosed import read_plain, require_enclosed
from framework.storage.files import write_whole
from framework.sweeps.results import (
    Comparison,
    compare,
    comparison_figure,
    headline,
    job_results,
    row_names,
    run_results,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LARGEST_PAGE = 9_000_000
"""Size of a page, bytes, beyond which further figures are left out, so that a browser opens it soon."""
LARGEST_FIGURE = 4_000_000
NO_NOTES = ("threads:", "reads ", "samples:", "draws ", "compiling functions", "features of ", " ")
"""Beginnings of lines that a run prints before training and that the page does not show as notes.

The last one, a blank, is the beginning of each line of a table.
"""
PROGRESS = re.compile(r": \d+ of \d+ \w+ in \d+ s$")
"""End of a line that reports progress of long work (`framework.storage.progress.Work`)."""
NAMES = ("report.html", "report.md", "report.tex")


@dataclass(frozen=True)
class Failed:
    """Job of a sweep without results: its overrides, its status, and the error message."""

    overrides: str
    status: str
    error: str


def write_report(folder: Path, into: Path) -> list[Path]:
    """Write the report on a run or a sweep, and return the files.

    Args:
        folder: folder of a run or a sweep, which may come from an untrusted source.
        into: folder of the report.

    Raises:
        ConfigError: the folder holds no results.
        DataError: a file of the folder is damaged, or is a link.
    """
    require_enclosed(folder)
    if (folder / "results.json").is_file():
        results, failed = run_results(folder), []
    else:
        jobs = find_job_folders(folder)
        results, failed = job_results(jobs), failed_jobs(jobs)
    compared = compare(results)
    if compared is None:
        raise ConfigError(
            f"{shorten(folder)} holds no results of a test. Give the folder of a run with results.json, or of a sweep "
            "with at least one such run."
        )
    into.mkdir(parents=True, exist_ok=True)
    require_enclosed(into)
    return save_report(folder, compared, failed, comparison_figure(compared), into)


def save_report(
    folder: Path, compared: Comparison, failed: Sequence[Failed], figure: "Figure | None", into: Path
) -> list[Path]:
    """Write a report and return its files.

    Args:
        folder: folder of the run or sweep, whose name is the title.
        compared: results of the runs.
        failed: jobs without results.
        figure: figure of the comparison (`comparison_figure`).
        into: folder of the report.
    """
    rows, columns, better = compared.rows, compared.columns, compared.better
    contents = (
        _page(folder, compared, failed, figure),
        markdown(rows, columns, better=better),
        latex(rows, columns, better=better),
    )
    files = [into / name for name in NAMES]
    for path, content in zip(files, contents, strict=True):
        write_whole(path, escape_undecodable(content).encode())
    return files


def failed_jobs(jobs: Sequence[Path]) -> list[Failed]:
    """Return the jobs of a sweep that did not complete."""
    return list(_failed(jobs))


def _failed(jobs: Sequence[Path]) -> Iterator[Failed]:
    for job in jobs:
        record = read_record(job)
        status = str(record.get("status", ""))
        if status != "completed":
            overrides = escape_unprintable(" ".join(map(str, record["overrides"])), allowed="")
            yield Failed(overrides, status, escape_unprintable(str(record.get("error") or ""), allowed=""))


def _page(folder: Path, compared: Comparison, failed: Sequence[Failed], figure: "Figure | None") -> str:
    runs, rows = compared.runs, compared.rows
    seeds = list(dict.fromkeys(str(run["seed"]) for run in runs if run.get("seed") is not None))
    facts = [
        count_of(len(runs), "run"),
        f"{len(rows)} rows" if len(rows) > 1 else "",
        f"seed{'s' * (len(seeds) > 1)} {', '.join(seeds)}" if seeds else "",
    ]
    data = ", ".join(dict.fromkeys(str(row["data"]) for row in rows))
    introduction = paragraph(f"Data: {data}. {'; '.join(filter(None, facts))}.")
    synthetic = [bool(row.get("synthetic")) for row in rows]
    if any(synthetic):
        some = "All data of this report are" if all(synthetic) else "Some data of this report are"
        introduction += f'<p class="synthetic">{some} synthetic (generated).</p>'
    return page(
        f"Report on {folder.resolve().name}",
        [
            ("Results", _results(compared)),
            ("Differences from the best row", _differences(compared)),
            ("Error against run time", _trade_off(compared, figure)),
            ("Figures of the runs", _figures(compared)),
            ("Jobs without results", _failures(failed)),
            ("Notes of the runs", _notes(runs)),
            ("How to repeat it", _provenance(runs)),
            ("What to cite", _citations(runs)),
        ],
        introduction=introduction,
    )


def _results(compared: Comparison) -> str:
    rows, columns = compared.rows, dict(compared.columns)
    if len({row["data"] for row in rows}) == 1:  # the introduction names the data
        columns.pop("data", None)
    table = wide(html(rows, columns, better=compared.better))
    groups = ""
    if len(compared.runs) == 1 and isinstance(compared.runs[0].get("groups"), Mapping):
        run = compared.runs[0]
        parts = [
            {**values, "method": escape_unprintable(name, allowed="")}
            for name, values in run["groups"].items()
            if isinstance(values, Mapping)
        ]
        keys = {
            key: head
            for key, head in columns.items()
            if key == "method" or any(key in part for part in parts)
        }
        groups = wide(html(parts, {**keys, "method": "group"})) if len(parts) > 1 else ""
    return f"{table}{paragraph('↑: higher is better; ↓: lower is better. Click a heading to sort.')}{groups}"


def _differences(compared: Comparison) -> str:
    """Return a table, as HTML, of the differences of each row from the best row, paired by seed.

    The best row has the best number of the key that `headline` returns. It is chosen by the numbers that are tested, so
    the pairs of rows without it count among the tests: of all pairs of equal rows, this choice shows the largest
    differences. The result is "" if there is only one row, and a sentence if no two rows have two seeds in common.
    """
    key = headline(compared)
    if key is None or len(compared.rows) < 2:
        return ""
    names = row_names(compared)
    sign = 1 if compared.better[key] == "higher" else -1
    values = [sign * float(row[key]) if row[key] is not None else -math.inf for row in compared.rows]
    best = max(
        range(len(values)), key=lambda index: -math.inf if math.isnan(values[index]) else values[index]
    )
    keys = [name for name in compared.better if name in compared.columns and name not in COST_COLUMNS]
    others = [index for index in range(len(names)) if index != best]
    runs = [_by_seed(compared, row) for row in compared.rows]
    shared = [[seed for seed in runs[index] if seed in runs[best]] for index in others]
    if all(len(seeds) < 2 for seeds in shared):
        return paragraph(
            "Not available: a paired test needs at least two seeds that both rows have. Add `seed=0,1,2` to the sweep."
        )
    columns: list[list[str]] = []
    for name in keys:
        differences = [
            paired_difference(
                *([_number(runs[row][seed].get(name)) for seed in seeds] for row in (index, best))
            )
            for index, seeds in zip(others, shared, strict=True)
        ]
        tested = sum(not math.isnan(difference.probability) for difference in differences)
        corrected = holm([difference.probability for difference in differences], math.comb(tested, 2))
        columns.append(
            [
                f"{format_number(difference.value, difference.standard_error)}{' *' if p <= 0.05 else ''}"
                for difference, p in zip(differences, corrected, strict=True)
            ]
        )
    lines = [
        [names[index], str(len(seeds)), *cells]
        for index, seeds, *cells in zip(others, shared, *columns, strict=True)
    ]
    caption = (
        "± standard error over seeds; * significant at 5 % by Student's t-test for pairs, with Holm's correction over "
        f"all pairs of rows; a difference of at most {ROUNDING:.0e} times the numbers counts as rounding"
    )
    heads = ["row", "seeds", *(compared.columns[name] for name in keys)]
    return paragraph(
        f"Each number is that of a row minus that of “{names[best]}”, which has the best {compared.columns[key]}, with "
        "the same seed."
    ) + plain_table(heads, lines, caption)


def _by_seed(compared: Comparison, row: Mapping[str, Any]) -> dict[object, Mapping[str, Any]]:
    """Return the runs of a row by their seed."""
    return {
        run.get("seed"): run
        for run in compared.runs
        if all(run.get(key) == row.get(key) for key in compared.by)
        and bool(run.get("synthetic")) == bool(row.get("synthetic"))
    }


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan


def _trade_off(compared: Comparison, figure: "Figure | None") -> str:
    key, time = headline(compared), "milliseconds_per_sample"
    if (
        key is None
        or figure is None
        or len(compared.rows) < 2
        or any(row.get(time) is None for row in compared.rows)
    ):
        return ""
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=110)
    sign = -1 if compared.better[key] == "higher" else 1
    means = [mean(row, key, row.get("n")) for row in compared.rows]
    means = [type(item)(sign * item.value, item.standard_error, item.degrees, item.source) for item in means]
    on_front = front(means, [float(row[time]) for row in compared.rows], TIME_NOISE)
    best = [name for name, is_best in zip(row_names(compared), on_front, strict=True) if is_best]
    text = (
        f"On the front, where no other row is both better and faster: {'; '.join(best)} ({NOISE})."
        if best
        else "The front is not available, because a standard error is not known. Add `seed=0,1,2` to the sweep."
    )
    return picture(png.getvalue(), f"{compared.columns[key]} against run time") + paragraph(text)


def _figures(compared: Comparison) -> str:
    """Return, as HTML, the figures of the first run of each row of the table."""
    left, parts, omitted = LARGEST_PAGE * 3 // 4, [], 0  # base64 makes four bytes of three
    for name, row in zip(row_names(compared), compared.rows, strict=True):
        run = next(iter(_by_seed(compared, row).values()))
        images = []
        for path in _figure_files(Path(run["folder"])):
            try:
                png = read_plain(path, LARGEST_FIGURE)
            except (DataError, OSError):
                omitted += 1
                continue
            if not png.startswith(PNG) or len(png) > left:
                omitted += 1
                continue
            left -= len(png)
            images.append(picture(png, f"{name}: {path.stem.replace('_', ' ')}"))
        if images:
            seed = f", seed {run['seed']}" if run.get("seed") is not None else ""
            parts.append(folded(f"{name}{seed}", "\n".join(images), opened=len(compared.rows) == 1))
    note = f"{count_of(omitted, 'figure')} not embedded (no PNG, or too large); see the folders of the runs."
    return "".join(parts) + (paragraph(note) if omitted else "")


def _figure_files(run: Path) -> list[Path]:
    files = [path for path in (run / "figures").glob("*") if path.suffix in (".png", ".pdf", ".svg")]
    return sorted(files, key=lambda path: (path.stem == "training_curve", path.name))


def _failures(failed: Sequence[Failed]) -> str:
    if not failed:
        return ""
    rows = [[job.overrides, job.status, shorten(job.error)] for job in failed]
    return plain_table(["job", "status", "error"], rows)


def _notes(runs: Sequence[Mapping[str, Any]]) -> str:
    """Return, as HTML, the notes that the runs printed before training, and the warnings that they printed at any time.

    Equal lines of several runs appear once, with the number of these runs.
    """
    counts: dict[str, int] = {}
    for run in runs:
        path = Path(run["folder"]) / "console.log"
        try:
            text = read_plain(path, 2**22).decode(errors="replace")
        except (DataError, OSError):
            continue
        lines = text.splitlines()
        first = lines[: next((i for i, line in enumerate(lines) if line.startswith("run folder:")), 0)]
        notes = [line for line in first if not line.startswith(NO_NOTES) and not PROGRESS.search(line)]
        notes += [line for line in lines if "warning" in line.lower()]
        for line in dict.fromkeys(notes):
            counts[line] = counts.get(line, 0) + 1
    lines = [
        f"{escape_unprintable(line, allowed='')}   ({count} of {count_of(len(runs), 'run')})"
        for line, count in counts.items()
    ]
    return "".join(map(paragraph, lines[:200]))


def _provenance(runs: Sequence[Mapping[str, Any]]) -> str:
    commands = [
        "python -m framework " + " ".join(shlex.quote(str(word)) for word in run["overrides"]) for run in runs
    ]
    machines = dict.fromkeys(machine(run["device"], run.get("threads")) for run in runs if run.get("device"))
    versions = dict.fromkeys(
        ", ".join(f"{name} {version}" for name, version in run["versions"].items())
        for run in runs
        if isinstance(run.get("versions"), Mapping)
    )
    parts = [
        paragraph(f"Run times were measured on {'; '.join(machines)}.") if machines else "",
        *(paragraph(f"Versions: {escape_unprintable(line, allowed='')}.") for line in versions),
        preformatted("\n".join(dict.fromkeys(commands))),
    ]
    return "".join(parts)


def _citations(runs: Sequence[Mapping[str, Any]]) -> str:
    entries: dict[str, None] = {}
    for run in runs:
        try:
            text = read_plain(Path(run["folder"]) / "citations.bib", 2**20).decode(errors="replace")
        except (DataError, OSError):
            continue
        text = escape_unprintable(text)
        entries.update(dict.fromkeys(entry.strip() for entry in text.split("\n\n") if entry.strip()))
    return folded("BibTeX", preformatted("\n\n".join(entries))) if entries else ""
