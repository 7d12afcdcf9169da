"""Commands in an unpacked archive, which import no file of the archive and use no settings of other packages in it."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from framework.errors import ConfigError
from framework.storage.working_directory import SETTINGS, refuse_settings
from framework.tracking.copies import require_packages
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


def plant(folder: Path, name: str, kind: str, text: str = "") -> None:
    """Put a file, a pipe or a link to nowhere with this name into a folder."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "link":
        path.symlink_to(folder / "nowhere")
    else:
        path.write_text(text)


@pytest.mark.parametrize("kind", ["file", "pipe", "link"])
@pytest.mark.parametrize(("package", "name"), [(key, name) for key in SETTINGS for name in SETTINGS[key]])
def test_settings_of_other_packages_are_refused(
    package: str, name: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    refuse_settings(SETTINGS)
    plant(tmp_path, name, kind)
    with pytest.raises(ConfigError, match=f"contains {name}"):
        refuse_settings([package])
    refuse_settings(SETTINGS.keys() - {package})
    require_packages(["csv"])  # wandb reads nothing if it is not used
    if package == "wandb":
        with pytest.raises(ConfigError, match=f"contains {name}"):
            require_packages(["wandb"])


@pytest.mark.parametrize("name", ["wandb", ".wandb"])
def test_wandb_writes_to_no_link(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("WANDB_DIR", raising=False)
    (tmp_path / "outputs").mkdir()
    (tmp_path / "outputs" / name).symlink_to(tmp_path, target_is_directory=True)
    with pytest.raises(ConfigError, match="is a link"):
        require_packages(["wandb"])
    monkeypatch.setenv("WANDB_DIR", "outputs")
    require_packages(["wandb"])


LOADS_KERNELS = "import framework.geometry.farthest_compiled"


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (["-m", "framework", "seed=1"], ".numba_config.yaml"),
        (["-m", "framework", "seed=1"], "matplotlibrc"),
        (["-m", "plugins.renderer.rasterizer", "body.off"], ".numba_config.yaml"),
        (["-c", LOADS_KERNELS], ".numba_config.yaml"),
    ],
)
def test_no_command_uses_settings_of_other_packages(arguments: list[str], name: str, tmp_path: Path) -> None:
    """Numba would unpickle files of the folder that its settings name."""
    plant(tmp_path, name, "file", "cache_dir: cache\n" if "numba" in name else "text.usetex: True\n")
    done = subprocess.run(
        [sys.executable, "-P", *arguments],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode != 0 and f"The working directory contains {name}" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == [name]


WATCHED = """
import atexit, os, runpy, sys
here, marker, seen = os.getcwd(), sys.argv[1], set()
def watch(path):
    if isinstance(path, (str, bytes, os.PathLike)):
        name = os.path.relpath(os.path.join(here, os.fsdecode(path)), here)
        if not name.startswith(".."):
            seen.add(name)
def watching(function):
    def wrapper(path, *arguments, **options):
        watch(path)
        return function(path, *arguments, **options)
    return wrapper
os.stat, os.lstat = watching(os.stat), watching(os.lstat)
sys.addaudithook(lambda event, arguments: watch(arguments[0]) if event == "open" else None)
atexit.register(lambda: open(marker, "w").write(chr(10).join(seen)))
sys.argv = ["framework", *sys.argv[2:]]
runpy.run_module("framework", run_name="__main__")
"""
READ = {".", ".git", "HEAD", ".wandb"}
"""Names that a run looks for: those of the repository (`tests/test_repository.py`), and a folder of wandb."""


@pytest.mark.slow
def test_a_run_looks_for_no_other_file_in_the_working_directory(tmp_path: Path, stranger_site: Path) -> None:
    """A package that is added or updated may read further settings; `SETTINGS` must then name their file."""
    folder = tmp_path / "archive"
    folder.mkdir()
    command = [*TINY, "trainer.max_epochs=1", "pictures=true", "logger=[mlflow,csv,tensorboard,wandb]"]
    environment = {**os.environ, "PYTHONPATH": str(stranger_site)}
    done = subprocess.run(
        [sys.executable, "-P", "-c", WATCHED, str(tmp_path / "seen"), *command],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    seen = set((tmp_path / "seen").read_text().splitlines())
    known = {name for names in SETTINGS.values() for name in names}
    assert known <= seen
    texts = {
        name for name in seen if name.startswith("<") or name.endswith(".py")
    }  # sources for stack traces
    ours = {name for name in seen if name.partition("/")[0] == "outputs"}
    assert {name for name in seen - known - texts - ours if name.partition("/")[0] not in READ} == set()
