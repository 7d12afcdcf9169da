"""The names of everything installed, read from package metadata; reading them imports nothing."""

import re
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from framework.errors import ConfigError, did_you_mean, quoted

GROUPS = ("data", "encoder", "density_head", "uncertainty", "objective", "renderer", "metric")

Entry = Any
"""An importlib.metadata.EntryPoint, or that of its backport, which takes over once MLflow has been imported."""


@cache
def installed(group: str) -> dict[str, Entry]:
    """Name and entry point of everything installed under `framework.<group>`, sorted by name.

    Raises:
        ConfigError: two distributions give different things the same name.
    """
    found: dict[str, Entry] = {}
    for entry in sorted(entry_points(group=f"framework.{group}"), key=lambda entry: entry.name):
        other = found.setdefault(entry.name, entry)
        if other.value != entry.value:
            raise ConfigError(
                f"Two installed packages call a {group} {entry.name!r}: {other.value} of {origin(other)} "
                f"and {entry.value} of {origin(entry)}. Uninstall one, or rename its entry point."
            )
    return found


def origin(entry: Entry) -> str:
    """Distribution and version an entry point comes from, e.g. 'their-package 1.2'."""
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else "an unknown package"


def find(group: str, name: str) -> Entry:
    """The entry point called `name`.

    Raises:
        ConfigError: nothing of that name is installed.
    """
    names = installed(group)
    if name not in names:
        raise ConfigError(
            f"No {group} is called {quoted(name)}.{did_you_mean(name, names)} "
            f"Installed: {', '.join(names) or 'none'}. "
            "A name added to a pyproject.toml counts only after `pip install -e .`."
        )
    return names[name]


def load(group: str, name: str) -> type[Any]:
    """Import the class called `name`; the only place where a plugin is imported.

    Raises:
        ConfigError: no such name, the import fails, or it is not an implementation of the group's base.
    """
    entry = find(group, name)
    try:
        found = entry.load()
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"The {group} {name!r} ({entry.value}, of {origin(entry)}) needs the module {error.name!r}, "
            f"which is not installed. {_remedy(entry, str(error.name))}"
        ) from error
    except Exception as error:
        raise ConfigError(
            f"The {group} {name!r} ({entry.value}, of {origin(entry)}) cannot be imported: "
            f"{type(error).__name__}: {error}. Mend or uninstall that package; other plugins still work."
        ) from error
    if not (isinstance(found, type) and group_of(found) == group):
        raise ConfigError(
            f"The {group} {name!r} ({entry.value}, of {origin(entry)}) does not derive from "
            f"the {group} base in framework.{group}. See that module's docstring for the contract."
        )
    return found


def _remedy(entry: Entry, module: str) -> str:
    """What installs a missing module: an extra of the plugin's own package, where one asks for it by that name."""
    wanted = module.partition(".")[0].lower()
    for requirement in (entry.dist.requires if entry.dist else None) or ():
        asked = re.match(r"[\w.-]+", requirement)
        extra = re.search(r"extra == ['\"]([^'\"]+)", requirement)
        if asked and extra and extra[1] != "dev" and asked[0].lower().replace("-", "_").startswith(wanted):
            return f"Install that package's extra, e.g. `pip install -e '.[{extra[1]}]'` in its folder."
    return f"Install that package's dependencies, e.g. `pip install {module}`."


def group_of(annotation: object) -> str | None:
    """The registry a class belongs to: the `group` its abstract base carries; None for any other object."""
    if not isinstance(annotation, type):
        return None
    group = getattr(annotation, "group", None)
    return group if isinstance(group, str) and group in GROUPS else None


def config_folders() -> dict[str, Path]:
    """Plugin name and config folder of every installed plugin that ships configs.

    Raises:
        ConfigError: two plugins ship a config of one name, of which Hydra would silently take the first.
    """
    folders: dict[str, Path] = {}
    owner: dict[Path, str] = {}
    for entry in sorted(entry_points(group="framework.conf"), key=lambda entry: entry.name):
        package, *rest = entry.value.split(".")
        spec = find_spec(package)  # of a top-level package: imports nothing
        if spec is None or not spec.submodule_search_locations:
            continue  # half-uninstalled: it can disturb nobody but its own users
        folder = Path(next(iter(spec.submodule_search_locations)), *rest)
        for file in sorted(folder.rglob("*.yaml")):
            config = file.relative_to(folder)
            if config.parts[0] == "hydra":
                raise ConfigError(
                    f"Plugin {entry.name!r} ({origin(entry)}) ships {config}: a plugin may not configure "
                    "Hydra itself, whose logging config can run code. Uninstall it."
                )
            if config in owner:
                raise ConfigError(
                    f"Plugins {owner[config]!r} and {entry.name!r} ({origin(entry)}) both ship {config}. "
                    "Uninstall one, or rename its config."
                )
            owner[config] = entry.name
        folders[entry.name] = folder
    return folders
