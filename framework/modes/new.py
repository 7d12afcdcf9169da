"""mode=new: write a package with a plugin that passes mode=check, to start a new plugin from."""

import keyword
import re
import shlex
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

from framework.configuration.config import Config, Options
from framework.configuration.registry import GROUPS, installed
from framework.errors import ConfigError, did_you_mean
from framework.storage.progress import PlainConsole

SCAFFOLD = Path(__file__).resolve().parent.parent / "scaffold"


class NewOptions(Options):
    """Options of mode=new: registry and name of the plugin, and the folder in which its package is made."""

    plugin: str
    folder: str


def run(config: Config) -> None:
    """Write the package and print the next commands.

    Raises:
        ConfigError: The registry does not exist, the name is unusable or taken, or the folder of the package exists.
    """
    _remove_run_folder(config.folder)
    options = config.options(NewOptions)
    registry, name = _split(options.plugin)
    folder = Path(options.folder).expanduser() / name
    if folder.exists():
        raise ConfigError(
            f"mode.plugin={options.plugin} would write the folder {folder}, which exists. Choose another name, or set "
            "mode.folder to another folder."
        )
    files = package_files(registry, name)
    for path, text in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text, encoding="utf-8")
    console = PlainConsole(highlight=False)
    console.print(f"wrote {folder}: {', '.join(files)}", soft_wrap=True, markup=False)
    argument = f"{registry}={name}" if _is_single(registry) else f"'{registry}=[{name}]'"
    console.print("next:", markup=False)
    for command in (
        f"pip install -e {shlex.quote(str(folder))}",
        f"python -m framework mode=check {argument}",
        f"less {shlex.quote(str(folder / 'README.md'))}   # how to train with it and compare it",
    ):
        console.print(f"  {command}", soft_wrap=True, markup=False)


def package_files(registry: str, name: str) -> dict[str, str]:
    """Return the files of the package of a new plugin, by their paths in its folder."""
    source = SCAFFOLD / registry
    files = {
        "pyproject.toml": SCAFFOLD / "package.toml",
        "README.md": source / "README.md",
        f"{name}/plugin.py": source / "example.py",
        f"{name}/rows.py": source / "rows.py",
        f"{name}/conf/{registry}/{name}.yaml": source / "conf.yaml",
        f"tests/test_{name}.py": SCAFFOLD / "contract_tests.txt",
    }
    texts = {path: file.read_text(encoding="utf-8") for path, file in files.items() if file.is_file()}
    class_name = "".join(part.capitalize() for part in name.split("_"))
    names = {"Example": class_name, "example": name, "<registry>": registry}
    return {
        f"{name}/__init__.py": f'"""The {registry} plugin {name}."""\n',
        **{
            path: re.sub("|".join(names), lambda match: names[match[0]], text) for path, text in texts.items()
        },
    }


def _remove_run_folder(folder: Path) -> None:
    """Remove the run folder, since the command has no results, and the folders of `outputs` that were made for it."""
    with suppress(OSError):  # a folder that is not empty stays
        folder.rmdir()
        while folder.parent.is_relative_to(Path.cwd() / "outputs"):
            folder = folder.parent
            folder.rmdir()


def _is_single(registry: str) -> bool:
    """Return whether a config chooses a single plugin of the registry `registry`, and not several."""
    return not (SCAFFOLD / registry / "conf.yaml").read_text(encoding="utf-8").startswith("# @package")


def _split(plugin: str) -> tuple[str, str]:
    """Return the registry and the name of `mode.plugin`.

    Raises:
        ConfigError: One of them cannot be used.
    """
    registry, slash, name = plugin.partition("/")
    if not slash or registry not in GROUPS:
        raise ConfigError(
            f"mode.plugin={plugin!r} names no registry.{did_you_mean(registry, GROUPS)} Write <registry>/<name>, for "
            f"example density_head/my_head. The registries are {', '.join(GROUPS)}."
        )
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or keyword.iskeyword(name):
        raise ConfigError(
            f"mode.plugin={plugin!r}: {name!r} cannot be the name of a plugin. Use lower-case letters, digits and "
            "underscores, a letter first, and no keyword of Python."
        )
    if name in installed(registry):
        raise ConfigError(
            f"mode.plugin={plugin!r}: the registry {registry} has a plugin of this name already. Choose another name."
        )
    if find_spec(name) is not None:
        raise ConfigError(
            f"mode.plugin={plugin!r}: the package would have the name {name!r}, and a Python module of this name "
            f"exists already. Choose another name, such as my_{name}."
        )
    return registry, name
