"""Each committed page of benchmarks says where, when and with what it was measured, and how far rounds differ."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.pages import replace_section
from benchmarks.timing import Rounds, cores_used_by_others, time_interleaved

ROOT = Path(__file__).parent.parent
PAGES = sorted(
    page
    for folder in ("benchmarks/*", "reproduction", "reproduction/chapter*", "tests/fuzz")
    for page in ROOT.glob(f"{folder}/*.md")
    if page.name != "README.md"
)
MACHINE = re.compile(r"\d+ cores?\b[^\n]*; 20\d\d-\d\d-\d\d; Python 3\.\d+\.\d+")
TIMED = re.compile(r"\bms\b|[Mm]illiseconds|\bseconds\b|times as (fast|long)|times \S+'s speed|× torch")
SPREAD = re.compile(r"least to largest|\brounds\b|±|standard deviation")
PEERS = {"SciPy": "scipy", "scikit-learn": "scikit-learn", "NumPy": "numpy", "onnxruntime": "onnxruntime"}
"""Other libraries that the pages compare with, by the name in the text, with their packages."""
WITHOUT_MACHINE = {"claims.md"}
"""Pages that contain no measurements and quote other pages."""
WITHOUT_SPREAD = {
    "ball_flights.md",
    "ball_stiffness.md",
    "evaluation_time.md",
    "fit_pose.md",
    "fuzz.md",
    "rasterizer.md",
    "rasterizer_gradients.md",
    "reconstruction.md",
    "served.md",
    "smplpix_flicker.md",
    "smplpix_growth.md",
    "smplpix_projection.md",
    "smplpix_work_precision.md",
    "sweep_start.md",
}
"""Pages that were measured before `benchmarks.timing` existed; remove a page from this list when it is measured
again."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_says_how_it_was_measured(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    if page.name not in WITHOUT_MACHINE:
        assert MACHINE.search(text), "no line with the processor's cores, the date and Python's version"
        for peer, package in PEERS.items():
            if re.search(rf"\b{re.escape(peer)}\b", text):
                assert re.search(rf"\b{package} \d", text), f"no version of {peer}"
    if TIMED.search(text):
        assert bool(SPREAD.search(text)) is (page.name not in WITHOUT_SPREAD)
    else:
        assert page.name not in WITHOUT_SPREAD


def test_functions_are_timed_in_interleaved_rounds_after_calls_to_warm_up() -> None:
    calls: list[str] = []
    moments = iter(range(1000))
    functions = {name: lambda name=name: calls.append(name) for name in ("a", "b")}
    times = time_interleaved(functions, rounds=2, seconds=0.0, clock=lambda: next(moments))
    assert calls == ["a", "a", "b", "b", *["a"] * 3, *["b"] * 3, *["a"] * 3, *["b"] * 3]
    assert times == {"a": Rounds((1000.0, 1000.0)), "b": Rounds((1000.0, 1000.0))}


def test_a_ratio_is_taken_round_by_round() -> None:
    ours, theirs = Rounds((1.0, 2.0, 4.0)), Rounds((10.0, 30.0, 80.0))
    assert ours.text() == "2 (1 to 4)"
    assert ours.times_faster(theirs) == "15 (10 to 20)"
    assert Rounds((0.12345, 12345.6, 3.14159)).text() == "3.14 (0.123 to 12,346)"


def test_a_section_is_replaced_and_the_others_stay(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# Page\n\nfirst\n\n## A\n\nold\n\n### of A\n\nold\n\n## B\n\nlast\n", encoding="utf-8")
    replace_section(page, "## A", "new\n")
    assert page.read_text(encoding="utf-8") == "# Page\n\nfirst\n\n## A\n\nnew\n\n## B\n\nlast\n"
    replace_section(page, "## B", "newer")
    assert page.read_text(encoding="utf-8") == "# Page\n\nfirst\n\n## A\n\nnew\n\n## B\n\nnewer\n"
    with pytest.raises(ValueError, match="0 lines"):
        replace_section(page, "## C", "")


def test_a_process_of_others_is_seen() -> None:

    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        assert cores_used_by_others(1.0) > 0.2
    finally:
        busy.kill()
        busy.wait()


def test_every_command_names_a_script_that_is_there() -> None:
    """Check the commands in pages, scripts and READMEs."""
    documents = [
        path
        for pattern in (
            "*.md",
            "*/*.md",
            "benchmarks/**/*.*",
            "reproduction/**/*.*",
            "tests/**/*.*",
            "plugins/*/*/*.*",
        )
        for path in ROOT.glob(pattern)
        if path.suffix in (".md", ".py")
    ]
    commands = {
        (path, module)
        for path in documents
        for module in re.findall(
            r"python -m ((?:benchmarks|reproduction|tests\.fuzz)[.\w]*\w)", path.read_text(encoding="utf-8")
        )
    }
    assert len(commands) > 100
    assert not [
        (str(path.relative_to(ROOT)), module)
        for path, module in commands
        if not (ROOT / f"{module.replace('.', '/')}.py").is_file()
    ]
