"""Pages of results: the line about the machine and the date, writing pages, and reading tables of results."""

import datetime
import platform
import re
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path

from framework.datasets.csv_columns import read_columns


def machine(*packages: str) -> str:
    """Return a sentence on where and when a page was measured: see `environment`."""
    return f"Measured on {environment(*packages)}"


def environment(*packages: str) -> str:
    """Return one line with the processor, the date and the versions of Python and of these packages."""
    processor = platform.processor() or "unknown processor"
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        text = cpuinfo.read_text()
        names = re.findall(r"^model name\s*:\s*(.*)$", text, re.MULTILINE)
        # the widest instruction set of the processor determines how much float32 and bfloat16 results differ
        instruction_sets = ("avx512_bf16", "avx512f", "avx2")
        widest = [name for name in instruction_sets if re.search(rf"\b{name}\b", text)][:1]
        processor = ", ".join([names[0], f"{len(names)} cores", *widest]) if names else processor
    versions = ", ".join(f"{name} {version(name)}" for name in packages)
    return (
        f"{processor}; {datetime.date.today().isoformat()}; Python {platform.python_version()}, {versions}."
    )


def write_page(script: str | Path, text: str | Sequence[str], name: str = "") -> Path:
    """Write the page of a script into the script's folder and return the path of the page.

    Args:
        script: `__file__` of the script; the page has the same name with the suffix `.md`.
        text: the text of the page, or its lines.
        name: name of the page without suffix, if it differs from the script's.
    """
    page = Path(script).resolve().with_suffix(".md")
    page = page.with_stem(name or page.stem)
    page.write_text((text if isinstance(text, str) else "\n".join(text)).rstrip() + "\n", encoding="utf-8")
    return page


def publish(script: str | Path, text: str, name: str = "") -> None:
    """Write the page of a script (see `write_page`), and print its text."""
    write_page(script, text, name)
    sys.stdout.write(text)


def run_or_draw(run: Callable[[], object], draw: Callable[[], object]) -> None:
    """Run a script, or only draw its figures again if the argument of the script is `--draw`."""
    if sys.argv[1:] == ["--draw"]:
        draw()
    else:
        run()


def replace_section(page: Path, heading: str, text: str) -> None:
    """Replace the text under a heading of a page, up to the next heading of the same or a higher level.

    Raises:
        ValueError: the page does not have the heading exactly once.
    """
    lines = page.read_text(encoding="utf-8").splitlines()
    headings = [number for number, line in enumerate(lines) if line == heading]
    if len(headings) != 1:
        raise ValueError(
            f"{page} has {len(headings)} lines {heading!r}, but exactly one is required. Run the script without "
            "options, which writes the whole page."
        )
    level = len(heading) - len(heading.lstrip("#"))
    first = headings[0] + 1
    ends = (
        number
        for number in range(first, len(lines))
        if lines[number].startswith("#") and len(lines[number].split(" ")[0]) <= level
    )
    last = next(ends, len(lines))
    written = [*lines[:first], "", *text.strip().splitlines(), "", *lines[last:]]
    page.write_text("\n".join(written).rstrip() + "\n", encoding="utf-8")


def read_rows(table: Path) -> list[dict[str, object]]:
    """Return the rows of a CSV file that `framework.reports.table.write_csv` wrote, to draw a figure again.

    Values are numbers, texts, True and False; for an empty cell the row has no key.
    """
    cells = read_columns(table).cells
    lines = [dict(zip(cells, line, strict=True)) for line in zip(*cells.values(), strict=True)]
    return [{key: _parse_cell(cell) for key, cell in line.items() if cell} for line in lines]


def _parse_cell(cell: str) -> object:
    if cell in ("true", "false"):
        return cell == "true"
    try:
        return int(cell) if cell.lstrip("-").isdigit() else float(cell)
    except ValueError:
        return cell
