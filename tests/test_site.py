"""Tests of the documentation site: its links, its pages of plugins and its tutorials.

test_readmes.py composes the commands of the pages, and test_documentation.py tests that links lead to files.
"""

import importlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from types import ModuleType
from urllib.parse import unquote, urlsplit

import pytest
import yaml
from markdown.extensions.toc import slugify

from framework.configuration.registry import load
from tests.test_documentation import DOCUMENTS

ROOT = Path(__file__).parent.parent
TUTORIALS = sorted(path for path in (ROOT / "docs/tutorials").glob("*.md") if path.stem != "index")
FOREIGN = re.compile(
    r"<(?:script|img|iframe|source)\b[^>]*\bsrc=[\"']?(?:https?:)?//[^>]*>"
    r"|<link\b[^>]*\brel=[\"']?(?:stylesheet|preconnect|preload)\b[^>]*\bhref=[\"']?(?:https?:)?//[^>]*>"
    r"|@import[^;]*//[^;]*;|url\([\"']?(?:https?:)?//[^)]*\)"
)
"""Pattern of the elements that a browser would load from another server."""


class Links(HTMLParser):
    """Parser of a page: its anchors, the links and images that it shows, and its images without a description."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.bare: list[str] = []
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {key: value or "" for key, value in attrs}
        self.anchors |= {values[key] for key in ("id", "name") if key in values}
        self.links += [values[key] for key in ("href", "src") if tag in ("a", "img") and values.get(key)]
        self.bare += [values.get("src", "")] if tag == "img" and not values.get("alt") else []


def dead_links(folder: Path) -> Iterator[str]:
    """Yield the links of a built site that lead to no file or to no anchor, and the images without a description."""
    pages = {path.resolve(): Links(path) for path in folder.rglob("*.html") if path.name != "404.html"}
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if parts.scheme or parts.netloc:
                continue
            anchors = pages[target].anchors if target in pages else {unquote(parts.fragment)}
            if not target.exists() or (parts.fragment and unquote(parts.fragment) not in anchors):
                yield f"{path.relative_to(folder.resolve())}: {link}"
        yield from (
            f"{path.relative_to(folder.resolve())}: {source} has no description" for source in page.bare
        )


@pytest.fixture(scope="module")
def site() -> ModuleType:
    """Return the module of the site's hooks."""
    sys.path.insert(0, str(ROOT / "docs"))
    try:
        return importlib.import_module("site_pages")
    finally:
        sys.path.remove(str(ROOT / "docs"))


def anchors(document: Path) -> set[str]:
    """Return the anchors of the headings of a Markdown file, as MkDocs names them."""
    text = re.sub(r"(?ms)^```.*?^```$", "", document.read_text(encoding="utf-8"))
    titles = re.findall(r"(?m)^#+ (.+)$", text)
    return {slugify(re.sub(r"\[([^\]]*)\]\([^)]*\)|[`*]", r"\1", title), "-") for title in titles}


def test_links_to_headings_lead_to_headings() -> None:
    broken = []
    for document in DOCUMENTS:
        for path, anchor in re.findall(
            r"\]\(((?!https?:)[^)#\s]*)#([^)\s]+)\)", document.read_text(encoding="utf-8")
        ):
            target = (document.parent / path) if path else document
            if "." not in anchor and anchor not in anchors(target):  # names of Python objects have dots
                broken.append(f"{document.relative_to(ROOT)}: {path}#{anchor}")
    assert not broken


def test_the_navigation_names_pages_that_exist_and_all_pages_of_the_docs(site: ModuleType) -> None:
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    nav = yaml.safe_load(text)["nav"]
    targets = {
        *site.pages().values(),
        "reference/settings.md",
        "reference/experiments.md",
        "reference/metrics.md",
    }
    assert set(site.leaves(nav)) <= targets
    assert not list(site.unlisted(nav)), "add these pages to `nav` in mkdocs.yml"


def test_every_setting_of_every_plugin_has_a_meaning_on_its_page(site: ModuleType) -> None:
    pages, tables = sys.modules["method_pages"], sys.modules["setting_tables"]
    unclear = [
        f"{entry.group} {entry.name}: {row.key}"
        for entry in site.entries()
        for row in pages.settings_of(entry, load(entry.group, entry.name))
        if not row.meaning or row.values.startswith(("<", "typing."))
    ]
    assert not unclear, "\n".join(unclear)
    rows = re.findall(r"(?m)^\| `([\w.]+)` \| (.+?) \| (.+) \| (.*) \|$", tables.settings_page())
    assert len(rows) > 60
    assert not [key for key, values, *_ in rows if values.startswith(("<", "typing."))]


def test_the_training_loop_of_the_page_about_python_runs(capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "docs/how_to/python.md").read_text(encoding="utf-8").partition("\n## Parts in your own")[2]
    names: dict[str, object] = {}
    for block in re.findall(r"(?ms)^```python\n(.*?)^```$", text):
        exec(block, names)
    assert capsys.readouterr().out.endswith("torch.Size([4, 512])\n")


def known_settings(site: ModuleType) -> set[str]:
    """Return all settings with a dot in their names, of the framework, its plugins and the engines of sweeps."""
    pages, tables = sys.modules["method_pages"], sys.modules["setting_tables"]
    known = {"hydra.run.dir", "hydra.sweep.dir"}
    known |= {key for key in re.findall(r"(?m)^\| `([\w.]+)` \|", tables.settings_page()) if "." in key}
    for entry in site.entries():
        prefix = entry.group + f".{entry.name}" * (entry.group in pages.SEVERAL)
        known |= {f"{prefix}.{row.key}" for row in pages.settings_of(entry, load(entry.group, entry.name))}
    for kind in ("launcher", "sweeper"):
        for file in (ROOT / "conf/hydra" / kind).glob("*.yaml"):
            known |= {f"hydra.{kind}.{key}" for key in yaml.safe_load(file.read_text(encoding="utf-8"))}
    return known


def test_every_setting_that_a_page_names_exists(site: ModuleType) -> None:
    """test_readmes.py composes whole commands; this test reads single settings in the text, too."""
    known = known_settings(site)
    named = {
        (path, setting)
        for path in [*DOCUMENTS, *ROOT.glob("plugins/*/*/README.md")]
        for code in re.findall(r"(?ms)^ *```\w*\n.*?^ *```$|`[^`\n]+`", path.read_text(encoding="utf-8"))
        for setting in re.findall(r"(?<![\w./@{=-])([a-z_]+(?:\.[a-z0-9_]+)+)=(?!=)", code)
    }
    assert len(named) > 200
    parts = re.compile(r"\.(?:component|renderer)\.\w+$")  # settings of a plugin that another one contains
    unknown = [
        f"{path.relative_to(ROOT)}: {setting}"
        for path, setting in sorted(named)
        if setting not in known
        and not (setting.startswith(("encoder.", "density_head.")) and parts.search(setting))
    ]
    assert not unknown, "\n".join(unknown)


@pytest.mark.parametrize("tutorial", TUTORIALS, ids=lambda path: path.stem)
def test_a_tutorial_is_a_notebook_and_shows_the_outputs_of_a_run(site: ModuleType, tutorial: Path) -> None:
    text = tutorial.read_text(encoding="utf-8")
    cells = [cell for cell in json.loads(site.notebook(text))["cells"] if cell["cell_type"] == "code"]
    assert len(cells) == len(re.findall(r"(?m)^```(?:bash|python)$", text)) > 3
    notebooks = sys.modules["notebooks"]
    assert notebooks.BEGIN in text and "<!-- run -->" in text, f"run `python docs/notebooks.py {tutorial}`"


@pytest.mark.slow
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda path: path.stem)
def test_a_tutorial_runs(page: Path, run_tutorial: Callable[[str], Path]) -> None:
    assert (run_tutorial(page.stem) / "seconds.txt").is_file()


@pytest.mark.slow
def test_the_site_builds_without_warnings_and_loads_nothing_from_elsewhere(
    site: ModuleType, tmp_path: Path
) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT, capture_output=True, text=True, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )  # fmt: skip
    assert done.returncode == 0 and "WARNING" not in done.stderr, done.stderr
    built = {
        path.relative_to(tmp_path / "site").with_suffix(".md").as_posix() for path in tmp_path.rglob("*.html")
    }
    assert {entry.page for entry in site.entries()} <= built
    foreign = {
        (path.name, match[0])
        for pattern in ("*.html", "*.css")
        for path in tmp_path.rglob(pattern)
        for match in FOREIGN.finditer(path.read_text(encoding="utf-8"))
    }
    assert not foreign
    assert not list(dead_links(tmp_path / "site"))
    placeholders = re.compile(r"<(?:name|run|time|folder|file|id|key|group|registry|value)\b[^>]*>")
    lost = {
        (path.name, match[0])
        for path in tmp_path.rglob("*.html")
        for match in placeholders.finditer(path.read_text())
    }
    assert not lost, "a browser does not show these words: write them as code"
