"""Fixtures that run the command line as a user does: in a separate folder, with a third-party package installed."""

import json
import os
import select
import shlex
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.machinery import PathFinder
from importlib.util import cache_from_source
from pathlib import Path
from typing import Any

import pytest
import yaml
from _pytest.mark import ParameterSet
from filelock import FileLock

from framework.configuration.paths import paths_of, shell_arguments
from framework.storage.cache import folder as cache_folder

Once = Callable[[str, Callable[[Path], None]], Path]
STRANGER = Path(__file__).parent / "stranger"
PATIENCE = 900.0
"""Time after which a command counts as hanging, seconds; on a busy machine some commands take five minutes."""
TINY = [
    "data=dial",
    "density_head=wrapped_cauchy",
    "encoder=[mlp]",
    "encoder.mlp.widths=[16]",
    "encoder.mlp.dropout=0.2",
    "encoder.mlp.batch_norm=true",
    "metric=[log_likelihood,angular_deviation]",
    "batch_size=16",
    "trainer.max_epochs=3",
    "trainer.log_every_steps=1",
    "threads=1",
    "pictures=false",
]
"""Settings of a run of 27 steps (9 in each epoch) on the third-party data, half a second long after its imports."""


def imported_by(module: str) -> set[str]:
    """Return the names of the modules that the import of a module loads."""
    script = f"import sys, {module}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def wait_for(condition: Callable[[], object], seconds: float = PATIENCE) -> None:
    """Wait until the condition holds, and fail after so many seconds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.01)


def first_of_each(
    cases: Iterable[Any], kind: Callable[[Any], Hashable], name: Callable[[Any], str] | None = None
) -> list[ParameterSet]:
    """Return parameters of a test: of each kind of case the first, and all others as slow tests.

    Args:
        cases: a tuple where the test takes several parameters.
        kind: what cases that test nearly the same have in common.
        name: for the test's id; none leaves it to pytest.
    """
    seen = set[Hashable]()
    parameters = []
    for case in cases:
        marks = [pytest.mark.slow] if kind(case) in seen else []
        values = case if isinstance(case, tuple) else (case,)
        parameters.append(pytest.param(*values, marks=marks, id=name(case) if name else None))
        seen.add(kind(case))
    return parameters


@contextmanager
def importing_mlflow() -> Iterator[None]:
    """Import MLflow within: without its warnings, and with the standard library's reader of metadata put back.

    MLflow imports importlib_metadata, which removes `PathFinder.find_distributions` for the whole process. Other tests
    of this process read entry points, and expect the standard library's types.
    """
    finders, reader = list(sys.meta_path), PathFinder.__dict__["find_distributions"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
    sys.meta_path[:] = finders
    PathFinder.find_distributions = reader


@dataclass
class Done:
    """Exit code, output and run folder of a command that has ended."""

    code: int
    out: str
    folder: Path

    def losses(self) -> dict[int, float]:
        """Return the training loss by step from the journal, to the last bit."""
        return self.values("train/loss")

    def values(self, name: str) -> dict[int, float]:
        """Return the values of one metric by step, from the journal."""
        found: dict[int, float] = {}
        for line in (self.folder / "journal.jsonl").read_text(encoding="utf-8").splitlines():
            record: Mapping[str, Any] = json.loads(line)
            if name in record.get("values", {}):
                assert record["step"] not in found, f"step {record['step']} stands twice in the journal"
                found[record["step"]] = record["values"][name]
        return found


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Once:
    """Function that fills the folder of a name by calling another function; of several test workers, only the first
    calls it."""
    base = tmp_path_factory.getbasetemp()
    shared = base if worker_id == "master" else base.parent

    def made(name: str, make: Callable[[Path], None]) -> Path:
        folder, done = shared / name, shared / f"{name}.done"
        with FileLock(shared / f"{name}.lock"):
            if not done.exists():
                folder.mkdir(exist_ok=True)
                make(folder)
                done.touch()
        return folder

    return made


RUN_TUTORIAL = """
import pathlib, sys, time
sys.path.insert(0, sys.argv[1])
import notebooks
start = time.perf_counter()
notebooks.run(pathlib.Path(sys.argv[2]).read_text("utf-8"), pathlib.Path.cwd())
pathlib.Path("seconds.txt").write_text(str(time.perf_counter() - start))
"""


@pytest.fixture(scope="session")
def run_tutorial(once: Once) -> Callable[[str], Path]:
    """Return a function that runs a tutorial as a notebook, once for all tests, and returns its folder.

    The folder's file seconds.txt holds the run time.
    """
    docs = Path(__file__).parent.parent / "docs"

    def run(name: str) -> Path:
        def make(folder: Path) -> None:
            page = docs / "tutorials" / f"{name}.md"
            done = subprocess.run(
                [sys.executable, "-c", RUN_TUTORIAL, str(docs), str(page)],
                cwd=folder,
                capture_output=True,
                text=True,
            )
            assert done.returncode == 0, done.stderr

        return once(f"tutorial_{name}", make)

    return run


@pytest.fixture(scope="session")
def stranger_site(once: Once) -> Path:
    """Return the folder into which pip has installed the third-party package."""

    def install(site: Path) -> None:
        arguments = ["install", "--quiet", "--no-deps", "--no-build-isolation", "--target", site, STRANGER]
        done = subprocess.run(
            [sys.executable, "-m", "pip", *arguments], capture_output=True, text=True, timeout=PATIENCE
        )
        assert done.returncode == 0, done.stderr

    return once("site", install)


LISTING = """
import sys
sys.argv[0] = "framework"
from framework.app import main
try:
    main()
finally:
    print("MODULES", *sys.modules)
"""


@dataclass
class Listed:
    """Exit code, output and imported modules of a command."""

    code: int
    out: str
    modules: set[str]


def listed(*arguments: str, folder: Path, site: Path | None = None, before: str = "") -> Listed:
    """Run the command line in `folder`, after the script `before`, and list what it has imported at its end."""
    environment = {**os.environ, "PYTHONPATH": str(site or ""), "FRAMEWORK_CACHE": str(folder / "cache")}
    done = subprocess.run(
        [sys.executable, "-c", before + LISTING, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    lines = [line for line in done.stdout.splitlines() if line.startswith("MODULES ")]
    return Listed(done.returncode, done.stdout + done.stderr, set(lines[-1].split()[1:]) if lines else set())


class Forks:
    """Server that runs commands in forks of one process that has already imported torch (`fork_server.py`)."""

    def __init__(self) -> None:
        self.start()

    def start(self) -> None:
        self.server = subprocess.Popen(
            [sys.executable, Path(__file__).with_name("fork_server.py")],
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )

    def __call__(self, seconds: float = PATIENCE, **command: object) -> int:
        """Exit code of a command, below 0 the signal that killed it; `command` is what the server reads."""
        assert self.server.stdin is not None
        assert self.server.stdout is not None
        self.server.stdin.write(json.dumps(command, default=str).encode() + b"\n")
        self.server.stdin.flush()
        ready, _, _ = select.select([self.server.stdout], [], [], seconds)
        if not ready:
            self.close()
            self.start()
            raise TimeoutError(f"{command['arguments']} did not end within {seconds} s")
        return int(self.server.stdout.readline())

    def close(self) -> None:
        """End the server and all commands that run in it."""
        os.killpg(self.server.pid, signal.SIGKILL)
        self.server.communicate()


@pytest.fixture(scope="session")
def forks() -> Iterator[Forks]:
    """Yield one fork server for all tests of this process."""
    forks = Forks()
    yield forks
    forks.close()


Framework = Callable[..., Done]


def paths_again(arguments: Sequence[str]) -> list[str]:
    """Return the arguments with which a command that resumes a run must repeat the paths in its config."""
    for argument in arguments:
        config = Path(argument.removeprefix("resume=")) / "config.yaml"
        if argument.startswith("resume=") and config.is_file():
            stored = paths_of(yaml.safe_load(config.read_text(encoding="utf-8")))
            return [word for word in shlex.split(" ".join(shell_arguments(stored))) if word not in arguments]
    return []


def command(forks: Forks, site: Path, base: Path) -> Framework:
    """Call `python -m framework` in `base`; `folder` names the run folder if there is one, `more` extra environment.

    Beside `resume=<folder>` the paths of that run are said again, unless a test looks at what is told without them.
    """

    def call(
        *arguments: str,
        folder: str | None = "run",
        more: Mapping[str, str] | None = None,
        paths: tuple[Path, ...] = (),
        say_again: bool = True,
    ) -> Done:
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(map(str, (site, *paths))),
            "COLUMNS": "250",  # so that no line is folded, however long a path in it
            "OMP_NUM_THREADS": "1",
            "FRAMEWORK_CACHE": str(base / "cache"),
            "NUMBA_CACHE_DIR": str(cache_folder("numba")),  # so that kernels are compiled once for all tests
            **(more or {}),
        }
        run, output = base / (folder or ""), base / "output.txt"
        own = folder is None or any(item.startswith(("resume=", "hydra.", "-")) for item in arguments)
        for module in (module for path in paths for module in path.rglob("*.py")):
            # Python takes compiled code for current where the source has its size and was written in its second.
            Path(cache_from_source(str(module))).unlink(missing_ok=True)
        code = forks(
            arguments=[
                *arguments,
                *(paths_again(arguments) if say_again else ()),
                *([] if own else [f"hydra.run.dir={run}"]),
            ],
            environment=environment,
            folder=base,
            packages=(site, *paths),
            output=output,
        )
        return Done(code, output.read_text(encoding="utf-8"), run)

    return call


@pytest.fixture
def framework(forks: Forks, stranger_site: Path, tmp_path: Path) -> Framework:
    """Return a function that runs the command line in a folder of this test."""
    return command(forks, stranger_site, tmp_path)


@pytest.fixture(scope="session")
def whole(stranger_site: Path, once: Once) -> Done:
    """Run the tiny settings without interruption. Interrupted runs must equal this run; tests must not change its
    folder."""

    def train(base: Path) -> None:
        run = f"hydra.run.dir={base / 'run'}"
        done = listed(*TINY, "logger=none", run, folder=base, site=stranger_site)
        assert done.code == 0, done.out
        (base / "output.txt").write_text(done.out, encoding="utf-8")

    base = once("whole", train)
    return Done(0, (base / "output.txt").read_text(encoding="utf-8"), base / "run")
