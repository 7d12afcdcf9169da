"""Cached compiled code, which must belong to the present source files."""

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from framework.geometry.nearest import compiled
from framework.storage import kernels
from framework.storage.kernels import kernel_cache
from plugins.encoder.projection import compiled as projecting
from plugins.renderer.rasterizer import raster

TOP = Path(__file__).parent.parent


def test_code_is_kept_anew_where_any_of_its_files_changed(tmp_path: Path) -> None:
    sources = [tmp_path / "one.py", tmp_path / "other.py"]
    for source in sources:
        source.write_text("pass\n", encoding="utf-8")
    first = kernel_cache("tested", sources)
    assert first is not None and kernel_cache("tested", reversed(sources)) == first
    sources[1].write_text("pass  # changed\n", encoding="utf-8")
    assert kernel_cache("tested", sources) not in (first, None)


@pytest.mark.parametrize(
    ("names", "home"),
    [(raster.KERNELS, raster), (compiled.PARTS, compiled), (("compiled",), projecting)],
)
def test_every_file_that_compiles_is_among_the_sources(names: tuple[str, ...], home: object) -> None:
    """Numba notices changes only in the file of a function, and not in functions that this function calls."""
    folder = Path(str(vars(home)["__file__"])).parent
    compiling = re.compile(r"^@(compiled|reordered|inlined)", re.MULTILINE)
    found = {file.stem for file in folder.glob("*.py") if compiling.search(file.read_text(encoding="utf-8"))}
    assert found and found <= set(names)
    assert all((folder / f"{name}.py").is_file() for name in names)


FILES = [file for root in ("framework", "plugins") for file in (TOP / root).rglob("*.py")]
ALONE = re.compile(r"kernel_cache\([^,]+, \[Path\(__file__\)\]\)")


def test_kernels_that_call_other_files_are_kept_by_their_sources() -> None:
    """A file whose code is cached separately uses no compiled function of another file."""
    alone = [file for file in FILES if ALONE.search(file.read_text(encoding="utf-8"))]
    assert len(alone) > 5
    for file in alone:
        text = file.read_text(encoding="utf-8")
        for module in re.findall(r"^from ((?:framework|plugins)[\w.]+) import", text, re.MULTILINE):
            other = TOP / (module.replace(".", "/") + ".py")
            made = other.read_text(encoding="utf-8") if other.is_file() else ""
            assert other.name == "kernels.py" or ("njit" not in made and "compiler(" not in made), (
                f"{file} calls kernels of {other}"
            )


def test_long_compilation_is_announced_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(kernels, "QUIET_TIME", 0.2)
    announcement = kernels._Announcement()
    printed = []
    for seconds in (0.0, 0.5, 0.5):
        announcement.on_start(None)
        time.sleep(seconds)
        announcement.on_end(None)
        printed.append(capsys.readouterr().err)
    assert [bool(text) for text in printed] == [False, True, False]


def test_numba_itself_keeps_no_code() -> None:
    """Numba refuses to import a module whose code it can cache neither beside the module nor in the home folder."""
    own = [file for file in FILES if re.search(r"cache=True|cuda\.jit", file.read_text(encoding="utf-8"))]
    assert own == []


@pytest.mark.slow
def test_kernels_work_where_no_folder_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    nowhere = str(tmp_path / "file" / "below")
    modules = [
        ".".join(file.relative_to(TOP).with_suffix("").parts)
        for file in FILES
        if "compiler(" in file.read_text(encoding="utf-8") and file.name != "kernels.py"
    ]
    assert len(modules) > 10
    code = (
        f"from importlib import import_module\nfor name in {modules}:\n    import_module(name)\n"
        "import numpy as np\nfrom framework.geometry.farthest_compiled import farthest\n"
        "found = farthest(np.eye(3)[None], np.array([3]), 3)\nassert sorted(found[0]) == [0, 1, 2], found\n"
    )
    places = {
        "FRAMEWORK_CACHE": nowhere,
        "NUMBA_CACHE_DIR": nowhere,
        "HOME": nowhere,
        "XDG_CACHE_HOME": nowhere,
    }
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **places},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
