"""Choice of the tracking store that a command may contact, and the form of its address in files.

A run folder may come from an untrusted source, so the program never contacts an address that it reads in such a folder.
The user names a store in the command (`logger.uri=`) or in the environment (MLFLOW_TRACKING_URI). If neither is set,
the store is the SQLite file `mlflow.db` in the `outputs` folder. An address in a file is only compared with these
addresses, and the program contacts the address that the user gave.
"""

import os
import re
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import quote, unquote, urlsplit

from framework.errors import ConfigError, DataError, shorten
from framework.storage.enclosed import require_enclosed, require_plain_within

SETTING = "MLFLOW_TRACKING_URI"
"""MLflow's environment variable for the address of a store, which may include a password."""
_SQLITE = "sqlite:///"
_BESIDE = ("", "-wal", "-shm", "-journal")
"""Suffixes, added to the path of an SQLite database, of all files that SQLite opens for it."""
_MEANING = r"[%?\x00-\x1f\x7f]"
"""Pattern of characters in a path that have a special meaning in an address of SQLAlchemy."""
_ESCAPED = r"[%?#'\"\\\x00-\x1f\x7f]"
"""Pattern of characters in a path that MLflow would change, because it decodes the path and writes it into SQL."""
_USER_WITH_SLASH = re.compile(r"(?<!sqlite)(://)[^/@:]*:")
"""Pattern of the beginning of an address with a user name and a password."""
_KEY, _VALUE = re.compile(r"[?&][^=&\s]*+=?"), re.compile(r"[^&\s]*")
"""Patterns of a key in the query of an address, with its equals sign if there is one, and of a value."""
_STORED = re.compile(
    r"CREATE (TABLE|(UNIQUE )?INDEX)\s.*|CREATE TRIGGER [^()]*\sBEGIN\s+SELECT RAISE\(ABORT, '[^']*'\);\s*END",
    re.DOTALL,
)
"""Pattern of the statements that a database may hold: tables, indices, and triggers that only refuse a change."""
_SECRET = re.compile("pass|pwd|token|secret")
"""Pattern of the keys whose values are secret."""


@dataclass(frozen=True)
class Address:
    """Address of a store.

    Attributes:
        uri: MLflow tracking URI; it may contain a password and is never written to a file.
        named: Whether the user named the store. The default store may have come with a folder from an untrusted source,
            so all its files must lie in its own folder.
    """

    uri: str
    named: bool


def address(named: str | None, folder: Path) -> Address:
    """Return the address of the store for a new run in `folder`.

    Args:
        named: `logger.uri` of this command.
        folder: Folder of the run.

    Raises:
        ConfigError: MLflow cannot keep runs at the address, the address contains a folder whose name is not UTF-8, or
            the package that connects to the database is missing.
    """
    user_uri = named or os.environ.get(SETTING)
    uri = store_uri(user_uri) if user_uri else default_uri(folder)
    _require_driver(uri)
    path = sqlite_path(uri)
    if path is not None and re.search(r"[\ud800-\udfff]", str(path)):
        raise ConfigError(
            f"{shorten(path)} lies in a folder whose name is not UTF-8, which MLflow cannot use. Rename the folder, or "
            "choose another store: add logger.uri=sqlite:///<file>, or logger=none."
        )
    return Address(uri, bool(user_uri))


def confirm_address(recorded: str, named: str | None, folder: Path, source: Path) -> Address:
    """Return the address of the store that a file names for a run, after checking that the user may mean this store.

    The address in the file is only compared: the returned address is one that the user gives, or a default address.

    Args:
        recorded: Address of the store in the file.
        named: `logger.uri` of this command.
        folder: Folder of the run.
        source: Path of the file, for the message.

    Raises:
        ConfigError: Neither an address that the user gives nor a default address names the recorded store.
    """
    candidates = [Address(store_uri(uri), True) for uri in (named, os.environ.get(SETTING)) if uri]
    candidates += [Address(default_uri(place), False) for place in (folder, Path.cwd() / "outputs" / "run")]
    for candidate in candidates:
        if _is_same_store(candidate.uri, recorded):
            return candidate
    store_name = shorten(without_password(recorded))
    raise ConfigError(
        f"{source} names the store {store_name} for the run. A run folder may come from an untrusted source, so a "
        f"store that only the folder names is not contacted. If this is your store, add logger.uri={store_name}"
    )


def default_uri(folder: Path) -> str:
    """Return the address of the default store, the file mlflow.db.

    It lies in the folder `outputs` that contains `folder`; without such a folder, it lies beside `folder`.
    """
    return sqlite_uri(_outputs(folder) / "mlflow.db")


def store_uri(uri: str) -> str:
    """Return a tracking URI in a form that does not depend on the working directory.

    Raises:
        ConfigError: MLflow cannot keep runs at the address.
    """
    if uri.startswith(_SQLITE):
        path, question, query = uri.removeprefix(_SQLITE).partition("?")
        if path in ("", ":memory:"):
            raise ConfigError(f"logger.uri={uri} stores nothing. Give a file: sqlite:///outputs/mlflow.db.")
        return f"{sqlite_uri(Path(unquote(path)).expanduser().absolute())}{question}{query}"
    if not re.match(r"(https?|(postgresql|mysql|mssql)(\+\w+)?)://.|databricks", uri):
        raise ConfigError(
            f"logger.uri={shorten(without_password(uri))}: expected sqlite:///<file>, http(s)://<host>:<port> of a "
            "server, or a postgresql, mysql or mssql address. MLflow no longer keeps runs in plain folders."
        )
    return uri


def _require_driver(uri: str) -> None:
    """Refuse an address of a PostgreSQL database whose Python package is not installed."""
    scheme = uri.partition(":")[0]
    if scheme.partition("+")[0] != "postgresql":
        return
    driver = scheme.partition("+")[2] or "psycopg"  # SQLAlchemy's default
    if find_spec(driver) is None:
        raise ConfigError(
            f"logger.uri={shorten(without_password(uri))} needs the package {driver}, which is not installed. Use "
            "postgresql+psycopg2://… and install psycopg2: pip install '.[postgres]'"
        )


def sqlite_uri(path: Path) -> str:
    """Return the address of an SQLite store, escaped if its path contains a character with a special meaning.

    Slashes are then escaped too. Otherwise MLflow, which creates the folder named in the address before it decodes the
    address, would create a folder with an escaped name.
    """
    return _SQLITE + (quote(os.fsencode(path), safe="") if re.search(_MEANING, str(path)) else str(path))


def sqlite_path(uri: str) -> Path | None:
    """Return the file of an SQLite store; None for any other store."""
    return Path(unquote(uri.removeprefix(_SQLITE).partition("?")[0])) if uri.startswith(_SQLITE) else None


def artifact_folder(uri: str, folder: Path) -> str | None:
    """Return the folder for the files of a new experiment; None for servers, which choose the folder themselves.

    The path is absolute, since MLflow's own default depends on the working directory.

    Args:
        uri: Address of the store.
        folder: Folder of the run.
    """
    path = sqlite_path(uri)
    if path is None and uri.startswith(("http", "databricks")):
        return None
    place = (path.parent if path else _outputs(folder)) / "artifacts"
    return place.as_uri() if re.search(_ESCAPED, str(place)) else str(place)


def require_own_files(uri: str, locations: tuple[str, ...] = ()) -> None:
    """Refuse a store that the user did not name if it runs statements, or uses files outside its own folder.

    Args:
        uri: Address of an SQLite store.
        locations: Folders that the store records for the files of an experiment, a run or a model.

    Raises:
        DataError: The store's file or one of the locations is a link or lies outside the folder, or the store holds
            a view or a trigger.
    """
    path = sqlite_path(uri)
    assert path is not None
    for ending in _BESIDE:
        require_plain_within(path.with_name(path.name + ending), path.parent)
    require_plain_within(path.with_name(f".{path.name}.lock"), path.parent)
    _require_plain_tables(path)
    home = path.parent / "artifacts"
    for location in locations:
        parts = urlsplit(location)
        place = Path(unquote(parts.path) if parts.scheme == "file" and not parts.netloc else location)
        if not place.is_relative_to(home) or ".." in place.parts:
            raise DataError(
                f"The store {path}, which the command does not name, keeps files in "
                f"{shorten(without_password(location))}, outside the folder {home}. If this is your store, add "
                f"logger.uri={sqlite_uri(path)}"
            )
        require_plain_within(place, path.parent)
        if place != home:  # `home` itself contains the files of every run
            require_enclosed(place)


def _require_plain_tables(path: Path) -> None:
    """Refuse an SQLite database with views, virtual tables or triggers of its own, which SQLite runs in each query.

    A view may return rows without end, and a trigger may write them, so that a command would never end. What counts is
    the statement of an entry: SQLite runs it, whatever kind the entry states. A file that SQLite cannot read is
    accepted here, because MLflow reports it; so is one that another process has locked for more than a second.

    Raises:
        DataError: The database holds such a statement.
    """
    import sqlite3  # only the default store needs it

    statements: list[tuple[str, object]] = []
    with (
        suppress(sqlite3.Error),
        closing(sqlite3.connect(f"{path.as_uri()}?mode=rw", uri=True, timeout=1)) as database,
    ):
        database.text_factory = _decode  # an error of decoding would hide a statement
        statements = database.execute("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL").fetchall()
    for name, statement in statements:
        if not isinstance(statement, str) or not _STORED.fullmatch(statement):
            raise DataError(
                f"The store {path}, which the command does not name, holds {shorten(name)}, which is neither a table "
                "nor an index. It may come from another person, and SQLite would run its statement. If this is your "
                f"store, add logger.uri={sqlite_uri(path)}"
            )


def _decode(text: bytes) -> str:
    return text.decode("utf-8", "replace")


def without_password(text: str) -> str:
    """Return a text with the user names, passwords and tokens of all addresses in it removed.

    A text may come from an untrusted source and be long, so the time is linear in its length.
    """
    text = re.sub(r"(?<!sqlite)(://)[^\s/]*@", r"\1", text)
    text = re.sub(r"([^\s@]++)(@?)", _without_user, text)
    kept, end = [], 0
    for key in _secret_keys(text):
        if key.start() >= end:  # otherwise the key is part of a value that is removed
            kept.append(text[end : key.end()])
            value = _VALUE.match(text, key.end())
            end = key.end() if value is None else value.end()
    return "".join([*kept, text[end:]])


def _without_user(match: re.Match[str]) -> str:
    """Return the text of a match; if an address in it has a password with a slash, remove user name and password."""
    begun = _USER_WITH_SLASH.search(match[1]) if match[2] else None
    return match[0] if begun is None else match[1][: begun.end(1)]


def _secret_keys(text: str) -> Iterator[re.Match[str]]:
    """Yield the keys of passwords and tokens in the queries of addresses, with their equals signs."""
    return (key for key in _KEY.finditer(text) if key[0].endswith("=") and _SECRET.search(key[0]))


def require_no_password(uri: str) -> None:
    """Refuse an address with a password in a command or config, which is stored and which other users can see.

    Raises:
        ConfigError: The address contains a password.
    """
    # the user name of an http address may be a token
    if re.search(r"^https?://[^\s/]*@|^\w[\w+]*://[^\s/@:]*:[^\s@]*@", uri) or any(_secret_keys(uri)):
        raise ConfigError(
            f"logger.uri={shorten(without_password(uri))} was given with a password, which is refused, because "
            "commands and configs are stored and other users can see them. Put the whole address into the environment "
            f"variable {SETTING} and leave logger.uri out. For http, MLFLOW_TRACKING_USERNAME and "
            "MLFLOW_TRACKING_PASSWORD work too."
        )


def _is_same_store(first: str, second: str) -> bool:
    """Return whether two addresses name the same store, ignoring passwords and the escaping of characters."""
    first, second = without_password(first), without_password(second)
    same_file = sqlite_path(first) == sqlite_path(second) is not None
    return first == second or (same_file and first.partition("?")[2] == second.partition("?")[2])


def _outputs(folder: Path) -> Path:
    parents = folder.absolute().parents
    return next((parent for parent in parents if parent.name == "outputs"), parents[0])
