"""Citations of plugins, as BibTeX: written in a class, or named by keys of its package's `references.bib`."""

import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path

from framework.configuration.registry import package_folders
from framework.errors import ConfigError, did_you_mean

REFERENCES = "references.bib"
"""Name of the file, in the top folder of a package, with the BibTeX entries that its plugins cite by their keys."""


def bibtex_of(cls: type) -> str:
    """Return the BibTeX entries of a plugin class; "" if it cites nothing.

    Raises:
        ConfigError: The class names a key that its package's `references.bib` does not contain.
    """
    text = getattr(cls, "bibtex", "")
    owner = next((base for base in cls.__mro__ if "bibtex" in vars(base)), cls)
    return look_up(text, owner.__module__.partition(".")[0])


def look_up(bibtex: str, package: str) -> str:
    """Return `bibtex` unchanged if it has BibTeX entries; if it has keys, separated by commas, return their entries.

    Args:
        bibtex: Entries, keys or nothing.
        package: Name of the top-level package whose `references.bib` contains the keys.

    Raises:
        ConfigError: The package has no `references.bib`, or the file does not contain a key.
    """
    text = bibtex.strip()
    if not text or "@" in text:
        return text
    path = next((folder / REFERENCES for folder in package_folders(package)), Path(REFERENCES))
    known = _read(path)
    keys = [key.strip() for key in text.split(",")]
    for key in keys:
        if key not in known:
            raise ConfigError(
                f"A plugin of the package {package} cites the key {key!r}, but {path} does not contain it."
                f"{did_you_mean(key, known)} Add the entry to that file, or give whole BibTeX entries."
            )
    return "\n\n".join(known[key] for key in keys)


def entries(bibtex: Iterable[str]) -> dict[str, str]:
    """Return the entries of several BibTeX texts by their keys, each once and in order."""
    entries_by_key: dict[str, str] = {}
    for entry in re.split(r"^(?=@)", "\n".join(bibtex), flags=re.MULTILINE):
        if entry.strip():
            entries_by_key.setdefault(entry.partition("{")[2].partition(",")[0].strip(), entry.strip())
    return entries_by_key


@cache
def _read(path: Path) -> dict[str, str]:
    try:
        return entries([path.read_text(encoding="utf-8")])
    except OSError:
        return {}
