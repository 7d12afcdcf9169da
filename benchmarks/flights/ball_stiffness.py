"""Compare SciPy's solvers on a ball that lands on ever harder tables: error against 50 digits, evaluations and time.

    python -m benchmarks.flights.ball_stiffness

Writes ball_stiffness.md and ball_stiffness.png beside this file; about a minute on one core.
"""

import time
from pathlib import Path

import numpy as np

from benchmarks.pages import machine, write_page
from framework.figures.style import COLOURS, MARKERS, titled_figure
from framework.flights.physics import Constants
from plugins.data.table_tennis.closed_form import landing
from plugins.data.table_tennis.contact import Spring
from plugins.data.table_tennis.solvers import EXPLICIT, METHODS, SolverGaveUp, flight

HERE = Path(__file__)
RATIOS = (1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8)
TOLERANCES = (1e-4, 1e-8, 1e-11)
TOLERANCE = 1e-8
HARD = (1e3, 1e6)
"""Ratios of which all tolerances are tried."""
HEIGHT = 0.1
SECONDS = 1.0
STEPS = 4_000
CONSTANTS = Constants(drag=0.0, lift=0.0, spin_decay=0.0, friction=0.0, near=-100.0, far=100.0)
TIMES = np.linspace(0, SECONDS, 101)


def measured(method: str, ratio: float, tolerance: float, wanted: np.ndarray) -> dict[str, object]:
    start = np.array([0, 0, CONSTANTS.touching + HEIGHT, 0.5, 0.5, 0.0, 0, 0, 0])
    spring = Spring(frequency=ratio / SECONDS, damping=1.0)
    began = time.process_time()
    try:
        path = flight(start, TIMES, CONSTANTS, spring, method=method, tolerance=tolerance, most_steps=STEPS)  # type: ignore[arg-type]
    except SolverGaveUp as error:
        return {"ms": 1e3 * (time.process_time() - began), "gave up": str(error)}
    error = np.abs(path.states[:, 2] - CONSTANTS.touching - wanted).max()
    assert np.isfinite(path.states).all()
    return {
        "ms": 1e3 * (time.process_time() - began),
        "error": error,
        "evaluations": path.evaluations,
        "steps": path.steps,
    }


def main() -> None:
    wanted = {
        ratio: np.array(
            landing(HEIGHT, 0.0, TIMES.tolist(), CONSTANTS, Spring(frequency=ratio / SECONDS, damping=1.0))
        )
        for ratio in RATIOS
    }
    found = {
        (method, ratio, tolerance): measured(method, ratio, tolerance, wanted[ratio])
        for method in METHODS
        for ratio in RATIOS
        for tolerance in TOLERANCES
        if tolerance == TOLERANCE or ratio == HARD[0] or (ratio == HARD[1] and method not in EXPLICIT)
    }
    sentence = next(str(one["gave up"]) for one in found.values() if "gave up" in one)
    text = [
        "# Stiff contact of a ball with a table",
        "",
        f"A ball falls {100 * HEIGHT:g} cm onto a table that is a critically damped spring, hops ever lower, and lies "
        f"on it; {SECONDS:g} s in all. The ratio is that of the flight's {SECONDS:g} s and the contact's time 1/Ω. "
        "Error: largest of 101 heights, metres, against the closed form of every phase (`closed_form.py`), 50 digits. "
        f"Relative tolerance {TOLERANCE:g}; at most {STEPS:,} steps. Air and friction are off, since with them no "
        "closed form is known.",
        "",
        "Error (m) / evaluations of the derivative / processor time (ms):",
        "",
        "| ratio | " + " | ".join(METHODS) + " |",
        "|---|" + "---|" * len(METHODS),
    ]
    for ratio in RATIOS:
        cells = []
        for method in METHODS:
            one = found[method, ratio, TOLERANCE]
            if "gave up" in one:
                cells.append(f"gave up after {one['ms']:,.0f} ms")
            else:
                cells.append(f"{one['error']:.0e} / {one['evaluations']:,} / {one['ms']:,.0f}")
        text.append(f"| 1e{round(np.log10(ratio))} | " + " | ".join(cells) + " |")
    text += [
        "",
        "An explicit method's step is bounded by its stability, some 3/Ω for as long as the ball lies on the table: "
        "the work grows with the ratio until the solver says so. Implicit methods, and LSODA, which changes to one, "
        "pay a little for each further hop. What a solver says when it gives up:",
        "",
        f"> {sentence}",
        "",
        "![Work and precision](ball_stiffness.png)",
        "",
        f"{machine('scipy', 'numpy')} One thread. Command: `python -m benchmarks.flights.ball_stiffness`.",
        "",
    ]
    write_page(HERE, text)
    drawn(found)


def drawn(found: dict) -> None:
    figure = titled_figure(
        (12.5, 4.6), "A ball lands on an ever harder table: SciPy's solvers against 50 digits", False
    )
    axes = figure.subplots(1, 3)
    for number, method in enumerate(METHODS):
        look = {
            "color": COLOURS[number],
            "marker": MARKERS[number],
            "linestyle": "--" if method in EXPLICIT else "-",
            "markersize": 5,
        }
        name = f"{method} ({'explicit' if method in EXPLICIT else 'changes' if method == 'LSODA' else 'implicit'})"
        there = [(ratio, found[method, ratio, TOLERANCE]) for ratio in RATIOS]
        good = [(ratio, one["ms"]) for ratio, one in there if "error" in one]
        axes[0].loglog(*zip(*good, strict=True), label=name, **look)
        failed = [(ratio, one["ms"]) for ratio, one in there if "error" not in one]
        if failed:
            axes[0].loglog(
                *zip(*failed, strict=True), color=look["color"], marker="x", linestyle="", markersize=9
            )
        for axis, ratio in zip(axes[1:], HARD, strict=True):
            there = [found[method, ratio, one] for one in TOLERANCES if (method, ratio, one) in found]
            pairs = [(one["ms"], one["error"]) for one in there if "error" in one]
            if pairs:
                axis.loglog(*zip(*pairs, strict=True), **look)
            else:
                axis.loglog([], [], **look)
    axes[0].set(
        xlabel="stiffness: time of the flight over that of the contact",
        ylabel="processor time (ms)",
        title=f"tolerance {TOLERANCE:g}",
    )
    figure.legend(loc="outside lower center", ncols=len(METHODS), fontsize=9, frameon=False)
    axes[0].text(0.03, 0.97, "× gave up, and said so", transform=axes[0].transAxes, fontsize=9, va="top")
    for axis, ratio in zip(axes[1:], HARD, strict=True):
        axis.set(
            xlabel="processor time (ms)",
            ylabel="largest error of the height (m)",
            title=f"stiffness 1e{round(np.log10(ratio))}",
        )
        axis.set(ylim=(1e-15, 1e-3))
    axes[2].text(0.03, 0.03, "explicit methods give up", transform=axes[2].transAxes, fontsize=9)
    for axis in axes:
        axis.grid(alpha=0.3)
    figure.savefig(HERE.with_suffix(".png"), dpi=110)


if __name__ == "__main__":
    main()
