"""Pages of results: where and when they were measured, how they are written, and their tables read back."""

import datetime
import platform
import re
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from framework.datasets.csv_columns import read_columns


def machine(*packages: str) -> str:
    """Return processor, date and versions, one line of Markdown."""
    processor = platform.processor() or "unknown processor"
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        text = cpuinfo.read_text()
        names = re.findall(r"^model name\s*:\s*(.*)$", text, re.MULTILINE)
        # the widest of them decides by how much float32 and bfloat16 differ
        widest = [each for each in ("avx512_bf16", "avx512f", "avx2") if re.search(rf"\b{each}\b", text)][:1]
        processor = ", ".join([names[0], f"{len(names)} cores", *widest]) if names else processor
    versions = ", ".join(f"{name} {version(name)}" for name in packages)
    return (
        f"{processor}; {datetime.date.today().isoformat()}; Python {platform.python_version()}, {versions}."
    )


def write_page(script: str | Path, text: str | Sequence[str], name: str = "") -> Path:
    """Write the page of a script beside it and return its path.

    Args:
        script: the script's `__file__`; the page has its name, with `.md`.
        text: the page, or its lines.
        name: stem of the page, where it is not the script's.
    """
    page = Path(script).resolve().with_suffix(".md")
    page = page.with_stem(name or page.stem)
    page.write_text((text if isinstance(text, str) else "\n".join(text)).rstrip() + "\n", encoding="utf-8")
    return page


def replace_section(page: Path, heading: str, text: str) -> None:
    """Replace what stands under a heading of a page, up to the next heading of its level or above.

    Raises:
        ValueError: the page has no such heading, or several.
    """
    lines = page.read_text(encoding="utf-8").splitlines()
    places = [number for number, line in enumerate(lines) if line == heading]
    if len(places) != 1:
        raise ValueError(f"{page} has {len(places)} lines {heading!r}; wanted one.")
    level = len(heading) - len(heading.lstrip("#"))
    first = places[0] + 1
    ends = (
        number
        for number in range(first, len(lines))
        if lines[number].startswith("#") and len(lines[number].split(" ")[0]) <= level
    )
    last = next(ends, len(lines))
    written = [*lines[:first], "", *text.strip().splitlines(), "", *lines[last:]]
    page.write_text("\n".join(written).rstrip() + "\n", encoding="utf-8")


def read_rows(table: Path) -> list[dict[str, object]]:
    """Return the rows that `framework.reports.table.write_csv` wrote, to draw a figure again without measuring.

    Values are numbers, words, True and False; an empty cell has no key.
    """
    cells = read_columns(table).cells
    lines = [dict(zip(cells, line, strict=True)) for line in zip(*cells.values(), strict=True)]
    return [{key: _value(cell) for key, cell in line.items() if cell} for line in lines]


def _value(cell: str) -> object:
    if cell in ("true", "false"):
        return cell == "true"
    try:
        return int(cell) if cell.lstrip("-").isdigit() else float(cell)
    except ValueError:
        return cell
