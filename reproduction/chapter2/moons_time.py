"""Measure NLL and ECE against run time on the two moons (synthetic) for ensembles, MC dropout and temperature.

    python -m framework experiment=moons/ensemble uncertainty.ensemble.members=20 hydra.run.dir=outputs/time/ensemble
    python -m framework experiment=moons/ensemble_temperature uncertainty.ensemble.members=20 \\
        hydra.run.dir=outputs/time/ensemble_temperature
    python -m framework experiment=moons/<mc_dropout, vanilla_512, temperature> hydra.run.dir=outputs/time/<the same>
    python -m reproduction.chapter2.moons_time outputs/time
    python -m reproduction.chapter2.moons_time --draw

The script writes moons_time.csv and moons_time.png beside this file. `--draw` draws moons_time.png again from
moons_time.csv.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import torch

import framework
from benchmarks.pages import environment, read_rows, run_or_draw
from framework.configuration.schema import build, resolve
from framework.datasets.fields import as_batch
from framework.evaluation.tradeoff import rows, tradeoff
from framework.figures.style import save_figure
from framework.reports.table import Row, write_csv
from framework.reports.tradeoff_picture import error_against_run_time

HERE = Path(__file__).parent
KNOBS = {
    "vanilla_512": ("one network", "", (1,)),
    "temperature": ("one network + temperature", "", (1,)),
    "ensemble": ("ensemble", "members", (1, 2, 3, 5, 10, 20)),
    "ensemble_temperature": ("ensemble + temperature", "members", (1, 2, 3, 5, 10, 20)),
    "mc_dropout": ("MC dropout", "samples", (1, 3, 10, 30, 100)),
}
LABELS = {"nll": "negative log-likelihood (nats)", "ece": "expected calibration error"}
NOTE = "Bars: standard deviation over five draws of the masks. Numbers beside points: members, or samples."


def draw_figure(measurements: Sequence[Row]) -> None:
    figure = error_against_run_time(
        measurements,
        LABELS,
        dict.fromkeys(LABELS, "lower"),
        title="Two moons: error against run time of networks of 512-512 units",
        synthetic=True,
        machine=str(measurements[0]["machine"]),
        note=NOTE,
    )
    save_figure(figure, HERE / "moons_time", True)


def main() -> None:
    torch.set_num_threads(1)
    data = build("data", resolve("data", "moons"))
    data.prepare()
    test = data.splits().test
    batches = [as_batch(test.__getitems__(range(start, start + 500))) for start in range(0, len(test), 500)]
    metrics = [
        build("metric", resolve("metric", name), target=data.target) for name in ("nll", "calibration_error")
    ]
    curves = {}
    for key, (name, knob, values) in KNOBS.items():
        predictor = framework.load(Path(sys.argv[1]) / key)
        curves[name] = tradeoff(
            predictor,
            batches,
            metrics,
            knob=knob,
            values=values,
            samples=1,
            seed=0,
            repeats=5 if knob == "samples" else 1,
        )
    machine_line = f"{environment('torch').rstrip('.')}; batches of 500, one thread"
    measurements = [
        {**row, "machine": machine_line}
        for row in rows(curves, dict.fromkeys(LABELS, "lower"), synthetic=True)
    ]
    write_csv(measurements, None, HERE / "moons_time.csv")
    draw_figure(measurements)
    for row in measurements:
        sys.stdout.write(f"{row['method']}, {row['value']}: NLL {row['nll']:.4f}, ECE {row['ece']:.4f}, ")
        sys.stdout.write(f"{row['milliseconds_per_sample'] * 1e3:.2f} µs\n")


if __name__ == "__main__":
    run_or_draw(main, lambda: draw_figure(read_rows(HERE / "moons_time.csv")))
