"""Provenance of a result: the versions of its packages and its config."""

import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version

from framework.configuration.registry import GROUPS, installed, package_name

_PACKAGES = ("torch", "pytorch-lightning", "hydra-core", "omegaconf", "numpy", "mlflow")


def package_versions() -> dict[str, str]:
    """Return the versions of Python, of the packages that every run uses, and of all packages that provide plugins.

    The versions are read from package metadata, and no package is imported.
    """
    names = set(_PACKAGES)
    for group in GROUPS:
        names |= {package_name(entry.dist) or "" for entry in installed(group).values() if entry.dist}
    versions = {"python": platform.python_version()}
    for name in sorted(names - {""}):
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue  # the package is not installed, so it is not in use
    return versions


def flatten(config: Mapping[str, object]) -> dict[str, object]:
    """Return a nested config with dotted keys: {"a": {"b": [1, {"c": 2}]}} becomes {"a.b.0": 1, "a.b.1.c": 2}.

    A list of plain values stays one value, and so does an empty mapping or list.
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
