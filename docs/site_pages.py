"""Hooks of MkDocs: the pages of the site that are not files of docs/, their links, and the navigation.

The site shows pages from the whole repository. READMEs of plugins become pages of methods, and the pages of results
stand under the same path as in the repository. Three kinds of links are translated to links between pages of the site:
relative links to any file of the repository; `site:<page>`, a page of the site; and `repo:<path>`, a file of the
repository. A linked file that is not a page, such as a figure or a config, is copied into the site.
"""

import posixpath
import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from method_pages import entry_page, experiments_page, metrics_page
from methods import GROUPS, HEADINGS, ROOT, entries
from methods import page as methods_page
from notebooks import notebook
from setting_tables import settings_page

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

RESULTS = ("benchmarks/**/*.md", "reproduction/**/*.md", "tests/fuzz/*.md")
OTHERS = ("CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md")
LINK = re.compile(r"(!?\[(?:[^\[\]]|\[[^\[\]]*\])*\]\()([^)\s#]*)(#[^)\s]*)?(\))")
ITEM = re.compile(r"\s*(?:[-*+]|\d+\.) ")
BOOSTS = {
    **dict.fromkeys(("benchmarks/", "reproduction/", "tests/", "CHANGELOG"), 0.3),
    **dict.fromkeys(("methods/", "reference/"), 1.0),
}
"""Weights of pages in the results of a search, by the beginning of their paths; other pages have the weight 3."""
WIDE = re.compile(r"(?m)^\|(?:[ :-]+\|){7,}$")
"""Line below the heading of a table with at least seven columns."""


@cache
def pages() -> dict[str, str]:
    """Return the page of the site for each Markdown file of the repository, by the path in the repository."""
    paths = [path for pattern in (*RESULTS, *OTHERS) for path in sorted(ROOT.glob(pattern))]
    mirrored = {path.relative_to(ROOT).as_posix(): path.relative_to(ROOT).as_posix() for path in paths}
    readmes: dict[str, str] = {}
    for entry in entries():
        readme = f"{entry.folder.as_posix()}/README.md"
        if readme not in readmes or entry.name == entry.folder.name:
            readmes[readme] = entry.page
    own = {path.relative_to(ROOT).as_posix(): path for path in (ROOT / "docs").rglob("*.md")}
    return {
        "README.md": "index.md",
        **mirrored,
        **readmes,
        **{name: path.relative_to(ROOT / "docs").as_posix() for name, path in own.items()},
    }


def tutorials() -> list[Path]:
    """Return the tutorials, by their paths in the repository."""
    paths = sorted((ROOT / "docs/tutorials").glob("*.md"))
    return [path.relative_to(ROOT) for path in paths if path.stem != "index"]


def generated() -> Iterator[tuple[str, str, str]]:
    """Yield page, text, and the file to which its relative links refer, for each page that is not a file of docs/."""
    for source, target in pages().items():
        if not source.startswith(("docs/", "plugins/", "README")):
            yield target, (ROOT / source).read_text(encoding="utf-8"), source
    for entry in entries():
        yield entry.page, entry_page(entry), f"{entry.folder.as_posix()}/README.md"
    yield "reference/settings.md", settings_page(), "docs/reference/settings.md"
    yield "reference/experiments.md", experiments_page(), "docs/reference/experiments.md"
    yield "reference/metrics.md", metrics_page(), "docs/reference/metrics.md"


def results() -> str:
    """Return the section of the README that summarises the results."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return "## Results" + text.partition("\n## Results")[2].partition("\n## ")[0]


def translate(text: str, source: str, target: str) -> tuple[str, set[str]]:
    """Return a text with links that hold on the site, and the files of the repository that must be copied into it.

    Args:
        text: Markdown.
        source: path in the repository of the file to which relative links refer.
        target: page of the site that shows the text.
    """
    site_pages, copies = pages(), set[str]()

    def replaced(match: re.Match[str]) -> str:
        before, link, anchor, after = match[1], match[2], match[3] or "", match[4]
        if not link or re.match(r"https?:|mailto:", link):
            return match[0]
        if link.startswith("site:"):
            place = link.removeprefix("site:")
        else:
            path = link.removeprefix("repo:")
            if path == link:
                path = posixpath.normpath(posixpath.join(posixpath.dirname(source), link))
            if (ROOT / path).is_dir():
                path = f"{path}/README.md"
            place = site_pages.get(path, "")
            if not place and (ROOT / path).is_file():
                place = path.removeprefix("docs/")
                if not path.startswith("docs/"):
                    copies.add(path)
        if not place:
            return match[0]
        return f"{before}{posixpath.relpath(place, posixpath.dirname(target) or '.')}{anchor}{after}"

    return "".join(
        part if is_code else LINK.sub(replaced, part) for is_code, part in split_code(text)
    ), copies


def split_code(text: str) -> Iterator[tuple[bool, str]]:
    """Yield the blocks of code and the other parts of a Markdown text."""
    for part in re.split(r"(?ms)(^ *```.*?^ *```$)", text):
        yield part.lstrip().startswith("```"), part


def spaced_lists(text: str) -> str:
    """Return Markdown with an empty line before each list, which GitHub does not need but Python-Markdown needs."""
    parts = []
    for is_code, part in split_code(text):
        lines: list[str] = []
        for line in part.splitlines(keepends=True):
            starts = ITEM.match(line) and lines and lines[-1].strip() and not is_code
            if starts and not ITEM.match(lines[-1]) and not lines[-1].startswith((" ", "|", "#")):
                lines.append("\n")
            lines.append(line)
        parts.append("".join(lines))
    return "".join(parts)


def on_config(config: "MkDocsConfig") -> "MkDocsConfig":
    """Complete the navigation: methods by registry, pages of results by folder, pages of docs/ that no line names."""
    nav: list[Any] = config.nav or []
    sections: dict[str, list[Any]] = {title: items for item in nav for title, items in item.items()}
    for group in GROUPS:
        named = [{entry.name: entry.page} for entry in entries() if entry.group == group]
        sections["Methods"].append({HEADINGS[group]: named})
    for root in ("benchmarks", "reproduction"):
        folders: dict[str, list[str]] = {}
        for source in pages():
            if source.startswith(f"{root}/") and source != f"{root}/README.md":
                folders.setdefault(posixpath.dirname(source), []).append(source)
        below = [
            {
                folder.partition("/")[2].replace("chapter", "Chapter ") or "All chapters": [
                    {Path(path).stem.replace("_", " "): path} for path in paths
                ]
            }
            for folder, paths in sorted(folders.items())
        ]
        sections["Evidence"].append({root.capitalize(): [f"{root}/README.md", *below]})
    sections["Evidence"].append(
        {"Damaged files and killed runs": sorted(p for p in pages() if p.startswith("tests/"))}
    )
    missing = sorted(set(unlisted(nav)))
    sections["How to"].extend(missing)
    return config


def unlisted(nav: Any) -> Iterator[str]:
    """Yield the pages of docs/ that a navigation does not name."""
    named = set(leaves(nav))
    for source, target in pages().items():
        if source.startswith("docs/") and target not in named:
            yield target


def leaves(nav: Any) -> Iterator[str]:
    """Yield the pages of a navigation."""
    if isinstance(nav, str):
        yield nav
    elif isinstance(nav, Mapping):
        for item in nav.values():
            yield from leaves(item)
    else:
        for item in nav:
            yield from leaves(item)


def on_files(files: "Files", config: "MkDocsConfig") -> "Files":
    """Add the generated pages, the notebooks, and the linked files of the repository."""
    from mkdocs.structure.files import File

    copies = set[str]()
    for target, text, source in generated():
        translated, linked = translate(text, source, target)
        copies |= linked
        files.append(File.generated(config, target, content=translated))
    for source, target in pages().items():
        if source.startswith("docs/"):
            copies |= translate((ROOT / source).read_text(encoding="utf-8"), source, target)[1]
    for path in tutorials():
        content = notebook((ROOT / path).read_text(encoding="utf-8"))
        files.append(File.generated(config, f"tutorials/{path.stem}.ipynb", content=content))
    for path in sorted(copies):
        files.append(File.generated(config, path, abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page: "Page", config: "MkDocsConfig", files: "Files") -> str:
    """Translate the links of a page of docs/, and separate lists from the text before them."""
    target = page.file.src_uri
    if page.file.generated_by is None:
        markdown = methods_page(of_site=True) if target == "methods.md" else markdown
        markdown, _ = translate(markdown, f"docs/{target}", target)
        if f"docs/{target}" in map(str, tutorials()):
            markdown += f"\n[Download this page as a notebook]({Path(target).stem}.ipynb)\n"
        markdown = markdown.replace("<!-- results -->", translate(results(), "README.md", target)[0])
    boosts = [boost for beginning, boost in BOOSTS.items() if target.startswith(beginning)]
    page.meta["search"] = {"boost": boosts[0] if boosts else 3.0}
    if WIDE.search(markdown):
        page.meta["hide"] = ["toc"]  # without the table of contents, tables are a third wider
    return spaced_lists(markdown)
