"""mode=plugins: list the plugins of every registry with description, paper and origin, without importing any."""

import ast
import re
import unicodedata
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from rich.padding import Padding
from rich.text import Text

from framework import __version__
from framework.configuration.citations import look_up
from framework.configuration.config import Config, Options
from framework.configuration.registry import GROUPS, Entry, installed, origin, package_folders, unusable_names
from framework.errors import ConfigError, shorten
from framework.storage.progress import PlainConsole

OWN_PACKAGE = f"robust-visual-learning {__version__}"
"""Name and version of the package of this project, as `origin` returns them."""


def run(config: Config) -> None:
    """Print the list of plugins."""
    config.options(Options)
    print_plugins()


def print_plugins() -> None:
    """Print every registry with the name, description and paper of each plugin, and the packages of other projects."""
    console = PlainConsole(highlight=False)
    console.print(Text(f"From {OWN_PACKAGE}, unless a line names another package:", style="dim"))
    for group in GROUPS:
        console.print(Text(group, style="bold"))
        first_names = names_by_value(installed(group).values())
        for entry in installed(group).values():
            if first_names[entry.value] != entry.name:
                _print_indented(console, entry.name, f"The same plugin as {first_names[entry.value]}.")
                continue
            plugin = describe(group, entry)
            _print_indented(console, plugin.name, plugin.summary)
            package = "" if plugin.origin == OWN_PACKAGE else plugin.origin
            source = " · ".join(filter(None, (paper(plugin.bibtex), package)))
            if source:
                console.print(Padding(Text(source, style="dim"), (0, 0, 0, 6)))
        for name, reason in unusable_names(group).items():
            _print_indented(console, name, f"(refused) {reason}")
        if not (installed(group) or unusable_names(group)):
            console.print("  (none installed)")


def names_by_value(entries: Iterable[Entry]) -> dict[str, str]:
    """Return the first name of each class among the entry points of a registry, by the value of the entry point."""
    names: dict[str, str] = {}
    for entry in entries:
        names.setdefault(entry.value, entry.name)
    return names


def _print_indented(console: PlainConsole, name: str, text: str) -> None:
    """Print a name and a text; further lines of the text are indented more than the name."""
    lines = Text.assemble((name, "cyan"), "  ", text).wrap(console, max(20, console.width - 6))
    for number, line in enumerate(lines):
        line.rstrip()
        console.print(Padding(line, (0, 0, 0, 6 if number else 2)))


def paper(bibtex: str) -> str:
    """Return 'Author et al. 2015, Title' for the first of some BibTeX entries; "" if it has no author."""
    bibtex = re.split(r"(?m)^@", bibtex.strip().removeprefix("@"), maxsplit=1)[0]
    authors = _bibtex_value(bibtex, "author").split(" and ")
    if authors == [""]:
        return ""
    first = authors[0].partition(",")[0] if "," in authors[0] else authors[0].split(" ")[-1]
    name = f"{first} et al." if len(authors) > 1 else first
    return f"{name} {_bibtex_value(bibtex, 'year')}, {_bibtex_value(bibtex, 'title')}"


def _bibtex_value(bibtex: str, key: str) -> str:
    match = re.search(rf"\b{key}\s*=\s*[{{\"]+(.*?)[}}\"]+\s*,?\s*(?:\n|$)", bibtex, re.DOTALL)
    if not match:
        return ""
    accented = re.sub(r"\\+([\"'`^~])\{?(\w)\}?", _with_accent, " ".join(match.group(1).split()))
    return re.sub(r"[{}]", "", accented)


def _with_accent(command: re.Match[str]) -> str:
    """Return the accented letter that a LaTeX command produces."""
    marks = {'"': "\u0308", "'": "\u0301", "`": "\u0300", "^": "\u0302", "~": "\u0303"}
    return unicodedata.normalize("NFC", command[2] + marks[command[1]])


@dataclass(frozen=True)
class Description:
    """Description of a plugin for `mode=plugins`, read from its source without importing it.

    Attributes:
        group: Name of the registry.
        name: Name of the plugin.
        origin: Name and version of the plugin's package.
        summary: First line of the docstring of the plugin's class.
        bibtex: BibTeX entries that the class cites; "" for none.
    """

    group: str
    name: str
    origin: str
    summary: str
    bibtex: str


def describe(group: str, entry: Entry) -> Description:
    """Return the description of a plugin: the first docstring line and the BibTeX of the class of its entry point."""
    summary, bibtex = "(source not found)", ""
    module, _, attribute = entry.value.partition(":")
    package, *rest = module.split(".")
    for path in (candidate for root in package_folders(package) for candidate in _candidates(root, rest)):
        if path.is_file():
            summary, bibtex = _docstring_and_bibtex(path, attribute)
            with suppress(ConfigError):  # a run with this plugin names the missing key
                bibtex = look_up(bibtex, package)
            break
    return Description(group, entry.name, origin(entry), summary, bibtex)


def _candidates(root: Path, rest: list[str]) -> tuple[Path, Path]:
    folder = root.joinpath(*rest)
    return folder.with_suffix(".py") if rest else root / "__init__.py", folder / "__init__.py"


def _docstring_and_bibtex(path: Path, attribute: str) -> tuple[str, str]:
    try:
        tree = ast.parse(path.read_bytes())  # bytes, since the file may declare another encoding
    except SyntaxError as error:
        location = f" line {error.lineno}" if error.lineno else ""
        return f"(broken: {path.name}{location} does not parse)", ""
    # the file is unreadable, contains a null byte, or nests too deeply
    except (OSError, ValueError, RecursionError, MemoryError) as error:
        return f"(broken: {path.name} cannot be read: {shorten(error)})", ""
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and node.name == attribute:
            summary = (ast.get_docstring(node) or "(no description)").partition("\n")[0]
            for statement in node.body:
                if isinstance(statement, ast.Assign | ast.AnnAssign) and statement.value is not None:
                    targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
                    if any(isinstance(target, ast.Name) and target.id == "bibtex" for target in targets):
                        return summary, _text(statement.value, tree)
            return summary, ""
    return "(class not found)", ""


def _text(value: ast.expr, module: ast.Module) -> str:
    """Return the text of an expression that is a literal, or a name of a literal in the module; "" for any other."""
    if isinstance(value, ast.Name):
        named = (item for item in module.body if isinstance(item, ast.Assign))
        constants = (
            item.value for item in named if value.id in (getattr(target, "id", "") for target in item.targets)
        )
        value = next(constants, value)
    return str(value.value) if isinstance(value, ast.Constant) else ""
