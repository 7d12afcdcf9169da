"""Texts of the pages that the site generates from the code: one for each plugin, and those of experiments and metrics.

They are written when the site is built (`docs/site_pages.py`). The page of a plugin needs its class, whose annotations
say the types and ranges of its settings.
"""

import inspect
import re
from functools import cache
from pathlib import Path

import yaml
from methods import ROOT, EntryPage, entries
from setting_tables import Setting, escape, plugin_settings, table, yaml_comments

from framework.configuration.registry import GROUPS, load
from framework.modes.plugins import Description, paper

ONE = {
    "data": "data set",
    "encoder": "encoder",
    "density_head": "density head",
    "uncertainty": "uncertainty wrapper",
    "objective": "objective",
    "renderer": "renderer",
    "metric": "metric",
}
SEVERAL = ("encoder", "uncertainty", "objective", "metric")
"""Registries from which an experiment chooses a list of plugins."""


def entry_page(entry: EntryPage) -> str:
    """Return the page of one entry point; links are relative to the README of its folder."""
    readme = readme_of(entry).partition("\n")[2].strip()
    settings = settings_of(entry, load(entry.group, entry.name))
    if settings and {row.key for row in settings} <= set(meanings_of(readme)):
        readme = without_settings(readme)
    choice = f"[{entry.name}]" if entry.group in SEVERAL else entry.name
    prefix = f"{entry.group}.{entry.name}" if entry.group in SEVERAL else entry.group
    parts = [
        f"# `{entry.name}`",
        f"*{ONE[entry.group].capitalize()}.* {escape(entry.description.summary)}",
        f"A command chooses it with `{entry.group}={choice}`, and tests it with "
        f"`python -m framework mode=check {entry.group}={choice}`.",
        _experiments(entry),
        "## Settings",
        f"A command sets a key with `{prefix}.<key>=<value>`.\n\n{table(settings)}"
        if settings
        else "It has no settings.",
        "## Description",
        _family(entry),
        deeper(readme),
        _measured(entry),
        _citation(entry.description),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def readme_of(entry: EntryPage) -> str:
    """Return the README of the folder of a plugin."""
    return (ROOT / entry.folder / "README.md").read_text(encoding="utf-8")


def settings_of(entry: EntryPage, cls: type) -> list[Setting]:
    """Return the settings of a plugin, with the defaults of its config file and the meanings of its README."""
    file = ROOT / entry.folder / "conf" / entry.group / f"{entry.name}.yaml"
    text = file.read_text(encoding="utf-8") if file.exists() else ""
    written = {
        key: value for key, value in (yaml.safe_load(text) or {}).items() if key not in ("name", "defaults")
    }
    return plugin_settings(cls, written, yaml_comments(text) | meanings_of(readme_of(entry)))


def _experiments(entry: EntryPage) -> str:
    names = [name for name, choices in experiments().items() if entry.name in choices.get(entry.group, ())]
    if not names:
        return ""
    shown = [name for name in re.findall(r"experiment=(\w+/\w+)", readme_of(entry)) if name in names]
    own = [name for name in names if name.endswith(f"/{entry.name}")]
    count = f" ({len(names)} experiments use it, see [experiments](site:reference/experiments.md))"
    return (
        f"An experiment that uses it{count if len(names) > 1 else ''}:\n\n"
        f"```bash\npython -m framework experiment={(shown + own + names)[0]}\n```"
    )


def _family(entry: EntryPage) -> str:
    others = [other for other in entries() if other.folder == entry.folder and other != entry]
    links = ", ".join(f"[`{other.name}`](site:{other.page})" for other in others)
    return (
        f"The plugins {links} and `{entry.name}` share code, and this text describes all of them."
        if others
        else ""
    )


def _measured(entry: EntryPage) -> str:
    uses = {name for name, choices in experiments().items() if entry.name in choices.get(entry.group, ())}
    own = {name for name in uses if name.endswith(f"/{entry.name}")}
    pages = []
    for path, text in results().items():
        named = re.search(rf"`{entry.name}`|\b{entry.group}=\[?{entry.name}\b", text)
        if named or own & set(re.findall(r"\b\w+/\w+\b", text)):
            title = text.partition("\n")[0].removeprefix("# ")
            pages.append(f"- [{title}](repo:{path.relative_to(ROOT).as_posix()})")
    return "## Measured results\n\nThese pages name it:\n\n" + "\n".join(pages) if pages else ""


def _citation(description: Description) -> str:
    return (
        f"## Citation\n\n```bibtex\n{description.bibtex.strip()}\n```" if description.bibtex.strip() else ""
    )


@cache
def results() -> dict[Path, str]:
    """Return the text of every committed page of results by its path."""
    paths = [*ROOT.glob("benchmarks/*/*.md"), *ROOT.glob("reproduction/*/*.md")]
    return {path: path.read_text(encoding="utf-8") for path in sorted(paths)}


@cache
def experiments() -> dict[str, dict[str, tuple[str, ...]]]:
    """Return the plugins that each experiment chooses, by registry, read from the files without composing them."""
    folder = ROOT / "conf/experiment"
    names = [path.relative_to(folder).with_suffix("").as_posix() for path in sorted(folder.glob("*/*.yaml"))]
    return {name: chosen(name) for name in names if not name.endswith("/base")}


@cache
def chosen(experiment: str) -> dict[str, tuple[str, ...]]:
    """Return the plugins that the defaults list of an experiment chooses, by registry."""
    config = yaml.safe_load((ROOT / f"conf/experiment/{experiment}.yaml").read_text(encoding="utf-8"))
    choices: dict[str, tuple[str, ...]] = {}
    for default in config.get("defaults", ()):
        if isinstance(default, str) and default != "_self_":
            choices |= chosen(default.removeprefix("/experiment/"))
        elif isinstance(default, dict):
            for key, value in default.items():
                group = key.removeprefix("override ").lstrip("/").partition("@")[0]
                if group in GROUPS and value:
                    choices[group] = (
                        *choices.get(group, ()) * ("@" in key),
                        *(value if isinstance(value, list) else [value]),
                    )
    return choices


def summary_of_experiment(experiment: str) -> str:
    """Return the comments at the top of an experiment's file, and the settings that its command contains.

    Raises:
        ValueError: The file has no comment that describes the experiment.
    """
    lines = (ROOT / f"conf/experiment/{experiment}.yaml").read_text(encoding="utf-8").splitlines()
    comments = [line.removeprefix("#").strip() for line in lines if line.startswith("#")]
    text = " ".join(line for line in comments if not line.startswith(("@package", "python -m")))
    if not text:
        raise ValueError(
            f"conf/experiment/{experiment}.yaml has no description. Write it as a comment below the command."
        )
    command = next((line for line in comments if line.startswith("python -m")), "")
    settings = command.partition(f"experiment={experiment}")[2].strip()
    text = f"{text.removesuffix('.')}. Settings: `{settings}`" if settings else text
    return escape(text).replace("|", "\\|")


def experiments_page() -> str:
    """Return the page that lists all experiments of the project."""
    parts = [
        "# Experiments",
        "An experiment is a file in `conf/experiment/` that names the parts of a run and their settings. "
        "`python -m framework experiment=<name>` runs it; if the table shows settings, add them to the command. Most "
        "data sets generate small synthetic data if no folder of real data is given. The experiments under `coil20`, "
        "`dales`, `images`, `labelled_points`, `tabular` and `uci` need files.",
    ]
    for folder in dict.fromkeys(name.partition("/")[0] for name in experiments()):
        rows = ["| experiment | what it is |", "|---|---|"]
        rows += [
            f"| `{name}` | {summary_of_experiment(name)} |"
            for name in experiments()
            if name.startswith(f"{folder}/")
        ]
        parts += [f"## {folder}", "\n".join(rows)]
    return "\n\n".join(parts) + "\n"


def metrics_page() -> str:
    """Return the page that defines all metrics."""
    parts = [
        "# Metrics",
        "`metric=[<name>,<name>]` chooses what a test computes. Each metric reads the predicted densities of the test "
        "split. A key that ends in `_sem` is the standard error of the key before it. An arrow says which direction is "
        "better: ↑ higher, ↓ lower.",
    ]
    for entry in entries():
        if entry.group != "metric":
            continue
        cls = load("metric", entry.name)
        docstring = re.split(r"\n(?:Args|Attributes|Raises|Returns):\n", inspect.getdoc(cls) or "")[0]
        arrows = {"higher": " ↑", "lower": " ↓"}
        columns = [
            f"`{key}` ({heading}{arrows.get(cls.better.get(key, ''), '')})"
            for key, heading in getattr(cls, "columns", {}).items()
        ]
        parts += [
            f"## [`{entry.name}`](site:{entry.page})",
            escape(docstring),
            f"**Columns of the table:** {', '.join(columns)}." if columns else "",
            f"**Source:** {paper(entry.description.bibtex)}." if paper(entry.description.bibtex) else "",
        ]
    return "\n\n".join(part for part in parts if part) + "\n"


def settings_table(readme: str) -> re.Match[str] | None:
    """Return the table of a README that explains the settings."""
    return re.search(r"(?m)^\| key \|.*\n\|[-:| ]+\n(?:\|.*\n?)+", readme)


def meanings_of(readme: str) -> dict[str, str]:
    """Return the meaning of each key in the table of settings of a README."""
    match = settings_table(readme)
    meanings = {}
    for line in match[0].splitlines()[2:] if match else ():
        cells = re.split(r"(?<!\\)\|", line)[1:-1]
        for key in re.findall(r"`([\w.]+)`", cells[0]):
            meanings[key] = cells[-1].strip()
    return meanings


def without_settings(readme: str) -> str:
    """Return a README without its table of settings."""
    match = settings_table(readme)
    return readme[: match.start()] + readme[match.end() :] if match else readme


def deeper(text: str) -> str:
    """Return Markdown with each heading one level deeper, outside of code blocks."""
    lines, fenced = [], False
    for line in text.splitlines():
        fenced ^= line.startswith("```")
        lines.append(f"#{line}" if re.match(r"##+ ", line) and not fenced else line)
    return "\n".join(lines)
