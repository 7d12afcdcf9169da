"""Write methods.md beside this file: every plugin of pyproject.toml, in one line each.

    python docs/methods.py

The line is the first of the class's docstring, as in `python -m framework mode=plugins`; no plugin is imported.
"""

import sys
import tomllib
from functools import cache
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import NamedTuple

from framework.configuration.registry import GROUPS
from framework.modes.plugins import Description, describe, paper

ROOT = Path(__file__).resolve().parent.parent
HEADINGS = {
    "data": "Data",
    "encoder": "Encoders",
    "density_head": "Density heads",
    "uncertainty": "Uncertainty wrappers",
    "objective": "Objectives",
    "renderer": "Renderers",
    "metric": "Metrics",
}
INTRODUCTION = """# Methods

This page lists every plugin of the project under the name that a command uses for it.
`python -m framework mode=plugins` prints the same list, and also the plugins of other installed packages. Each name
links to the README of the plugin's folder, which states its parameters, sources and limits. `python docs/methods.py`
writes this page.
"""


class EntryPage(NamedTuple):
    """Entry point with the name of its page.

    Attributes:
        group: Registry of the plugin.
        name: Name of the plugin.
        value: Module and class, as in pyproject.toml.
    """

    group: str
    name: str
    value: str

    @property
    def folder(self) -> Path:
        """Folder of the plugin, relative to the project's folder."""
        return Path(*self.value.partition(":")[0].split(".")[:3])

    @property
    def page(self) -> str:
        """Path of the page on the site."""
        return f"methods/{self.group}/{self.name}.md"

    @property
    def description(self) -> Description:
        """Summary and BibTeX of the class, read without importing it."""
        return describe(
            self.group, EntryPoint(name=self.name, value=self.value, group=f"framework.{self.group}")
        )


@cache
def entries() -> tuple[EntryPage, ...]:
    """Return all entry points of the project, by registry and name."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        groups = tomllib.load(file)["project"]["entry-points"]
    return tuple(
        EntryPage(group, name, groups[f"framework.{group}"][name])
        for group in GROUPS
        for name in sorted(groups[f"framework.{group}"])
    )


def page(*, of_site: bool = False) -> str:
    """Return the text of methods.md; on the site, each name leads to the page of its entry point."""
    parts = [
        INTRODUCTION.replace("the README of the plugin's folder", "the page of the plugin")
        if of_site
        else INTRODUCTION
    ]
    for group in GROUPS:
        rows = [row(entry, of_site=of_site) for entry in entries() if entry.group == group]
        table = "\n".join(["| name | what it is | source |", "|---|---|---|", *rows])
        parts.append(f"## {HEADINGS[group]} (`{group}`)\n\n{table}\n")
    return "\n".join(parts)


def row(entry: EntryPage, *, of_site: bool) -> str:
    """Return the line of one entry point."""
    description = entry.description
    first_name = next(
        other.name for other in entries() if (other.group, other.value) == (entry.group, entry.value)
    )
    summary = description.summary if first_name == entry.name else f"The same plugin as `{first_name}`."
    link = entry.page if of_site else f"../{entry.folder.as_posix()}/README.md"
    cells = (f"[`{entry.name}`]({link})", summary, paper(description.bibtex))
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


if __name__ == "__main__":
    (ROOT / "docs/methods.md").write_text(page(), encoding="utf-8")
    sys.stdout.write("docs/methods.md is written\n")
