"""Reports: what a page says, that it loads nothing and runs nothing of a stranger, and how large it may be."""

import ast
import json
import math
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from framework.errors import ConfigError, DataError
from framework.evaluation.significance import holm, paired_difference
from framework.reports.page import PNG
from framework.reports.report import load_call
from framework.sweeps.pages import LARGEST_FIGURE, write_report
from tests.conftest import TINY, Framework

EVIL = '<script src="https://example.org/x.js">alert(1)</script>&"\'{}\\_%$#~^\x1b[31m\u202e'
HEADINGS = {"nll": "NLL (nats)", "accuracy": "accuracy"}


def write_run(folder: Path, method: str, seed: int, numbers: dict[str, Any], **more: Any) -> None:
    """Write the files of a tested run that a report reads."""
    (folder / "figures").mkdir(parents=True)
    results = {
        "method": method,
        "data": "moons",
        "seed": seed,
        "synthetic": True,
        "test_samples": 100,
        "columns": HEADINGS,
        "better": {"nll": "lower", "accuracy": "higher"},
        "device": "cpu",
        "threads": 1,
        "milliseconds_per_sample": 0.1 + 0.1 * (method == "slow"),
        "versions": {"torch": "2"},
        "folder": str(folder),
        **numbers,
        **more,
    }
    (folder / "results.json").write_text(json.dumps(results))
    overrides = [f"density_head={method}", f"seed={seed}"]
    (folder / "overrides.yaml").write_text(json.dumps(overrides))
    record = {"overrides": overrides, "status": "completed", "key": f"{method} {seed}", "number": seed}
    (folder / "job.json").write_text(json.dumps(record))
    (folder / "figures" / "panels.png").write_bytes(PNG + bytes(1000))
    (folder / "figures" / "sneaky.png").write_bytes(b"<svg onload=alert(1)>")
    (folder / "console.log").write_text(
        "left out: 'note' (words)\nreading: 3 of 9 files in 31 s\n   of a table  \nrun folder: here\n"
    )
    (folder / "citations.bib").write_text("@article{one,\n  title = {One}\n}\n")


def write_sweep(folder: Path, methods: tuple[str, ...] = ("fast", "slow"), seeds: int = 4) -> np.ndarray:
    """Write the runs of a sweep, and return their log-likelihoods, (methods, seeds)."""
    nll = np.random.default_rng(0).normal(size=(len(methods), seeds)) * 0.1
    for index, method in enumerate(methods):
        for seed in range(seeds):
            numbers = {"nll": nll[index, seed] + index, "accuracy": 0.5}
            write_run(folder / f"{index}_{seed}", method, seed, numbers)
    return nll + np.arange(len(methods))[:, None]


class Elements(HTMLParser):
    """Parser that lists the elements of a page with their attributes, and its text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data


def test_a_report_on_a_sweep_has_results_differences_front_failures_and_commands(tmp_path: Path) -> None:
    nll = write_sweep(tmp_path)
    (tmp_path / "failed").mkdir()
    record = {
        "overrides": ["seed=9"],
        "status": "failed",
        "error": "The disk is full.",
        "key": "9",
        "number": 9,
    }
    (tmp_path / "failed" / "job.json").write_text(json.dumps(record))
    page, table, _ = (path.read_text(encoding="utf-8") for path in write_report(tmp_path, tmp_path))
    text = Elements(page).text
    for part in (
        "synthetic",
        "8 runs",
        "seeds 0, 1, 2, 3",
        "seed=9",
        "The disk is full.",
        "torch 2",
        "@article",
    ):
        assert part in text, part
    assert "python -m framework density_head=slow seed=3" in text
    assert "left out: 'note' (words)" in text
    expected = stats.ttest_rel(nll[1], nll[0])
    assert expected.pvalue < 0.05
    difference, error = (nll[1] - nll[0]).mean(), stats.sem(nll[1] - nll[0])
    row = re.search(r"slow, density_head=slow\s*4\s*([\d.]+) ± ([\d.]+) \*", re.sub(r"</?t[dr]>", " ", page))
    assert row and abs(float(row[1]) - difference) < 0.01 and abs(float(row[2]) - error) < 0.01
    assert "not available" not in table and "| fast |" in table
    assert "On the front, where no other row is both better and faster: fast" in text


def test_notes_hold_no_progress_and_a_column_of_one_data_set_is_left_out(tmp_path: Path) -> None:
    write_sweep(tmp_path / "sweep")
    text = write_report(tmp_path / "sweep", tmp_path)[0].read_text(encoding="utf-8")
    assert "left out: &#x27;note&#x27; (words)" in text and "Data: moons" in text
    assert "3 of 9 files" not in text and "of a table" not in text
    assert "<td>moons</td>" not in text


def test_a_page_loads_nothing_and_runs_nothing_of_a_stranger(tmp_path: Path) -> None:
    more = {"groups": {EVIL: {"nll": 1.0}, "b": {"nll": 1.0}}, "versions": {EVIL: EVIL}, "data": EVIL}
    write_run(tmp_path, EVIL, 0, {"nll": 1.0}, columns={"nll": EVIL}, **more)
    (tmp_path / "citations.bib").write_text(EVIL)
    page, _, latex = (path.read_text(encoding="utf-8") for path in write_report(tmp_path, tmp_path))
    found = Elements(page)
    assert [tag for tag, _ in found.elements].count("script") == 1
    for tag, attributes in found.elements:
        assert not any(name.startswith("on") for name in attributes), tag
        for name in ("src", "href", "data"):
            assert (attributes.get(name) or "data:image/png;base64,").startswith("data:image/png;base64,")
    assert "default-src 'none'" in page
    assert "onload" not in page
    assert "\x1b" not in page + latex
    assert "\N{RIGHT-TO-LEFT OVERRIDE}" not in page and "\\u202e" in page


def test_a_link_in_the_folder_is_refused(tmp_path: Path) -> None:
    write_sweep(tmp_path / "sweep")
    (tmp_path / "sweep" / "report.html").symlink_to(tmp_path / "mine")
    with pytest.raises(DataError, match="is a link"):
        write_report(tmp_path / "sweep", tmp_path / "sweep")
    assert not (tmp_path / "mine").exists()


def test_figures_beyond_the_size_of_a_page_are_left_out_and_counted(tmp_path: Path) -> None:
    methods = tuple(f"m{index}" for index in range(15))
    write_sweep(tmp_path, methods, seeds=3)
    for path in tmp_path.glob("*/figures/panels.png"):
        path.write_bytes(PNG + bytes(LARGEST_FIGURE // 4))
    page = write_report(tmp_path, tmp_path / "into")[0]
    assert page.stat().st_size <= 10_000_000
    assert re.search(r"\d+ figures? not embedded", page.read_text())


@pytest.mark.parametrize("seeds, text", [(1, "at least two seeds"), (2, "± standard error over seeds")])
def test_a_paired_test_needs_two_seeds(seeds: int, text: str, tmp_path: Path) -> None:
    write_sweep(tmp_path, seeds=seeds)
    assert text in write_report(tmp_path, tmp_path)[0].read_text()


def test_a_folder_without_results_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="holds no results"):
        write_report(tmp_path, tmp_path)


def test_the_command_reports_on_a_run(framework: Framework, tmp_path: Path) -> None:
    assert framework(*TINY, "pictures=png", "logger=none").code == 0
    done = framework(
        "mode=report", f"mode.run={tmp_path / 'run'}", f"mode.into={tmp_path / 'pages'}", folder=None
    )
    assert done.code == 0, done.out
    text = Elements((tmp_path / "pages" / "report.html").read_text()).text
    assert "log-likelihood" in text and "hydra-core" in text
    assert "All data of this report are synthetic" in text
    done = framework("mode=report", "mode.run=nowhere", folder=None)
    assert done.code == 2 and "mode.run=nowhere is not a folder" in done.out


@pytest.mark.parametrize("name", ["plain", "it's", 'a "b" c\'d', "back\\slash", "Ünï {x}", "two\nlines"])
def test_the_line_that_loads_a_model_is_python_for_any_path(name: str) -> None:
    call = ast.parse(load_call(Path("/runs") / name), mode="eval").body
    assert isinstance(call, ast.Call)
    assert ast.literal_eval(call.args[0]) == f"/runs/{name}"
    assert "\n" not in load_call(name)


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("pdflatex"), reason="pdflatex is not on PATH; texlive-latex-base has it")
def test_the_latex_table_compiles(tmp_path: Path) -> None:
    signs = "".join(sign for sign in EVIL if sign.isprintable()) + "±°−×≤≥·²³κμµσ"
    write_sweep(tmp_path / "sweep", ("plain", signs))
    table = write_report(tmp_path / "sweep", tmp_path)[2].read_text(encoding="utf-8")
    document = f"\\documentclass{{article}}\\begin{{document}}\n{table}\\end{{document}}\n"
    (tmp_path / "paper.tex").write_text(document, encoding="utf-8")
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, timeout=120)
    assert done.returncode == 0, done.stdout.decode(errors="replace")[-2000:]
    assert (tmp_path / "paper.pdf").is_file()


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-1e3, 1e3)] * 2), min_size=2, max_size=12))
def test_paired_differences_are_those_of_scipy(pairs: list[tuple[float, float]]) -> None:
    first, second = map(list, zip(*pairs, strict=True))
    found = paired_difference(first, second)
    differences = np.subtract(first, second)
    if np.ptp(differences) <= 1e-9 * np.abs(differences).max():
        return  # SciPy warns of rounding
    expected = stats.ttest_rel(first, second)
    assert found.probability == pytest.approx(expected.pvalue, rel=1e-6, abs=1e-12)
    assert found.standard_error == pytest.approx(stats.sem(differences))


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(0, 1) | st.just(math.nan), max_size=8))
def test_holm_rejects_what_the_stepwise_procedure_rejects(probabilities: list[float]) -> None:
    corrected = holm(probabilities)
    known = sorted((p, index) for index, p in enumerate(probabilities) if not math.isnan(p))
    rejected = set[int]()
    for rank, (p, index) in enumerate(known):
        if p * (len(known) - rank) > 0.05:
            break
        rejected.add(index)
    assert {index for index, p in enumerate(corrected) if p <= 0.05} == rejected
    assert [math.isnan(p) for p in corrected] == [math.isnan(p) for p in probabilities]
