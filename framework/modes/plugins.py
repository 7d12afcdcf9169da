"""mode=plugins: every registry with origin, a line of description and the paper; imports no plugin."""

import re
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from framework.configuration.registry import GROUPS, describe, installed
from framework.configuration.settings import Settings


def run(values: dict[str, Any], settings: Settings, folder: Path, overrides: list[str]) -> None:
    """Print the list."""
    show()


def show() -> None:
    """Print every registry: name, what it is, the paper, and the package it comes from."""
    console = Console(highlight=False)
    for group in GROUPS:
        console.print(Text(group, style="bold"))
        for entry in installed(group).values():
            told = describe(group, entry)
            console.print(Padding(Text.assemble((told.name, "cyan"), "  ", told.summary), (0, 0, 0, 2)))
            source = " · ".join(filter(None, (paper(told.bibtex), told.origin)))
            console.print(Padding(Text(source, style="dim"), (0, 0, 0, 6)))
        if not installed(group):
            console.print("  (none installed)")


def paper(bibtex: str) -> str:
    """'Author et al. 2015, Title' out of a BibTeX entry; nothing out of nothing."""
    if not bibtex.strip():
        return ""
    authors = _value(bibtex, "author").split(" and ")
    first = authors[0].partition(",")[0] if "," in authors[0] else authors[0].split(" ")[-1]
    name = f"{first} et al." if len(authors) > 1 else first
    return f"{name} {_value(bibtex, 'year')}, {_value(bibtex, 'title')}"


def _value(bibtex: str, key: str) -> str:
    found = re.search(rf"\b{key}\s*=\s*[{{\"]+(.*?)[}}\"]+\s*,?\s*(?:\n|$)", bibtex, re.DOTALL)
    return re.sub(r"[{}]", "", " ".join(found.group(1).split())) if found else ""
