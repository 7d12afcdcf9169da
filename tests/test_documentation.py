"""Tests of the documentation: lists are complete, links lead to files, and all files state the same version."""

import importlib.util
import re
import tomllib
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

import pytest
import yaml

import framework
from framework.configuration.registry import GROUPS, installed
from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from framework.target import Target
from framework.testing.contract import contract
from tests.test_benchmark_pages import PAGES

ROOT = Path(__file__).parent.parent
DOCUMENTS = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "benchmarks/**/*.md", "reproduction/**/*.md", "tests/fuzz/*.md")
    for path in ROOT.glob(pattern)
)
INDEXES = (ROOT / "benchmarks/README.md", ROOT / "reproduction/README.md")
TARGETS = {
    "angles": Target("angle", ("azimuth", "elevation", "tilt")),
    "real numbers": Target("real", ("x",)),
    "classes": Target("class", ("a", "b")),
    "images": Target("image", ("red", "green", "blue"), size=(8, 8)),
}
COMPONENTS = ("von_mises", "gaussian", "categorical", "laplace_image")


@pytest.fixture(scope="module")
def methods() -> ModuleType:
    """Return the script that writes docs/methods.md as a module."""
    spec = importlib.util.spec_from_file_location("methods", ROOT / "docs/methods.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_list_of_methods_is_not_stale(methods: ModuleType) -> None:
    page = (ROOT / "docs/methods.md").read_text(encoding="utf-8")
    assert page == methods.page(), "stale: run `python docs/methods.py`"
    assert not re.search(r"not found\)|\(no description|\(broken|\\[^|]", page), (
        "a class without a line, or LaTeX"
    )


def test_every_entry_point_is_named_with_the_page_of_its_folder() -> None:
    page = (ROOT / "docs/methods.md").read_text(encoding="utf-8")
    rows = re.findall(r"(?m)^\| \[`(\w+)`\]\((\S+)\) \| \S.* \| .*\|$", page)
    with (ROOT / "pyproject.toml").open("rb") as file:
        groups = tomllib.load(file)["project"]["entry-points"]
    assert sorted(name for name, _ in rows) == sorted(
        name for group in GROUPS for name in groups[f"framework.{group}"]
    )
    pages = {(ROOT / "docs" / link).resolve() for _, link in rows}
    assert pages == set(ROOT.glob("plugins/*/*/README.md"))


def test_every_page_of_results_is_listed_once_with_what_it_answers() -> None:
    listed = [
        (index.parent / link).resolve()
        for index in INDEXES
        for link in re.findall(r"(?m)^\| \[\w+\]\((\S+\.md)\) \| \S.* \|$", index.read_text(encoding="utf-8"))
    ]
    assert sorted(listed) == sorted(PAGES)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_to_files(document: Path) -> None:
    links = re.findall(r"\]\(((?!https?:)[^)#\s]+)", document.read_text(encoding="utf-8"))
    assert not [link for link in links if not (document.parent / link).exists()]


def test_the_matrix_of_the_readme_says_which_targets_each_head_describes() -> None:
    """A head describes a kind of target that its constructor takes, or for which it has a row of the contract."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    heading, _, *rows = re.findall(r"(?m)^\| density head .*\n(?:\|.*\n)+", text)[0].splitlines()
    kinds = [cell.strip() for cell in heading.split("|")[2:-1]]
    assert kinds == list(TARGETS)
    marked = {
        name: {kind for kind, mark in zip(kinds, cells, strict=True) if mark.strip()}
        for heads, *cells in (row.split("|")[1:-1] for row in rows)
        for name in re.findall(r"`(\w+)`", heads)
    }
    assert marked == {name: kinds_of(name) for name in methods_of("density_head")}


def methods_of(group: str) -> list[str]:
    """Return the names of the project's own plugins of a registry."""
    return [name for name, entry in installed(group).items() if entry.value.startswith("plugins.")]


def kinds_of(head: str) -> set[str]:
    """Return the kinds of target that a density head describes."""
    own = {row.target.kind for row in contract("density_head", head).rows}
    kinds = set()
    for (kind, target), component in zip(TARGETS.items(), COMPONENTS, strict=True):
        if target.kind in own or any(accepts(head, target, part) for part in (None, component)):
            kinds.add(kind)
    return kinds


def accepts(head: str, target: Target, component: str | None) -> bool:
    """Return whether a head, with a component where one is given, can be built for a target."""
    config = {"name": head} if component is None else {"name": head, "component": {"name": component}}
    try:
        build("density_head", resolve("density_head", config), target=target)
    except ConfigError:
        return False
    return True


def test_every_place_says_the_same_version() -> None:
    with (ROOT / "pyproject.toml").open("rb") as file:
        project = tomllib.load(file)["project"]
    released = re.findall(
        r"(?m)^## \[(\d[\d.]*)\] - (20\d\d-\d\d-\d\d)$", (ROOT / "CHANGELOG.md").read_text()
    )
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert released == sorted(released, key=lambda release: release[1], reverse=True)
    assert released[0] == (citation["version"], str(citation["date-released"]))
    assert project["version"] == framework.__version__ == released[0][0]
    assert version(project["name"]) == project["version"], "run `pip install -e .` again"
