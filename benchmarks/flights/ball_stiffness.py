"""Compare SciPy's solvers on a ball that lands on harder and harder tables: error, evaluations and run time.

The reference is a closed form that is computed with 50 digits.

    python -m benchmarks.flights.ball_stiffness

This writes ball_stiffness.md and ball_stiffness.png beside this file and takes about a minute on one core.
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
"""Stiffness ratios at which every solver runs with all tolerances."""
HEIGHT = 0.1
SECONDS = 1.0
STEPS = 4_000
CONSTANTS = Constants(drag=0.0, lift=0.0, spin_decay=0.0, friction=0.0, near=-100.0, far=100.0)
TIMES = np.linspace(0, SECONDS, 101)


def run_solver(method: str, ratio: float, tolerance: float, heights: np.ndarray) -> dict[str, object]:
    """Return the run time and, if the solver reached the end, its largest error (m) and its counts.

    Args:
        method: SciPy's name of the solver.
        ratio: Duration of the flight over the duration 1/Ω of the contact.
        tolerance: Relative tolerance.
        heights: True heights of the ball above the table at `TIMES`, metres.
    """
    start = np.array([0, 0, CONSTANTS.touching + HEIGHT, 0.5, 0.5, 0.0, 0, 0, 0])
    spring = Spring(frequency=ratio / SECONDS, damping=1.0)
    start_time = time.process_time()
    try:
        path = flight(start, TIMES, CONSTANTS, spring, method=method, tolerance=tolerance, most_steps=STEPS)  # type: ignore[arg-type]
    except SolverGaveUp as error:
        return {"ms": 1e3 * (time.process_time() - start_time), "gave up": str(error)}
    error = np.abs(path.states[:, 2] - CONSTANTS.touching - heights).max()
    assert np.isfinite(path.states).all()
    return {
        "ms": 1e3 * (time.process_time() - start_time),
        "error": error,
        "evaluations": path.evaluations,
        "steps": path.steps,
    }


def main() -> None:
    heights = {
        ratio: np.array(
            landing(HEIGHT, 0.0, TIMES.tolist(), CONSTANTS, Spring(frequency=ratio / SECONDS, damping=1.0))
        )
        for ratio in RATIOS
    }
    results = {
        (method, ratio, tolerance): run_solver(method, ratio, tolerance, heights[ratio])
        for method in METHODS
        for ratio in RATIOS
        for tolerance in TOLERANCES
        if tolerance == TOLERANCE or ratio == HARD[0] or (ratio == HARD[1] and method not in EXPLICIT)
    }
    message = next(str(result["gave up"]) for result in results.values() if "gave up" in result)
    text = [
        "# Stiff contact of a ball with a table",
        "",
        "This page compares the error and the run time of SciPy's solvers of differential equations on simulated "
        "flights of a ball that bounces on a table top. Each row of the results has a harder table top, which "
        "makes the differential equation stiffer. The page shows which solvers still succeed.",
        "",
        f"In the simulation, a ball falls {100 * HEIGHT:g} cm onto a table top, which acts as a critically damped "
        "spring with the frequency Ω. The ball bounces several times, each time less high, and then lies still. The "
        f"simulation ends after {SECONDS:g} s. The relative tolerance is {TOLERANCE:g}, and a solver may take at most "
        f"{STEPS:,} steps. Air resistance and friction are switched off, because the exact solution is not known with "
        "them.",
        "",
        f"In the table of results, `stiffness ratio` is the simulated time of {SECONDS:g} s divided by the duration "
        "1/Ω of a contact of ball and table. The other columns hold three numbers for each solver: the error in "
        "metres / the number of evaluations of the derivative / the processor time in ms. The error is the largest "
        "difference between the computed height of the ball and its true height at 101 times. The true height comes "
        "from a closed form (`closed_form.py`) that is computed with 50 digits.",
        "",
        "| stiffness ratio | " + " | ".join(METHODS) + " |",
        "|---|" + "---|" * len(METHODS),
    ]
    for ratio in RATIOS:
        cells = []
        for method in METHODS:
            result = results[method, ratio, TOLERANCE]
            if "gave up" in result:
                cells.append(f"gave up after {result['ms']:,.0f} ms")
            else:
                cells.append(f"{result['error']:.0e} / {result['evaluations']:,} / {result['ms']:,.0f}")
        text.append(f"| 1e{round(np.log10(ratio))} | " + " | ".join(cells) + " |")
    text += [
        "",
        "Of the compared solvers, RK45 and DOP853 are explicit methods. An explicit method remains stable only with "
        "steps of at most about 3/Ω while the ball lies on the table. Its work therefore grows with the stiffness "
        "ratio, until the solver reaches its limit of steps and gives up. BDF and Radau are implicit methods, and "
        "LSODA changes to an implicit method if the equation is stiff. Their work grows only slowly, because a "
        "harder table top adds only a few more bounces. A solver that gives up prints a message like this one:",
        "",
        f"> {message}",
        "",
        "![Error of the height against run time](ball_stiffness.png)",
        "",
        f"{machine('scipy', 'numpy')} One thread. Command: `python -m benchmarks.flights.ball_stiffness`.",
        "",
    ]
    write_page(HERE, text)
    draw_figure(results)


def draw_figure(results: dict) -> None:
    """Save the figure of run time against stiffness and of error against run time at two stiffness ratios."""
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
        by_ratio = [(ratio, results[method, ratio, TOLERANCE]) for ratio in RATIOS]
        good = [(ratio, result["ms"]) for ratio, result in by_ratio if "error" in result]
        axes[0].loglog(*zip(*good, strict=True), label=name, **look)
        failed = [(ratio, result["ms"]) for ratio, result in by_ratio if "error" not in result]
        if failed:
            axes[0].loglog(
                *zip(*failed, strict=True), color=look["color"], marker="x", linestyle="", markersize=9
            )
        for axis, ratio in zip(axes[1:], HARD, strict=True):
            by_tolerance = [
                results[method, ratio, tolerance]
                for tolerance in TOLERANCES
                if (method, ratio, tolerance) in results
            ]
            pairs = [(result["ms"], result["error"]) for result in by_tolerance if "error" in result]
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
