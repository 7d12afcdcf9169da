"""Runs the command line as a user does: in a folder of its own, with a stranger's package installed beside ours."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

STRANGER = Path(__file__).parent / "stranger"
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
]
"""A run of 27 steps (9 an epoch) on the stranger's data, done in a second after its imports."""


@dataclass
class Done:
    """What a command left behind."""

    code: int
    out: str
    folder: Path

    def losses(self) -> dict[int, float]:
        """Training loss by step, to the last bit, from the journal."""
        found: dict[int, float] = {}
        for line in (self.folder / "journal.jsonl").read_text(encoding="utf-8").splitlines():
            record: Mapping[str, Any] = json.loads(line)
            if "train/loss" in record.get("values", {}):
                assert record["step"] not in found, f"step {record['step']} stands twice in the journal"
                found[record["step"]] = record["values"]["train/loss"]
        return found


@pytest.fixture(scope="session")
def stranger_site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The stranger's package, built and installed by pip into a folder of its own."""
    site = tmp_path_factory.mktemp("site")
    arguments = [
        "install",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "--target",
        str(site),
        str(STRANGER),
    ]
    done = subprocess.run(
        [sys.executable, "-m", "pip", *arguments], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return site


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


def listed(*arguments: str, folder: Path, site: Path | None = None) -> Listed:
    """Run the command line in `folder` and list what it has imported at its end."""
    environment = {**os.environ, "PYTHONPATH": str(site or ""), "FRAMEWORK_CACHE": str(folder / "cache")}
    done = subprocess.run(
        [sys.executable, "-c", LISTING, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    lines = [line for line in done.stdout.splitlines() if line.startswith("MODULES ")]
    return Listed(done.returncode, done.stdout + done.stderr, set(lines[-1].split()[1:]) if lines else set())


Framework = Callable[..., Done]


def command(site: Path, base: Path) -> Framework:
    """Call `python -m framework` in `base`; `folder` names the run folder, `more` extra environment."""

    def call(
        *arguments: str,
        folder: str = "run",
        more: Mapping[str, str] | None = None,
        paths: tuple[Path, ...] = (),
    ) -> Done:
        python_path = os.pathsep.join(str(path) for path in (site, *paths))
        environment = {**os.environ, "PYTHONPATH": python_path, "OMP_NUM_THREADS": "1", "COLUMNS": "100"}
        environment |= {"FRAMEWORK_CACHE": str(base / "cache"), **(more or {})}
        run = base / folder
        own = any(item.startswith(("resume=", "hydra.", "-")) for item in arguments)
        done = subprocess.run(
            [sys.executable, "-m", "framework", *arguments, *([] if own else [f"hydra.run.dir={run}"])],
            cwd=base,
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
        )
        return Done(done.returncode, done.stdout + done.stderr, run)

    return call


@pytest.fixture
def framework(stranger_site: Path, tmp_path: Path) -> Framework:
    """The command line, in a folder of this test's own."""
    return command(stranger_site, tmp_path)


@pytest.fixture(scope="session")
def whole(stranger_site: Path, tmp_path_factory: pytest.TempPathFactory) -> Done:
    """The tiny run without interruption, which interrupted ones must equal; read it, change nothing."""
    done = command(stranger_site, tmp_path_factory.mktemp("whole"))(*TINY, "logger=none")
    assert done.code == 0, done.out
    return done
