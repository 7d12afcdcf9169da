"""Write methods.md beside this file: every plugin of pyproject.toml, in one line each.

    python docs/methods.py

The line is the first of the class's docstring, as in `python -m framework mode=plugins`; no plugin is imported.
"""

import sys
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

from framework.configuration.registry import GROUPS
from framework.modes.plugins import describe, paper

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


def page() -> str:
    """Return the text of methods.md."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        entry_points = tomllib.load(file)["project"]["entry-points"]
    parts = [INTRODUCTION]
    for group in GROUPS:
        names = entry_points[f"framework.{group}"]
        rows = [row(group, name, names[name]) for name in sorted(names)]
        table = "\n".join(["| name | what it is | source |", "|---|---|---|", *rows])
        parts.append(f"## {HEADINGS[group]} (`{group}`)\n\n{table}\n")
    return "\n".join(parts)


def row(group: str, name: str, value: str) -> str:
    """Return the line of one entry point."""
    description = describe(group, EntryPoint(name=name, value=value, group=f"framework.{group}"))
    folder = Path(*value.partition(":")[0].split(".")[:3])
    cells = (f"[`{name}`](../{folder.as_posix()}/README.md)", description.summary, paper(description.bibtex))
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


if __name__ == "__main__":
    (ROOT / "docs/methods.md").write_text(page(), encoding="utf-8")
    sys.stdout.write("docs/methods.md is written\n")
