"""Which tracking store a command may contact, and what its address looks like in a file.

A run folder may be a stranger's, so an address in one of its files is never contacted. The user names a store in the
command (`logger.uri=`), in the settings (MLFLOW_TRACKING_URI), or not at all: then it is the SQLite file `mlflow.db` of
the `outputs` folder. An address that a file records is only compared with these; the user's own text is contacted.
"""

import os
import re
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote, unquote, urlsplit

from framework.errors import ConfigError, DataError, shown
from framework.storage.enclosed import require_enclosed, require_plain_within

SETTING = "MLFLOW_TRACKING_URI"
"""Environment variable that names a store, its password included; MLflow's own."""
_SQLITE = "sqlite:///"
_BESIDE = ("", "-wal", "-shm", "-journal")
"""Endings of the files that SQLite opens with a database."""
_MEANING = r"[%?\x00-\x1f\x7f]"
"""Letters of a path that mean something else in an address of SQLAlchemy."""
_ESCAPED = r"[%?#'\"\\\x00-\x1f\x7f]"
"""Letters of a path that mean something else where MLflow keeps files: it decodes paths, and quotes them in SQL."""
_SECRET = r"([?&][^=&\s]*(?:pass|pwd|token|secret)[^=&\s]*=)[^&\s]*"


@dataclass(frozen=True)
class Address:
    """Where a store is.

    Attributes:
        uri: an MLflow tracking URI; it may hold a password, and is kept in memory alone.
        named: whether the user named it. The default store may have come with somebody's folder, so its files stay in
            its own folder.
    """

    uri: str
    named: bool


def address(named: str | None, folder: Path) -> Address:
    """Return the store for a run that this command begins in `folder`.

    Args:
        named: `logger.uri` of this command.

    Raises:
        ConfigError: MLflow cannot keep runs there, or in a folder of such a name.
    """
    given = named or os.environ.get(SETTING)
    uri = store_uri(given) if given else default_uri(folder)
    path = sqlite_path(uri)
    if path is not None and re.search(r"[\ud800-\udfff]", str(path)):
        raise ConfigError(
            f"{shown(path)} lies in a folder whose name is not UTF-8, where MLflow keeps no run. Rename the folder, or "
            "choose another store: add logger.uri=sqlite:///<file>, or logger=none."
        )
    return Address(uri, bool(given))


def confirmed(recorded: str, named: str | None, folder: Path, source: Path) -> Address:
    """Return the user's own address of the store that a file records for the run in `folder`.

    Args:
        recorded: what the file says.
        named: `logger.uri` of this command.
        source: the file.

    Raises:
        ConfigError: the user names no such store.
    """
    own = [Address(store_uri(uri), True) for uri in (named, os.environ.get(SETTING)) if uri]
    own += [Address(default_uri(place), False) for place in (folder, Path.cwd() / "outputs" / "run")]
    for one in own:
        if _same(one.uri, recorded):
            return one
    told = shown(without_password(recorded))
    raise ConfigError(
        f"{source} says that the run goes to {told}. A run folder may be a stranger's, so no store that only the "
        f"folder names is contacted. If that is where you keep runs, say so: add logger.uri={told}"
    )


def default_uri(folder: Path) -> str:
    """Return the SQLite store for a run folder: mlflow.db in the `outputs` folder around it, else beside it."""
    return sqlite_uri(_outputs(folder) / "mlflow.db")


def store_uri(uri: str) -> str:
    """Return a tracking URI that means the same from every working directory.

    Raises:
        ConfigError: MLflow keeps no runs there.
    """
    if uri.startswith(_SQLITE):
        path, question, query = uri.removeprefix(_SQLITE).partition("?")
        if path in ("", ":memory:"):
            raise ConfigError(f"logger.uri={uri} keeps nothing. Give a file: sqlite:///outputs/mlflow.db.")
        return f"{sqlite_uri(Path(unquote(path)).expanduser().absolute())}{question}{query}"
    if not re.match(r"(https?|(postgresql|mysql|mssql)(\+\w+)?)://.|databricks", uri):
        raise ConfigError(
            f"logger.uri={shown(without_password(uri))}: wanted sqlite:///<file>, the http(s)://<host>:<port> of a "
            "server, or a postgresql, mysql or mssql address. MLflow no longer keeps runs in plain folders."
        )
    return uri


def sqlite_uri(path: Path) -> str:
    """Return the address of an SQLite store, escaped where a letter of its path would mean something else there.

    Then its slashes are escaped, too: MLflow makes the folder that it reads in an address, before it is decoded.
    """
    return _SQLITE + (quote(os.fsencode(path), safe="") if re.search(_MEANING, str(path)) else str(path))


def sqlite_path(uri: str) -> Path | None:
    """Return the file of an SQLite store; None for any other."""
    return Path(unquote(uri.removeprefix(_SQLITE).partition("?")[0])) if uri.startswith(_SQLITE) else None


def artifact_folder(uri: str, folder: Path) -> str | None:
    """Return where a new experiment keeps its files; None for servers, which know themselves.

    Absolute, since MLflow's own default depends on the working directory.
    """
    path = sqlite_path(uri)
    if path is None and uri.startswith(("http", "databricks")):
        return None
    place = (path.parent if path else _outputs(folder)) / "artifacts"
    return place.as_uri() if re.search(_ESCAPED, str(place)) else str(place)


def require_own_files(uri: str, locations: tuple[str, ...] = ()) -> None:
    """Refuse a store that nobody named, if it leads out of its folder.

    Args:
        uri: of an SQLite store.
        locations: folders in which it says that files of an experiment, a run or a model are.

    Raises:
        DataError: the store's file or one of the locations is a link, or lies elsewhere.
    """
    path = sqlite_path(uri)
    assert path is not None
    for ending in _BESIDE:
        require_plain_within(path.with_name(path.name + ending), path.parent)
    require_plain_within(path.with_name(f".{path.name}.lock"), path.parent)
    home = path.parent / "artifacts"
    for location in locations:
        parts = urlsplit(location)
        place = Path(unquote(parts.path) if parts.scheme == "file" and not parts.netloc else location)
        if not place.is_relative_to(home) or ".." in place.parts:
            raise DataError(
                f"The store {path}, which nobody named, keeps files in {shown(without_password(location))}; wanted a "
                f"folder in {home}. If the store is yours, name it: add logger.uri={sqlite_uri(path)}"
            )
        require_plain_within(place, path.parent)
        if place != home:  # that holds the files of every run
            require_enclosed(place)


def without_password(text: str) -> str:
    """Return a text with the user names, passwords and tokens of all addresses in it removed."""
    text = re.sub(r"(?<!sqlite)(://)[^\s/]*@", r"\1", text)
    text = re.sub(r"(?<!sqlite)(://)[^\s/@:]*:[^\s@]*@", r"\1", text)  # a password that holds a slash
    return re.sub(_SECRET, r"\1", text)


def require_no_password(uri: str) -> None:
    """Refuse an address that holds a password where it would be stored or be seen by others.

    Raises:
        ConfigError: it holds one.
    """
    # of a server with http a name alone may be a token
    if re.search(r"^https?://[^\s/]*@|^\w[\w+]*://[^\s/@]*:[^\s@]*@", uri) or re.search(_SECRET, uri):
        raise ConfigError(
            f"logger.uri={shown(without_password(uri))} came with a password; wanted none, since commands and configs "
            f"are stored and other users see them. Put the whole address into the environment variable {SETTING} and "
            "leave logger.uri out; MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD serve for http, too."
        )


def _same(one: str, other: str) -> bool:
    """Whether two addresses name the same store, whatever their passwords, and whichever letters they escape."""
    one, other = without_password(one), without_password(other)
    same_file = sqlite_path(one) == sqlite_path(other) is not None
    return one == other or (same_file and one.partition("?")[2] == other.partition("?")[2])


def _outputs(folder: Path) -> Path:
    parents = folder.absolute().parents
    return next((parent for parent in parents if parent.name == "outputs"), parents[0])
