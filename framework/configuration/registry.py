"""Registry of the installed plugins, read from package metadata without importing anything."""

import re
from contextlib import suppress
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from traceback import walk_tb
from typing import Any

from framework.errors import ConfigError, did_you_mean, list_names, quote

GROUPS = ("data", "encoder", "density_head", "uncertainty", "objective", "renderer", "metric")
SEVERAL = ("encoder", "uncertainty", "objective", "metric")
"""Groups from which an experiment may choose several plugins; the config maps a name to each of them."""
MODEL = ("encoder", "density_head", "uncertainty")
"""Groups of the plugins with which a model predicts."""

Entry = Any
"""Type of an entry point.

It is the class of importlib.metadata or, after MLflow was imported, the class of the package importlib_metadata.
"""


@cache
def installed(group: str) -> dict[str, Entry]:
    """Return the usable entry points under `framework.<group>` by name, sorted (see `unusable_names`)."""
    return {
        name: entries[0] for name, entries in _entries(group).items() if name not in unusable_names(group)
    }


@cache
def unusable_names(group: str) -> dict[str, str]:
    """Return the names of a group that cannot be used, each with a sentence that says why."""
    reasons = {}
    for name, entries in _entries(group).items():
        if len(entries) > 1:
            objects = " and ".join(f"{entry.value} of {origin(entry)}" for entry in entries)
            reasons[name] = (
                f"Several installed packages define a {group} {name!r}: {objects}. Uninstall all but one of these "
                "packages, or rename their entry points."
            )
        elif entries[0].dist and not package_name(entries[0].dist):  # a package that was only partly removed
            reasons[name] = (
                f"The {group} {name!r} ({entries[0].value}) belongs to a package whose METADATA file is missing. "
                "Install that package again, or remove its remaining files."
            )
    return reasons


@cache
def package_name(package: Any) -> str | None:
    """Return the name of an installed package (an `Entry.dist`).

    The name is cached, because Python parses the metadata of the package at each access.
    """
    return package.name


@cache
def _entry_points() -> Any:
    """Return the entry points of all installed packages; to read a single group would take as long."""
    return entry_points()


def _entries(group: str) -> dict[str, list[Entry]]:
    """Return the entry points of a group by name, sorted; only one of those with the same name and object is kept."""
    entries_by_name: dict[str, list[Entry]] = {}
    for entry in sorted(_entry_points().select(group=f"framework.{group}"), key=lambda entry: entry.name):
        same_name = entries_by_name.setdefault(entry.name, [])
        if entry.value not in [other.value for other in same_name]:
            same_name.append(entry)
    return entries_by_name


@cache
def plugin_packages() -> frozenset[str]:
    """Return the names of the top-level packages that hold the installed plugins, without importing them."""
    groups = [_entry_points().select(group=f"framework.{group}") for group in GROUPS]
    return frozenset(entry.value.partition(":")[0].partition(".")[0] for group in groups for entry in group)


def origin(entry: Entry) -> str:
    """Return name and version of the package that an entry point comes from, such as 'their-package 1.2'."""
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else "an unknown package"


def find(group: str, name: str) -> Entry:
    """Return the entry point called `name`.

    Raises:
        ConfigError: No plugin of that name is installed, or the name cannot be used (`unusable_names`).
    """
    names = installed(group)
    if name in unusable_names(group):
        raise ConfigError(unusable_names(group)[name])
    if name not in names:
        raise ConfigError(
            f"No {group} is called {quote(name)}.{did_you_mean(name, [*names, *unusable_names(group)])} "
            f"Installed: {list_names(name, names) or 'none'}. "
            "If you added the name to a pyproject.toml, run `pip install -e .`."
        )
    return names[name]


def load(group: str, name: str) -> type[Any]:
    """Import and return the class called `name`; plugins are imported here and nowhere else.

    Raises:
        ConfigError: There is no such name, the import fails, or the class is no complete implementation of the group's
            base class.
    """
    entry = find(group, name)
    # the contract is imported before its plugin, because framework.metric imports torchmetrics in its own way
    import_module(f"framework.{group}")
    try:
        cls = entry.load()
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"The {group} {name!r} ({entry.value}, of {origin(entry)}) needs the module {error.name!r}, "
            f"{_describe_missing_module(entry, str(error.name))}"
        ) from error
    except Exception as error:
        raise ConfigError(
            f"The {group} {name!r} ({entry.value}, of {origin(entry)}) cannot be imported: "
            f"{type(error).__name__}: {error}{_import_line(error)}. Repair or uninstall that package; other plugins "
            "still work."
        ) from error
    if not (isinstance(cls, type) and group_of(cls) == group):
        raise ConfigError(
            f"The {group} {name!r} ({entry.value}, of {origin(entry)}) does not derive from "
            f"the {group} base in framework.{group}. See that module's docstring for the contract."
        )
    missing = sorted(getattr(cls, "__abstractmethods__", ()))
    if missing:
        raise ConfigError(
            f"The {group} {name!r} ({entry.value}, of {origin(entry)}) lacks {', '.join(missing)}, which the "
            f"framework calls. Implement what the docstrings of framework.{group} describe."
        )
    return cls


def plugin_line(error: BaseException) -> str:
    """Return file and line of the innermost line of a plugin through which an error passed; "" if there is none."""
    lines = [
        f"{frame.f_code.co_filename}:{line}"
        for frame, line in walk_tb(error.__traceback__)
        if frame.f_globals.get("__name__", "").partition(".")[0] in plugin_packages()
    ]
    return lines[-1] if lines else ""


def _import_line(error: Exception) -> str:
    """Return " (at <file>:<line>)", the line of a plugin that failed; "" for none, or if a syntax error names it."""
    place = plugin_line(error)
    return f" (at {place})" if place and not isinstance(error, SyntaxError) else ""


def _describe_missing_module(entry: Entry, module: str) -> str:
    package = entry.module.partition(".")[0]
    hiding = find_spec(package) if module.startswith(f"{package}.") else None
    if hiding is None:
        return f"which is not installed. {_remedy(entry, module)}"
    place = hiding.origin or next(iter(hiding.submodule_search_locations or ()))
    return (
        f"which the package {package!r} at {place} does not contain. If that package is not the plugin's own, it "
        "hides the plugin's package: rename it, or run the command in another folder."
    )


def _remedy(entry: Entry, module: str) -> str:
    """Return advice on installing a missing module: by the extra of the plugin's package, or by the module's name."""
    package = module.partition(".")[0].lower()
    for requirement in (entry.dist.requires if entry.dist else None) or ():
        required = re.match(r"[\w.-]+", requirement)
        extra = re.search(r"extra == ['\"]([^'\"]+)", requirement)
        if (
            required
            and extra
            and extra[1] != "dev"
            and required[0].lower().replace("-", "_").startswith(package)
        ):
            return f"Install the extra of the plugin's package, e.g. `pip install -e '.[{extra[1]}]'` in its folder."
    return f"Install the dependencies of the plugin's package, e.g. `pip install {module}`."


def group_of(annotation: object) -> str | None:
    """Return the name of the registry if `annotation` is a plugin class or the abstract base of one; None otherwise."""
    if not isinstance(annotation, type):
        return None
    group = getattr(annotation, "group", None)
    return group if isinstance(group, str) and group in GROUPS else None


def config_folders() -> dict[str, Path]:
    """Return the config folder of every installed plugin that ships configs, by the name of the plugin.

    Raises:
        ConfigError: A plugin ships a config that would configure Hydra itself.
    """
    folders: dict[str, Path] = {}
    for entry in sorted(_entry_points().select(group="framework.conf"), key=lambda entry: entry.name):
        package, *rest = entry.value.split(".")
        roots = package_folders(package)
        if not roots:
            continue  # the package is only partly installed, which affects only commands that use it
        folder = roots[0].joinpath(*rest)
        own = next(folder.glob("hydra/**/*.yaml"), None)
        if own is not None:
            raise ConfigError(
                f"The plugin {entry.name!r} ({origin(entry)}) ships {own.relative_to(folder)}, but a plugin may not "
                "configure Hydra itself, because Hydra's logging config can run code. Uninstall the plugin."
            )
        if folder not in folders.values() and folder.is_dir():  # a missing folder affects only its own plugin
            # two packages may give their folders the same name, and both are kept
            folders[f"{entry.name} of {origin(entry)}" if entry.name in folders else entry.name] = folder
    return folders


def describe_missing_config(group: str, name: str) -> str:
    """Return a sentence for an installed plugin without a config that chooses it; "" if no such plugin is installed."""
    entry = installed(group).get(name) if group in GROUPS else None
    if entry is None or entry.dist is None:
        return ""
    own = [
        conf.value
        for conf in _entry_points().select(group="framework.conf")
        if conf.dist is not None and package_name(conf.dist) == package_name(entry.dist)
    ]
    where = (
        f"in the package {own[0]}, which its entry point of the group framework.conf names"
        if own
        else "in a package that an entry point of the group framework.conf names, e.g. "
        f'`{name} = "{entry.value.partition(".")[0]}.conf"`'
    )
    package = f" below the line `# @package {group}.{name}`" if group in SEVERAL else ""
    return (
        f" The {group} {name!r} ({entry.value}, of {origin(entry)}) is installed, but only a config can choose it. "
        f"Write {group}/{name}.yaml with the line `name: {name}`{package} {where}. `mode=new` writes such a package."
    )


def package_folders(package: str) -> list[Path]:
    """Return the folders of a top-level package without importing it; an empty list if it is not found."""
    with suppress(ImportError, ValueError):  # the name is not a module name, or the module has no spec
        spec = find_spec(package)
        return [Path(root) for root in (spec.submodule_search_locations if spec else None) or ()]
    return []
