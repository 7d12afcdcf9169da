"""Make Table 7.1 on generated people with `mode=render`: six rows from one sweep, error beside run time of a frame.

    python -m reproduction.chapter7.render_table

The script runs `SWEEP` into outputs/render_table, or continues it, and writes render_table.md beside this file. With
`<folder of the sweep>` it only writes the page.
"""

import argparse
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.commands import ROOT, carry_out
from benchmarks.pages import machine, write_page
from framework.reports.table import NOT_AVAILABLE, format_number
from framework.runs.job import read_record
from framework.sweeps.results import read_results

HERE = Path(__file__).resolve()
FOLDER = ROOT / "outputs/render_table"
SWEEP = (
    "experiment=render/vertex_colors,render/textures,render/smplpix",
    "data.topology=7k,27k",
    *("data.train=40", "data.validation=4", "data.test=8", "seed=1", "trainer.max_epochs=8", "logger=none"),
)
"""Overrides of the sweep: fewer people and shorter training than in the experiments, so that it takes half an hour."""
NAMES = {"vertex_colors": "mesh, vertex colours", "textures": "mesh, texture", "smplpix": "SMPLpix"}
THESIS = {
    ("vertex_colors", "7k"): (23.2, 0.072, 13),
    ("textures", "7k"): (23.4, 0.049, 14),
    ("vertex_colors", "27k"): (23.5, 0.064, 48),
    ("textures", "27k"): (23.6, 0.047, 50),
    ("smplpix", "7k"): (24.2, 0.051, 16),
    ("smplpix", "27k"): (24.6, 0.045, 17),
}
"""PSNR (dB), LPIPS and milliseconds of the thesis's Table 7.1, in its order of rows."""
COLUMNS = {
    "psnr_db": "PSNR, dB",
    "psnr_masked_db": "PSNR inside, dB",
    "ssim": "SSIM",
    "ssim_masked": "SSIM inside",
    "lpips": "LPIPS",
}


def main() -> None:
    arguments = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    arguments.add_argument("folder", nargs="?", type=Path, help="folder of a sweep that has run")
    folder = arguments.parse_args().folder
    if folder is None:
        folder = FOLDER
        carry_out([sys.executable, "-m", "framework", "-m", *SWEEP, f"hydra.sweep.dir={folder}"])
    rows = read_rows(folder)
    shutil.copy(folder / "comparison.png", HERE.with_suffix(".png"))
    write_page(HERE, page(rows))


def read_rows(folder: Path) -> dict[tuple[str, str], Mapping[str, Any]]:
    """Return the results of the jobs of a sweep by experiment and topology.

    Raises:
        SystemExit: a row of the table has no result.
    """
    rows: dict[tuple[str, str], Mapping[str, Any]] = {}
    for record in folder.glob("*/job.json"):
        overrides = dict(word.split("=", 1) for word in read_record(record.parent)["overrides"])
        results = read_results(record.parent)
        if results:
            rows[overrides["experiment"].partition("/")[2], overrides["data.topology"]] = results
    if missing := [" ".join(key) for key in THESIS if key not in rows]:
        sys.exit(
            f"{folder} has no results of {', '.join(missing)}. Repeat the command; it runs the missing jobs."
        )
    return rows


def page(rows: Mapping[tuple[str, str], Mapping[str, Any]]) -> str:
    """Return the text of the page."""
    first = rows["vertex_colors", "7k"]
    lines = [
        "# Table 7.1 by `mode=render`",
        "",
        "One sweep draws the test people of `human_scans` in six ways, compares the images with photographs, and "
        "measures the run time of a frame. The people are generated (synthetic), not real: 40 subjects are for "
        f"training, 4 for validation and 8 for the test, whose {first['test_samples']} photographs have 256 × 192 "
        "pixels. Each subject is seen from six sides.",
        "",
        "A number after ± is the standard error of the mean over test images. There is one training for each row of "
        "SMPLpix (seed 1), with 8 epochs, so the table has no spread over seeds; [smplpix_table.md](smplpix_table.md) "
        "has one, with more people. *Inside* means that only pixels of the subject count. LPIPS needs weights that are "
        f"not part of this project, so it is {NOT_AVAILABLE}. The run time is the wall time of drawing a batch of four "
        "frames on one thread, divided by four; meshes are drawn with 4 × 4 samples for each pixel. The machine had "
        "other work during this sweep, so run times are upper limits.",
        "",
        f"| renderer | vertices | {' | '.join(COLUMNS.values())} | ms per frame | parameters |",
        f"|---|---|{'---:|' * (len(COLUMNS) + 2)}",
    ]
    for (method, topology), results in ((key, rows[key]) for key in THESIS):
        cells = [cell(results, key) for key in COLUMNS]
        lines.append(
            f"| {NAMES[method]} | {topology} | {' | '.join(cells)} | {results['milliseconds_per_sample']:.1f} | "
            f"{results['parameters']:,} |"
        )
    lines += [
        "",
        "![PSNR against the run time of a frame](render_table.png)",
        "",
        "The meshes and the network are drawn from the same 6,890 or 27,578 vertices. A mesh with a texture has more "
        "information about the colours than the other two.",
        "",
        "## Table 7.1 as printed in the thesis",
        "",
        "The thesis used photographs of 68 real people with 410 × 308 pixels. These photographs are not public. "
        "The thesis also used another mesh renderer (without anti-aliasing), another network and another machine. "
        "So only the order of rows can be compared.",
        "",
        "| renderer | vertices | PSNR, dB | LPIPS | ms per frame |",
        "|---|---|---:|---:|---:|",
    ]
    for (method, topology), (psnr, lpips, time) in THESIS.items():
        lines.append(f"| {NAMES[method]} | {topology} | {psnr} | {lpips} | {time} |")
    command = f"python -m framework -m {' '.join(SWEEP)}"
    lines += [
        "",
        f"The images were drawn on {first['device']} with {first['threads']} thread. {machine('torch', 'numpy')} "
        f"Command: `python -m reproduction.chapter7.render_table`, which runs `{command}`.",
    ]
    return "\n".join(lines)


def cell(results: Mapping[str, Any], key: str) -> str:
    """Return the result `key` with its standard error as text, or a text that says that it is not available."""
    value, error = results.get(key), results.get(f"{key}_sem")
    return NOT_AVAILABLE if value is None or error is None else format_number(value, error)


if __name__ == "__main__":
    main()
