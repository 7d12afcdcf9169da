"""An MLflow server with a PostgreSQL database and passwords on this machine for tests and benchmarks, on loopback.

It needs the programs of Debian's package postgresql, psycopg2 and Flask-WTF (`mlflow[auth]`).
"""

import json
import math
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Self

from framework.tracking.run_info import MODEL

AUTHORIZATION = """[mlflow]
default_permission = EDIT
database_uri = {database}/passwords
admin_username = admin
admin_password = {password}
auth_cache_ttl_seconds = 60
authorization_function = mlflow.server.auth:authenticate_request_basic_auth
"""


def missing_parts() -> list[str]:
    """Return what the server needs and this machine lacks."""
    missing = [] if _programs() is not None else ["PostgreSQL (apt-get install postgresql)"]
    packages = {"psycopg2": "psycopg2 (pip install '.[postgres]')", "flask_wtf": "Flask-WTF (mlflow[auth])"}
    return missing + [remedy for name, remedy in packages.items() if find_spec(name) is None]


class StoreServer:
    """PostgreSQL and an MLflow server that keeps its runs and passwords there and its files in a folder.

    Both end with the `with` block of this object.

    Args:
        folder: Folder of all files; other users must be able to enter the folders above it, because PostgreSQL does not
            run as root.

    Attributes:
        uri: Address of the server.
        environment: Environment variables with which a client reaches the server.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        programs = _programs()
        assert programs is not None
        self.programs = programs
        database_port, self.port = _free_ports(2)
        # words without a special meaning in an address
        self._password, password = secrets.token_hex(8), secrets.token_hex(8)
        self._account = (
            {"user": "postgres", "group": "postgres", "extra_groups": ()} if os.getuid() == 0 else {}
        )
        self._data = folder / "data"
        self.uri = f"http://127.0.0.1:{self.port}"
        self.environment = {
            "MLFLOW_TRACKING_URI": self.uri,
            "MLFLOW_TRACKING_USERNAME": "admin",
            "MLFLOW_TRACKING_PASSWORD": password,
        }
        self.database = f"postgresql+psycopg2://mlflow:{self._password}@127.0.0.1:{database_port}"
        (folder / "password").write_text(self._password)
        (folder / "authorization.ini").write_text(
            AUTHORIZATION.format(database=self.database, password=password)
        )
        if self._account:
            shutil.chown(folder, "postgres")
            shutil.chown(folder / "password", "postgres")
        self._postgres(
            *("initdb", "-U", "mlflow", f"--pwfile={folder / 'password'}", "-A", "scram-sha-256"),
            *("-E", "UTF8", "--locale=C.UTF-8"),
        )
        self._postgres(
            *("pg_ctl", "-w", "-l", str(folder / "database.log"), "start"),
            *("-o", f"-p {database_port} -h 127.0.0.1 -k {folder}"),
        )
        self._database = int((self._data / "postmaster.pid").read_text().split()[0])
        self._server: subprocess.Popen[bytes] | None = None
        try:
            for name in ("runs", "passwords"):
                self._run("createdb", "-h", "127.0.0.1", "-p", str(database_port), "-U", "mlflow", name)
            self.start()
        except BaseException:
            self.__exit__()
            raise

    def start(self) -> None:
        """Start the MLflow server, and wait until it answers."""
        command = [sys.executable, "-m", "mlflow", "server", "--backend-store-uri", f"{self.database}/runs"]
        command += ["--artifacts-destination", str(self.folder / "files"), "--app-name", "basic-auth"]
        command += ["--host", "127.0.0.1", "--port", str(self.port), "--workers", "1"]
        environment = {
            **os.environ,
            "MLFLOW_AUTH_CONFIG_PATH": str(self.folder / "authorization.ini"),
            "MLFLOW_FLASK_SERVER_SECRET_KEY": self._password,
            "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",  # else ten more processes
            "MLFLOW_DISABLE_TELEMETRY": "true",
        }
        environment.pop("MLFLOW_TRACKING_URI", None)
        with (self.folder / "server.log").open("ab") as log:
            self._server = subprocess.Popen(
                command, env=environment, stdout=log, stderr=log, start_new_session=True, cwd=self.folder
            )
        deadline = time.monotonic() + 120
        while not self._answers():
            if time.monotonic() > deadline or self._server.poll() is not None:
                raise TimeoutError(
                    f"the server did not start:\n{(self.folder / 'server.log').read_text()[-4000:]}"
                )
            time.sleep(0.2)

    def kill(self) -> None:
        """Kill the MLflow server with all its processes, as when its machine loses its power."""
        if self._server is not None:
            with suppress(ProcessLookupError):
                os.killpg(self._server.pid, signal.SIGKILL)
            self._server.wait()
            self._server = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.kill()
        self._postgres("pg_ctl", "-m", "immediate", "-w", "stop")

    def database_megabytes(self) -> float:
        """Return the size of the database of the runs, MB."""
        from psycopg2 import connect

        connection = connect(f"{self.database.replace('+psycopg2', '')}/runs")
        with connection, connection.cursor() as cursor:
            cursor.execute("select pg_database_size('runs')")
            (size,) = cursor.fetchone() or (0,)
        connection.close()
        return size / 1e6

    def memory_megabytes(self) -> tuple[float, float]:
        """Return the proportional memory of the processes of the MLflow server and of the database, MB (Linux)."""
        assert self._server is not None
        server, database = (
            sum(_megabytes(process, "smaps_rollup", "Pss") for process in _family(pid))
            for pid in (self._server.pid, self._database)
        )
        return server, database

    def peak_megabytes(self) -> float:
        """Return the largest memory that a process of the MLflow server has had so far, MB (Linux)."""
        assert self._server is not None
        return max(_megabytes(process, "status", "VmHWM") for process in _family(self._server.pid))

    def _answers(self) -> bool:
        try:
            with urllib.request.urlopen(f"{self.uri}/health", timeout=5) as answer:
                return answer.status == 200
        except OSError:
            return False

    def _postgres(self, program: str, *words: str) -> None:
        """Run a program that works on the folder of the database, as a user other than root."""
        self._run(program, "-D", str(self._data), *words, **self._account)

    def _run(self, program: str, *words: str, **account: object) -> None:
        done = subprocess.run(
            [self.programs / program, *words],
            env={**os.environ, "PGPASSWORD": self._password},
            stdout=subprocess.DEVNULL,  # a pipe would stay open in the database
            stderr=subprocess.DEVNULL,
            cwd=self.folder,
            check=False,
            **account,  # type: ignore[call-overload]
        )
        if done.returncode:
            raise RuntimeError(f"{program} {' '.join(words)} failed with exit code {done.returncode}")


@dataclass
class Counts:
    """Comparison of the journals of runs with a store.

    Attributes:
        runs: Runs.
        runs_twice: Further runs with the key of one of them in the store.
        values: Numbers of metrics in the journals.
        lost: Those that the store lacks.
        twice: Numbers that the store holds in addition.
        files: Files that the journals name, with the files of folders; a model counts as one.
        files_lost: Those that the store lacks, or holds with another size.
        files_twice: Files and models that the store holds in addition.
    """

    runs: int = 0
    runs_twice: int = 0
    values: int = 0
    lost: int = 0
    twice: int = 0
    files: int = 0
    files_lost: int = 0
    files_twice: int = 0


def count(client: Any, folders: Iterable[Path]) -> Counts:
    """Compare the journals of runs with a store, of which `client` is an `MlflowClient`."""
    counts = Counts()
    for folder in folders:
        info = json.loads((folder / "run.json").read_text())
        run_id = info["run_id"]
        experiment = client.get_run(run_id).info.experiment_id
        same_key = client.search_runs([experiment], f"tags.`framework.key` = '{info['key']}'")
        counts.runs += 1
        counts.runs_twice += len(same_key) - 1
        lines = [json.loads(line) for line in (folder / "journal.jsonl").read_text().splitlines()]
        wanted = Counter(
            (key, line["step"], str(float(value)))
            for line in lines
            for key, value in line.get("values", {}).items()
        )
        stored = Counter(
            (key, point.step, _journal_number(point.value))
            for key in {key for key, _, _ in wanted}
            for point in client.get_metric_history(run_id, key)
        )
        counts.values += wanted.total()
        counts.lost += (wanted - stored).total()
        counts.twice += (stored - wanted).total()
        expected = dict(item for line in lines if "artifact" in line for item in _files(folder, line))
        models = client.search_logged_models([experiment], f"source_run_id = '{run_id}'")
        found = dict(_stored_files(client.list_artifacts, run_id))
        for number, model in enumerate(models):
            sizes = dict(_stored_files(client.list_logged_model_artifacts, model.model_id))
            sizes.pop("MLmodel", None)
            found |= {f"{MODEL}{name}{number or ''}": size for name, size in sizes.items()}
        counts.files += len(expected)
        counts.files_lost += len(expected.items() - found.items())
        counts.files_twice += len(found.keys() - expected.keys())
    return counts


def _journal_number(value: float) -> str:
    """Return a number of the store as the journal writes it; databases have no infinity."""
    return str(math.copysign(math.inf, value) if abs(value) > 1.79e308 else value)


def _files(folder: Path, line: dict[str, Any]) -> Iterator[tuple[str, int]]:
    """Yield the path in the store and the size of each file of a journal line."""
    path = folder / line["artifact"]
    prefix = line["folder"] if line["folder"] == MODEL else f"{line['folder']}/" if line["folder"] else ""
    for file in path.rglob("*") if path.is_dir() else [path]:
        if file.is_file():
            yield f"{prefix}{file.relative_to(path.parent)}", file.stat().st_size


def _stored_files(listed: Any, identity: str, path: str | None = None) -> Iterator[tuple[str, int]]:
    for file in listed(identity, path):
        if file.is_dir:
            yield from _stored_files(listed, identity, file.path)
        else:
            yield file.path, file.file_size


def _family(pid: int) -> list[int]:
    """Return the numbers of a process and of its descendants."""
    parents = dict[int, int]()
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # the process has ended
            parents[int(process.name)] = int((process / "stat").read_text().rpartition(")")[2].split()[1])

    def belongs(number: int) -> bool:
        return number == pid or (number in parents and belongs(parents[number]))

    return [number for number in parents if belongs(number)]


def _megabytes(pid: int, file: str, name: str) -> float:
    """Return the number of megabytes with a name in a file of a process; 0 if the process has ended."""
    with suppress(OSError):
        lines = Path(f"/proc/{pid}/{file}").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:")) * 1024 / 1e6
    return 0.0


def _programs() -> Path | None:
    """Return the folder of PostgreSQL's programs, of the newest version; None if PostgreSQL is not installed."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), key=lambda path: int(path.parts[-3]))
    return found[-1].parent if found else None


def _free_ports(count: int) -> list[int]:
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for listener in sockets:
            listener.bind(("127.0.0.1", 0))
        return [listener.getsockname()[1] for listener in sockets]
