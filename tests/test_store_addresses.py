"""Default store, which lies in the folder of the runs for any name of this folder."""

import os
import sqlite3
from contextlib import closing
from pathlib import Path
from urllib.request import url2pathname

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy.engine import make_url

from framework.configuration.composition import in_quotes
from framework.errors import ConfigError, DataError
from framework.tracking.stores import (
    Address,
    address,
    artifact_folder,
    confirm_address,
    default_uri,
    require_own_files,
    sqlite_path,
    store_uri,
)
from tests.conftest import TINY, Forks, command

NAMES = (
    "per%20cent", "100%", "%", "what?", "q?x=1&pass=2", "ha#sh", "sp ace", "'single'", "\"double\"", "'both\"",
    "back\\slash", "new\nline", "umläut", "日本", "a:b@c", "semi;colon,comma", "file:x", "~", "{x}", "$HOME", "a+b",
)  # fmt: skip
ALL = "p%20c q?x=1#z 'b\"\\ü\nl"


def require_in(name: str, base: Path) -> None:
    folder = base / name / "outputs" / "run"
    uri = default_uri(folder)
    file = base / name / "outputs" / "mlflow.db"
    assert make_url(uri).database == str(file) == str(sqlite_path(uri))
    assert not make_url(uri).query
    assert store_uri(uri) == uri, "the user may name the store as it is shown"
    files = artifact_folder(uri, folder)
    assert files is not None
    # as mlflow.utils.file_utils.local_file_uri_to_path reads it
    assert url2pathname(files.removeprefix("file://")) == str(file.with_name("artifacts"))
    # MLflow makes the folder above what stands in the address
    assert Path(uri.removeprefix("sqlite:///")).parent in (file.parent, Path())
    require_own_files(uri, (f"{files}/1/artifacts",))
    assert confirm_address(uri, None, folder, folder / "run.json") == Address(uri, False)
    literal = f"sqlite:///{file}"  # as earlier versions recorded it
    if sqlite_path(literal) == file:
        assert confirm_address(literal, None, folder, folder / "run.json") == Address(uri, False)


@pytest.mark.parametrize("name", NAMES)
def test_an_address_names_the_file(name: str, tmp_path: Path) -> None:
    require_in(name, tmp_path)


@given(st.text(st.characters(exclude_characters="/\0", exclude_categories=["Cs"]), min_size=1, max_size=30))
def test_an_address_names_the_file_for_any_letters(name: str) -> None:
    if name not in (".", ".."):
        require_in(name, Path("/nowhere"))


def test_a_relative_address_is_of_the_folder_that_the_command_runs_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / ALL).mkdir()
    monkeypatch.chdir(tmp_path / ALL)
    found = store_uri("sqlite:///a%20b/mlflow.db?timeout=1")
    assert make_url(found).database == str(tmp_path / ALL / "a b" / "mlflow.db")
    assert make_url(found).query == {"timeout": "1"}


def test_a_folder_that_is_not_utf8_is_refused_before_training(tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9/outputs/run"))
    with pytest.raises(ConfigError, match=r"caf.*not UTF-8.*logger=none"):
        address(None, folder)
    other = f"sqlite:///{tmp_path}/mlflow.db"
    assert address(other, folder) == Address(other, True)


@pytest.mark.slow
def test_runs_sweeps_and_sync_keep_the_store_in_their_folder(
    forks: Forks, stranger_site: Path, tmp_path: Path
) -> None:
    base = tmp_path / "home" / ALL
    base.mkdir(parents=True)
    framework = command(forks, stranger_site, base)
    swept = framework("-m", *TINY, "trainer.max_epochs=1", folder=None)
    assert swept.code == 0, swept.out
    database = base / "outputs" / "mlflow.db"
    with sqlite3.connect(database) as store:
        runs = store.execute("SELECT run_uuid, status, artifact_uri FROM runs").fetchall()
    assert [status for _, status, _ in runs] == ["FINISHED"] * 2
    kept = {file.name for file in (base / "outputs" / "artifacts").rglob("*") if file.is_file()}
    assert {"comparison.csv", "results.json", "model.ckpt"} <= kept
    (sweep,) = (path.parent for path in (base / "outputs").rglob("multirun.yaml"))
    synced = framework("mode=sync", f"mode.run={in_quotes(str(sweep))}", folder=None)
    assert (synced.code, synced.out.count(" journal lines sent from")) == (0, 2), synced.out
    assert list((tmp_path / "home").iterdir()) == [base], "nothing lies elsewhere"


def test_a_database_without_its_package_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("framework.tracking.stores.find_spec", lambda name: None)
    with pytest.raises(
        ConfigError, match=r"needs the package psycopg2, which is not installed\. Use postgresql\+psy"
    ):
        address("postgresql+psycopg2://db/x", tmp_path)
    with pytest.raises(ConfigError, match="needs the package psycopg,"):
        address("postgresql://me:secret@db/x", tmp_path)


ENDLESS = "WITH RECURSIVE counted(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM counted)"
STATEMENTS = {
    "view": f"CREATE VIEW runs AS {ENDLESS} SELECT x FROM counted",
    "trigger": "CREATE TRIGGER runs AFTER INSERT ON kept BEGIN "
    f"INSERT INTO kept SELECT x FROM ({ENDLESS} SELECT x FROM counted); END",
    "condition": f"CREATE TRIGGER runs AFTER INSERT ON kept WHEN ({ENDLESS} SELECT count(*) FROM counted) > 1 BEGIN "
    "SELECT RAISE(ABORT, 'no'); END",
    "not UTF-8": b"CREATE VIEW runs AS SELECT '\xff'",
    "virtual table": "CREATE VIRTUAL TABLE runs USING fts5(text)",
}
"""Statements that SQLite would run in queries of MLflow."""
PLACEHOLDER = "CREATE VIEW runs AS SELECT 1"
"""View whose statement is replaced by one that is not UTF-8, which Python cannot pass to SQLite."""


@pytest.mark.parametrize("statement", STATEMENTS)
def test_a_default_store_holds_tables_alone(statement: str, tmp_path: Path) -> None:
    """A query of a view without end would never return."""
    file = tmp_path / "mlflow.db"
    uri = default_uri(tmp_path / "run")
    require_own_files(uri)  # there is no file yet
    with closing(sqlite3.connect(file)) as store, store:
        store.execute("CREATE TABLE kept (x)")
        store.execute("CREATE UNIQUE INDEX of_kept ON kept (x)")
        store.execute(
            "CREATE TRIGGER held BEFORE UPDATE ON kept WHEN OLD.x != NEW.x BEGIN SELECT RAISE(ABORT, 'no'); END"
        )  # as MLflow makes one
    require_own_files(uri)
    with closing(sqlite3.connect(file)) as store, store:
        store.execute(PLACEHOLDER if statement == "not UTF-8" else STATEMENTS[statement])
        if statement == "not UTF-8":
            store.execute("PRAGMA writable_schema = ON")
            store.execute(
                "UPDATE sqlite_master SET sql = CAST(? AS TEXT) WHERE name = 'runs'", [STATEMENTS[statement]]
            )
    with pytest.raises(DataError, match=r"holds runs, which is neither a table.*logger\.uri=sqlite"):
        require_own_files(uri)
    with closing(sqlite3.connect(file)) as store, store:
        store.execute("PRAGMA writable_schema = ON")
        store.execute("UPDATE sqlite_master SET type = 'table' WHERE name = 'runs'")
    with closing(sqlite3.connect(file)) as store:
        try:
            store.execute("SELECT x FROM kept")
        except sqlite3.DatabaseError:  # SQLite uses no database with such an entry
            return
    with pytest.raises(DataError, match="holds runs"):
        require_own_files(uri)
