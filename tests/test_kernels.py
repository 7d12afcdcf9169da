"""Compiled code on disk is that of the sources as they are."""

import re
from pathlib import Path

import pytest

from framework.geometry.nearest import compiled
from framework.storage.kernels import kept_in
from plugins.renderer.rasterizer import raster
from plugins.renderer.smplpix import compiled as projecting


def test_code_is_kept_anew_where_any_of_its_files_changed(tmp_path: Path) -> None:
    sources = [tmp_path / "one.py", tmp_path / "other.py"]
    for source in sources:
        source.write_text("pass\n", encoding="utf-8")
    first = kept_in("tested", sources)
    assert first is not None and kept_in("tested", reversed(sources)) == first
    sources[1].write_text("pass  # changed\n", encoding="utf-8")
    assert kept_in("tested", sources) not in (first, None)


@pytest.mark.parametrize(
    ("names", "home"),
    [(raster.KERNELS, raster), (compiled.PARTS, compiled), (projecting.KERNELS, projecting)],
)
def test_every_file_that_compiles_is_among_the_sources(names: tuple[str, ...], home: object) -> None:
    """Numba itself sees a change in the file of a function alone, and not in what the function calls."""
    folder = Path(str(vars(home)["__file__"])).parent
    compiling = re.compile(r"^@(compiled|reordered|inlined)", re.MULTILINE)
    found = {file.stem for file in folder.glob("*.py") if compiling.search(file.read_text(encoding="utf-8"))}
    assert found and found <= set(names)
    assert all((folder / f"{name}.py").is_file() for name in names)


@pytest.mark.parametrize("root", ["framework", "plugins"])
def test_kernels_that_call_other_files_are_kept_by_their_sources(root: str) -> None:
    """A file that lets numba keep its code beside it takes no compiled function from another."""
    top = Path(__file__).parent.parent
    alone = re.compile(r"njit\([^)]*cache=True", re.DOTALL)
    for file in (top / root).rglob("*.py"):
        text = file.read_text(encoding="utf-8")
        if not alone.search(text) or file.name == "kernels.py":
            continue
        taken = re.findall(r"^from ((?:framework|plugins)[\w.]+) import", text, re.MULTILINE)
        for module in taken:
            other = top / (module.replace(".", "/") + ".py")
            made = other.read_text(encoding="utf-8") if other.is_file() else ""
            assert "njit" not in made and "compiler(" not in made, f"{file} calls kernels of {other}"
