"""Reads a committed table back, so that its picture can be drawn anew without measuring anew."""

from pathlib import Path

from framework.datasets.csv_columns import read_columns


def rows(table: Path) -> list[dict[str, object]]:
    """The rows that `framework.reports.table.csv` wrote: numbers, words, True and False; an empty cell has no key."""
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
