"""Where a result comes from: the code's commit, the versions of its packages, its config."""

import platform
import subprocess
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from framework.configuration.registry import GROUPS, installed

_PACKAGES = ("torch", "pytorch-lightning", "hydra-core", "omegaconf", "numpy", "mlflow")


def git_commit(folder: Path) -> dict[str, str]:
    """Of the repository around a folder `commit` (40 hex digits) and `dirty` ("true": tracked files differ).

    Empty where the folder is in no repository, the repository has no commit, or git is missing or hangs.
    """
    commit = _git(folder, "rev-parse", "--verify", "HEAD")
    if commit is None:
        return {}
    changes = _git(folder, "status", "--porcelain", "--untracked-files=no")
    return {"commit": commit} if changes is None else {"commit": commit, "dirty": str(bool(changes)).lower()}


def _git(folder: Path, *arguments: str) -> str | None:
    # --no-optional-locks: a status that refreshed the index would get in the way of the user's own git.
    command = ["git", "--no-optional-locks", "-C", str(folder), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def package_versions() -> dict[str, str]:
    """Versions of Python, of what every run rests on, and of all distributions that provide plugins.

    Read from package metadata; imports nothing.
    """
    names = set(_PACKAGES)
    for group in GROUPS:
        names |= {entry.dist.name for entry in installed(group).values() if entry.dist}
    found = {"python": platform.python_version()}
    for name in sorted(names):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue  # not installed, so not in use
    return found


def flatten(config: Mapping[str, object]) -> dict[str, object]:
    """A nested config with dotted keys: {"a": {"b": [1, {"c": 2}]}} becomes {"a.b.0": 1, "a.b.1.c": 2}.

    A list of plain values stays one value. An empty mapping or list is a value of its own, so that nothing is
    lost.
    """
    flat: dict[str, object] = {}
    for key, value in config.items():
        for rest, leaf in _leaves(value):
            flat[".".join([str(key), *rest])] = leaf
    return flat


def _leaves(value: object) -> list[tuple[list[str], object]]:
    if isinstance(value, Mapping) and value:
        children = [(str(key), child) for key, child in value.items()]
    elif isinstance(value, Sequence) and any(isinstance(item, Mapping | list | tuple) for item in value):
        children = [(str(index), child) for index, child in enumerate(value)]
    else:
        return [([], value)]
    return [([key, *rest], leaf) for key, child in children for rest, leaf in _leaves(child)]
