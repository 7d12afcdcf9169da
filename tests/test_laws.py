"""The design's laws, read from the source: who imports whom, and that the core names no method."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
CORE = sorted((ROOT / "framework").rglob("*.py"))
PLUGINS = sorted(path for path in (ROOT / "plugins").rglob("*.py") if path.parent != ROOT / "plugins")


def imported(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; write the full name"
            yield node.module or ""


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", CORE, ids=relative)
def test_the_core_imports_no_plugin_and_names_no_method(path: Path) -> None:
    assert not [name for name in imported(path) if name.split(".")[0] == "plugins"]
    text = path.read_text(encoding="utf-8")
    code = re.sub(r'("""|\'\'\').*?\1|#[^\n]*', "", text, flags=re.DOTALL)  # prose may give examples
    assert not re.search(r"mises|\bbps\b|smpl|scvae|pascal3d", code, re.IGNORECASE)


@pytest.mark.parametrize("path", PLUGINS, ids=relative)
def test_no_plugin_imports_another(path: Path) -> None:
    mine = path.relative_to(ROOT / "plugins").parts[0]
    others = [name for name in imported(path) if name.startswith("plugins.") and name.split(".")[1] != mine]
    assert not others


@pytest.mark.parametrize("path", CORE, ids=relative)
def test_core_files_are_short(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 400


@pytest.mark.parametrize("path", CORE + PLUGINS, ids=relative)
def test_nothing_instantiates_from_a_config_or_loads_pickles(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert "hydra.utils import" not in text
    assert "weights_only=False" not in text
    assert "allow_pickle=True" not in text


@pytest.mark.parametrize("folder", sorted({path.relative_to(ROOT / "plugins").parts[0] for path in PLUGINS}))
def test_a_plugin_folder_explains_itself(folder: str) -> None:
    path = ROOT / "plugins" / folder
    readme = (path / "README.md").read_text(encoding="utf-8")
    assert 3 <= len(readme.splitlines()) <= 40
    assert list(path.glob("test_*.py"))
    assert list((path / "conf").rglob("*.yaml"))
