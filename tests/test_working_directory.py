"""Commands in an unpacked archive, which import no file of the archive."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.conftest import TINY, listed

ROOT = Path(__file__).resolve().parent.parent
COMMANDS = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__main__")
    for path in (ROOT / "plugins").rglob("*.py")
    if '__name__ == "__main__"' in path.read_text(encoding="utf-8")
)


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory, stranger_site: Path) -> Path:
    """Make a folder with a module for each name that a run imports, except those that `python -m` loads first."""
    base = tmp_path_factory.mktemp("working_directory")
    used = listed(*TINY, "trainer.max_epochs=1", folder=base, site=stranger_site)
    assert used.code == 0, used.out
    archive = base / "archive"
    archive.mkdir()
    ours = {"framework", "plugins", "__main__"}  # whose names stand in the command: `python -P -m` for those
    for name in (
        {one.partition(".")[0] for one in used.modules} | sys.stdlib_module_names | {"git", "usercustomize"}
    ):
        if name not in ours:
            text = (
                f"open({str(base / 'imported')!r}, 'a').write('{name}\\n')\nraise ImportError('a stranger')\n"
            )
            (archive / f"{name}.py").write_text(text)
    (archive / "hydra_plugins.py").unlink()
    (archive / "hydra_plugins" / "x").mkdir(parents=True)
    (archive / "hydra_plugins" / "x" / "__init__.py").write_text(text)
    (archive / "x-1.dist-info").mkdir()
    (archive / "x-1.dist-info" / "METADATA").write_text("Name: x\nVersion: 1\n")
    (archive / "x-1.dist-info" / "entry_points.txt").write_text("[framework.data]\nstrange = yaml:Strange\n")
    (base / "trivial").mkdir()
    (base / "trivial" / "trivial.py").write_text("")
    while imported(archive, ["trivial"], base / "trivial"):
        for name in (base / "imported").read_text().split():
            (archive / f"{name}.py").unlink()
    assert len(list(archive.iterdir())) > 300
    return archive


def imported(archive: Path, command: Sequence[str], *paths: Path, code: int | None = None) -> list[str]:
    """Return the modules that `python -m` imports from the archive in which it runs."""
    marker = archive.parent / "imported"
    marker.unlink(missing_ok=True)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}
    done = subprocess.run(
        [sys.executable, "-m", *command],
        cwd=archive,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert code is None or done.returncode == code, done.stderr
    return marker.read_text().split() if marker.exists() else []


@pytest.mark.slow
def test_a_run_imports_nothing_of_the_archive(archive: Path, stranger_site: Path) -> None:
    run = ["framework", *TINY, "trainer.max_epochs=1", "workers=1"]
    assert imported(archive, run, stranger_site, code=0) == []
    assert imported(archive, ["framework", "data=strange"], code=2) == []


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_no_command_of_a_plugin_imports_any(command: str, archive: Path) -> None:
    assert imported(archive, [command, "--help"], code=0) == []
