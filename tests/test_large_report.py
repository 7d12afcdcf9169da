"""The report of a sweep of 45 runs: its size, its paired tests, and its width in a browser."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import Framework

LARGEST = 10_000_000
"""Largest size of the page, bytes."""
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
WIDTHS = ",".join(f"[{4 * number}]" for number in range(1, 10))
SWEEP = (
    *(
        "-m",
        "data=moons",
        "data.train=60",
        "data.validation=40",
        "data.test=60",
        "data@outliers=moons_outliers",
    ),
    *("outliers.test=20", "encoder=[mlp]", f"encoder.mlp.widths={WIDTHS}", "density_head=bernoulli"),
    *(
        "metric=[accuracy,nll]",
        "trainer.max_epochs=2",
        "batch_size=20",
        "seed=0",
        "logger=none",
        "threads=1",
    ),
)
"""Nine networks."""
SEEDS = 5
MEASURE = """<script>addEventListener("load", () => setTimeout(() => document.title = JSON.stringify({
  inner: innerWidth, needed: document.documentElement.scrollWidth, seconds: performance.now() / 1000}), 0))</script>"""
"""Script that writes the width of the window, the width of the page and the load time into the title."""


def copy_with_seed(job: Path, number: int, seed: int) -> None:
    """Copy a job of seed 0 to the job `number` of its sweep, with another seed and other numbers.

    The page reads the folders of jobs, and cannot tell whether another training has written the numbers.
    """
    folder = job.with_name(str(number))
    shutil.copytree(job, folder)
    record = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    for words in (record["overrides"], record["command"]):
        words[words.index("seed=0")] = f"seed={seed}"
    record |= {"number": number, "key": f"{record['key']}-{seed}"}
    (folder / "job.json").write_text(json.dumps(record), encoding="utf-8")
    results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    results |= {key: results[key] + seed * number / 1000 for key in ("accuracy", "nll")}
    (folder / "results.json").write_text(json.dumps({**results, "seed": seed}), encoding="utf-8")


def measured(page: Path, width: int, folder: Path) -> dict[str, float]:
    """Return the widths and the load time, seconds, of a page in headless Chromium."""
    copy = folder / f"copy_{width}.html"
    copy.write_text(
        page.read_text(encoding="utf-8").replace("</body>", f"{MEASURE}</body>"), encoding="utf-8"
    )
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--window-size={width},900"]
    done = subprocess.run(
        [str(BROWSER), *options, "--virtual-time-budget=5000", "--dump-dom", copy.absolute().as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
    )
    title = re.search(r"<title>(\{.*?\})</title>", done.stdout)
    assert title, done.stderr[-1000:]
    return json.loads(title[1])


@pytest.mark.slow
def test_a_report_on_45_runs_is_one_small_page_that_fits_a_window(
    framework: Framework, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done = framework(*SWEEP, f"hydra.sweep.dir={tmp_path}/sweep")
    assert done.code == 0, done.out
    for network in range(9):
        for seed in range(1, SEEDS):
            copy_with_seed(tmp_path / f"sweep/{network}", network + 9 * seed, seed)
    done = framework("mode=report", f"mode.run={tmp_path}/sweep", folder=None)
    assert done.code == 0, done.out
    page = tmp_path / "sweep/report.html"
    assert page.stat().st_size <= LARGEST
    text = page.read_text(encoding="utf-8")
    assert "45 runs; 9 rows; seeds 0, 1, 2, 3, 4" in text
    assert "Each number is that of a row minus that of" in text and "Holm" in text
    assert len(re.findall("python -m framework ", text)) >= 45, "every run can be repeated"
    assert "default-src 'none'" in text
    own = re.sub(r"<pre>.*?</pre>", "", text, flags=re.DOTALL)
    assert not re.search("https?://", own), "nothing is loaded from elsewhere"
    with capsys.disabled():
        sys.stdout.write(f"\nThe page has {page.stat().st_size / 1e6:.1f} MB.\n")
        if BROWSER is None:
            sys.stdout.write("No Chromium is on PATH, so the page was not opened.\n")
            return
        for width in (500, 1280):  # Chromium's smallest window has 500 pixels
            size = measured(page, width, tmp_path)
            sys.stdout.write(f"Window of {size['inner']} pixels: loaded in {size['seconds']:.1f} s.\n")
            assert size["needed"] <= size["inner"], "only tables scroll sideways, not the page"
