"""Measure the error against the run time of log-likelihoods that are integrals over a latent variable.

    python -m benchmarks.densities.latent
    python -m benchmarks.densities.latent --draw

Writes latent.md, latent.csv and latent.png into the folder of this file and takes about three minutes on one core.
`--draw` only draws latent.png again, from latent.csv.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from torch import Tensor, nn

from benchmarks.densities.latent_points import sequences
from benchmarks.pages import machine, publish, read_rows, run_or_draw
from framework.configuration.schema import build, resolve
from framework.density_head import DensityHead
from framework.distributions.protocol import estimate
from framework.evaluation.pareto import front
from framework.evaluation.tradeoff import run_times
from framework.figures.style import BLUE, GREEN, RED, save_figure, titled_figure
from framework.reports import table
from framework.target import Target
from plugins.density_head.latent.cvae import CVAEHead
from plugins.density_head.latent.monte_carlo import NormalPoints
from plugins.density_head.latent.scvae import SCVAEHead

HERE = Path(__file__)
CPU = torch.device("cpu")
SAMPLES = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
TOLERANCES = (0.1, 0.03, 0.01, 0.003, 0.001)
SEEDS = 10
ITEMS = 64
STEPS = 1500
HEADS = {
    "mixture": {"name": "mixture", "components": 2},
    "scvae, 1 latent": {"name": "scvae", "latent": 1, "hidden": 32},
    "scvae, 2 latent": {"name": "scvae", "latent": 2, "hidden": 32},
    "cvae, 1 latent": {"name": "cvae", "latent": 1, "hidden": 32},
    "cvae, 2 latent": {"name": "cvae", "latent": 2, "hidden": 32},
}
KINDS = {
    ("lattice", "samples"): ("lattice points", BLUE, "o"),
    ("independent", "samples"): ("independent points", RED, "s"),
    ("lattice", "tolerance"): ("lattice points until a tolerance is met", GREEN, "^"),
}
"""Label, colour and marker of each kind of points in the figure."""
COLUMNS = {
    "method": "method",
    "knob": "knob",
    "value": "value",
    "error_nats": "error of one log-likelihood, nats",
    "error_of_mean_nats": "error of the mean, nats",
    "bias_nats": "bias, nats",
    "debiased_bias_nats": "bias after correction, nats",
    "told_error_nats": "reported error, nats",
    "samples_mean": "points z",
    "excess_nats": "excess NLL, nats",
    "milliseconds_per_sample": "ms per sample",
    "pareto": "on the Pareto front",
}


class IndependentPoints:
    """Independent points, as a replacement for plugins.density_head.latent.monte_carlo.NormalPoints."""

    def __init__(
        self, items: int, replicates: int, dimensions: int, *, dtype: torch.dtype, **_: object
    ) -> None:
        self.shape, self.dtype, self.points = (replicates, items, dimensions), dtype, torch.empty(0)

    def __call__(self, items: Tensor, start: int, count: int) -> Tensor:
        replicates, everything, dimensions = self.shape
        if len(self.points) == 0:
            self.points = torch.randn(replicates, start + count, everything, dimensions, dtype=self.dtype)
        missing = start + count - self.points.shape[1]
        if missing > 0:
            more = torch.randn(replicates, missing, everything, dimensions, dtype=self.dtype)
            self.points = torch.cat([self.points, more], 1)
        return self.points[:, start : start + count, items]


def components(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return means, concentrations and weights of the two components of the true p(φ|x), (batch, 2); x is within ±1."""
    mean = torch.cat([2 * x, math.pi - x], -1)
    concentration = torch.cat([8 + 4 * x, 4 - 2 * x], -1)
    weight = torch.cat([0.6 + 0.2 * x, 0.4 - 0.2 * x], -1)
    return mean, concentration, weight


def true_log_prob(x: Tensor, value: Tensor) -> Tensor:
    """Return the true log p(φ|x), (batch,)."""
    mean, kappa, weight = components(x)
    log_prob = kappa * (value - mean).cos() - math.log(2 * math.pi) - torch.special.i0e(kappa).log() - kappa
    return torch.logsumexp(log_prob + weight.log(), -1)


def sample(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Return inputs x and angles φ, (count, 1) each."""
    generator = np.random.default_rng(seed)
    x = torch.from_numpy(generator.uniform(-1, 1, (count, 1)))
    mean, kappa, weight = (part.numpy() for part in components(x))
    component = (generator.uniform(size=count) > weight[:, 0]).astype(int)
    rows = np.arange(count)
    value = torch.from_numpy(generator.vonmises(mean[rows, component], kappa[rows, component]))
    return x.float(), value[:, None].float()


def train(config: dict[str, object]) -> tuple[nn.Module, DensityHead]:
    """Return an encoder and a density head after a short training."""
    torch.manual_seed(0)
    head = build("density_head", resolve("density_head", config), target=Target("angle", ("azimuth",)))
    encoder = nn.Sequential(
        nn.Linear(1, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, head.size)
    )
    parameters = [*encoder.parameters(), *head.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    x, value = sample(20_000, 1)
    order = torch.randint(len(x), (STEPS, 128))
    for rows in order:
        optimizer.zero_grad()
        head.loss(encoder(x[rows]), value[rows]).mean().backward()
        optimizer.step()
        schedule.step()
    head.eval().requires_grad_(False)
    return encoder.requires_grad_(False), head


def integral(head: DensityHead, raw: Tensor, value: Tensor) -> Tensor:
    """Return log p(φ|x) of the head by the trapezium rule over ±8 standard deviations of z, float64, (items,)."""
    if not isinstance(head, CVAEHead | SCVAEHead):
        return head(raw).log_prob(value)
    latent = head.decoder.spread.shape[-1]
    axis = torch.linspace(-8, 8, 8001 if latent == 1 else 301, dtype=torch.float64)
    z = torch.stack(torch.meshgrid(*[axis] * latent, indexing="ij"), -1).reshape(-1, latent)
    log_weight = -z.square().sum(-1) / 2 + latent * (
        math.log(16 / (len(axis) - 1)) - math.log(2 * math.pi) / 2
    )
    log_probs = []
    for row, target in zip(raw, value, strict=True):
        if isinstance(head, CVAEHead):
            networks = head.networks(row)
            component_raw = networks.decode(networks.prior.at(z))
        else:
            component_raw = head.decoder(row, z)
        component = head.component(component_raw)
        log_probs.append(torch.logsumexp(component.log_prob(target) + log_weight, 0))
    return torch.stack(log_probs)


@contextmanager
def use_points(kind: str) -> Iterator[None]:
    """Let the densities use points of a lattice ("lattice"), or independent points."""
    if kind == "lattice":
        yield
        return
    with patch("plugins.density_head.latent.density.NormalPoints", IndependentPoints):
        yield


def set_knob(head: DensityHead, knob: str, value: float) -> None:
    """Set the number of samples or the tolerance of a latent-variable head."""
    if not isinstance(head, CVAEHead | SCVAEHead):
        return
    if knob == "samples":
        head.samples, head.tolerance = int(value), None
    elif knob == "tolerance":
        head.samples, head.tolerance = 64, value


def measure_head(method: str, encoder: nn.Module, head: DensityHead) -> list[dict[str, object]]:
    """Return the rows of one head, for every kind of points and every value of the knobs."""
    x, value = sample(ITEMS, 2)
    with torch.no_grad():
        raw = encoder(x)
        double = head.double()
        truth = integral(double, raw.double(), value.double())
        head.float()
        family = float((true_log_prob(x.double(), value.double()) - truth).mean())
        kinds: list[tuple[str, str, tuple[float, ...]]] = [("exact", "none", (0.0,))]
        if hasattr(head, "samples"):
            kinds = [("lattice", "samples", SAMPLES), ("independent", "samples", SAMPLES)]
            kinds.append(("lattice", "tolerance", TOLERANCES))
        rows: list[dict[str, object]] = []
        for kind, knob, values in kinds:
            with use_points("lattice" if kind == "exact" else kind):

                def predict(setting: float, knob: str = knob) -> None:
                    set_knob(head, knob, setting)
                    head(raw).log_prob(value)

                # `run_times` accepts whole numbers; tolerances are fractions
                times = run_times(predict, values, CPU, calls=7, budget_seconds=6.0)  # pyright: ignore
                for setting, seconds in zip(values, times, strict=True):
                    set_knob(head, knob, setting)
                    estimates = []
                    for seed in range(SEEDS):
                        torch.manual_seed(seed)
                        estimates.append(estimate(head(raw), value))
                    log_prob, debiased, reported_error, samples, _ = (
                        torch.stack(column).double() for column in zip(*estimates, strict=True)
                    )
                    error = log_prob - truth
                    rows.append(
                        {
                            "method": f"{method}, {kind}" if kind != "exact" else method,
                            "knob": knob,
                            "value": setting,
                            "error_nats": float(error.square().mean().sqrt()),
                            "error_nats_std": float(error.square().mean(1).sqrt().std()),
                            "error_of_mean_nats": float(error.mean(1).square().mean().sqrt()),
                            "bias_nats": float(error.mean()),
                            "debiased_bias_nats": float((debiased - truth).mean()),
                            "told_error_nats": float(reported_error.square().mean().sqrt()),
                            "samples_mean": float(samples.mean()),
                            "family_excess_nats": family,
                            "excess_nats": family - float(error.mean()),
                            "excess_nats_std": float(error.mean(1).std()),
                            "milliseconds_per_sample": 1e3 * seconds / ITEMS,
                            "synthetic": True,
                        }
                    )
    return rows


def mark_pareto(rows: list[dict[str, object]]) -> None:
    """Set "pareto" in each row: whether it is on the Pareto front of its method and knob."""
    for method, knob in dict.fromkeys((row["method"], row["knob"]) for row in rows):
        own = [row for row in rows if (row["method"], row["knob"]) == (method, knob)]
        best = front([row["error_nats"] for row in own], [row["milliseconds_per_sample"] for row in own])  # pyright: ignore
        for row, on_front in zip(own, best, strict=True):
            row["pareto"] = on_front


def draw_figure(rows: list[dict[str, object]]) -> None:
    """Draw latent.png: a column of panels for each kind of head, a row of panels for each error.

    Colours and markers show the kind of points, line styles the dimensions of the latent variable.
    """
    figure = titled_figure((11, 8.5), "Log-likelihoods of latent-variable models on a toy of two modes", True)
    axes = figure.subplots(2, 2, sharex=True, sharey="row")
    for column, (key, name) in enumerate((("scvae", "sCVAE"), ("cvae", "CVAE"))):
        for line in styled_curves(rows, key):
            for axis, quantity in zip(axes[:, column], ("error_nats", "excess_nats"), strict=True):
                draw_curve(axis, line, quantity)
        axes[0, column].set_title(f"{name}: error of the estimate", fontsize=11)
        axes[1, column].set_title(f"{name}: error of the model", fontsize=11)
        axes[1, column].set_xlabel("run time (ms per sample, batches of 64, one core)")
    exact = next(row for row in rows if row["knob"] == "none")
    for axis in axes[1]:
        axis.axhline(exact["excess_nats"], color="black", linewidth=1, linestyle=":")
    for axis in axes.flat:
        axis.set(xscale="log", yscale="log")
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0, 0].set_ylabel("RMS error of one log-likelihood\nagainst the model's own integral (nats)")
    axes[1, 0].set_ylabel("negative log-likelihood\nabove the entropy of the truth (nats)")
    handles = [
        Line2D([], [], color=colour, marker=marker, label=label) for label, colour, marker in KINDS.values()
    ]
    handles += [
        Line2D([], [], color="black", label="one latent number, filled"),
        Line2D(
            [],
            [],
            color="black",
            linestyle="--",
            marker="o",
            markerfacecolor="white",
            label="two latent numbers, hollow",
        ),
        Line2D(
            [],
            [],
            color="black",
            linestyle=":",
            linewidth=1,
            label=f"mixture of two von Mises: exact, in {exact['milliseconds_per_sample']:.3f} ms",
        ),
    ]
    note = f"Bands: standard deviation over {SEEDS} seeds. " if "error_nats_std" in exact else ""
    note += f"Dots: {SAMPLES[0]} to {SAMPLES[-1]} points, or tolerances of {TOLERANCES[0]} to {TOLERANCES[-1]} nats."
    legend = figure.legend(
        handles=handles, loc="outside lower center", ncols=2, fontsize=9, frameon=False, title=note
    )
    legend.get_title().set(fontsize=9)
    save_figure(figure, HERE.with_suffix(""), True)


def styled_curves(
    rows: list[dict[str, object]], key: str
) -> Iterator[tuple[list[dict[str, object]], dict[str, Any]]]:
    """Yield the rows and the style of each curve of a kind of head."""
    for latent in (1, 2):
        for (kind, knob), (_, colour, marker) in KINDS.items():
            method = f"{key}, {latent} latent, {kind}"
            own = [row for row in rows if (row["method"], row["knob"]) == (method, knob)]
            style: dict[str, Any] = {"color": colour, "marker": marker, "markersize": 4.5}
            if latent == 2:
                style |= {"linestyle": "--", "markerfacecolor": "white"}
            yield own, style


def draw_curve(axis: Axes, line: tuple[list[dict[str, object]], dict[str, Any]], key: str) -> None:
    """Draw a quantity against run time, with a band of its standard deviation over seeds if the rows have it."""
    own, style = line
    time, mean, spread = (
        np.array([row.get(name, math.nan) for row in own], dtype=float)
        for name in ("milliseconds_per_sample", key, f"{key}_std")
    )
    axis.plot(time, mean, linewidth=1.2, **style)
    # on a logarithmic axis, a band that would reach zero ends at a third of the mean
    low = np.maximum(mean - spread, mean / 3)
    axis.fill_between(time, low, mean + spread, color=style["color"], alpha=0.12, linewidth=0)


def main() -> None:
    torch.set_num_threads(1)
    assert NormalPoints is not IndependentPoints
    rows: list[dict[str, object]] = []
    for method, config in HEADS.items():
        rows += measure_head(method, *train(config))
    mark_pareto(rows)
    table.write_csv(rows, [*COLUMNS, "family_excess_nats"], HERE.with_suffix(".csv"))
    draw_figure(rows)
    shown = [
        row
        for row in rows
        if row["knob"] != "samples" or row["value"] in (1, 10, 100, 1000) or row["value"] == 500
    ]
    gains = sequences()
    text = (
        "# Log-likelihoods that are integrals over a latent variable\n\n"
        "The log-likelihood of the heads `cvae` and `scvae` is an integral over a latent variable z, which is "
        "estimated from a finite number of points z. This page shows how accurate and how fast these estimates are. "
        "The head `mixture`, "
        "whose log-likelihood is exact, is given for comparison. The page is written by "
        "`python -m benchmarks.densities.latent`.\n\n"
        "The heads `cvae`, `scvae` and `mixture` are compared on synthetic data: the true density of an angle is a "
        "mixture of two von Mises densities, whose modes, widths and weights depend on the input. All heads were "
        f"trained briefly with the same MLP encoder. Each head was evaluated on {ITEMS} test samples with {SEEDS} "
        "seeds, on one thread. `latent.csv` holds all values, and `latent.png` shows them.\n\n"
        "The columns of the table are as follows; ± is the standard deviation over seeds:\n"
        "- method: the head, the dimensions of z, and the kind of points. `lattice` points are the randomised "
        "quasi-Monte-Carlo points of the framework, and `independent` points are plain Monte Carlo;\n"
        "- knob, value: the number of points z (`samples`), or the estimated error in nats until which the number of "
        "points is doubled (`tolerance`);\n"
        "- error of one log-likelihood: root mean square difference, over test samples and seeds, from the exact value "
        "of the head's integral, which was computed by quadrature;\n"
        "- error of the mean: root mean square difference, over seeds, between the estimated and the exact mean "
        "log-likelihood of all test samples;\n"
        "- bias: mean difference between the estimated and the exact log-likelihood, over test samples and seeds. "
        "Without correction, an estimate is on average too low (Jensen's inequality). In the column after "
        "correction, half of the squared reported error has been added to each estimate;\n"
        "- reported error: root mean square of the standard error that the density reports for its own estimate. It is "
        "not available for a single point;\n"
        "- points z: mean number of points per test sample;\n"
        "- excess NLL: mean negative log-likelihood minus that of the true density, on the same samples;\n"
        "- ms per sample: run time of the log-likelihood of one sample;\n"
        "- on the Pareto front: whether no other value of this knob is both faster and more accurate.\n\n"
        f"{table.markdown(shown, COLUMNS)}\n\n"
        "## Comparison of quasi-random points\n\n"
        "To estimate an integral over the latent variable z, the framework uses the points of a lattice. This table "
        "compares three quasi-random sequences, each with a random shift, with the same number of independent "
        "points. A number says by which factor the variance of an estimated integral is smaller than with "
        'independent points. It is the geometric mean over five smooth integrands; the columns "worst" give the '
        'smallest factor of the five. "Dimensions" are the dimensions of z.\n\n'
        f"{table.markdown(gains, {key: key for key in gains[0]})}\n\n"
        f"{machine('torch')}\n"
    )
    publish(HERE, text)


if __name__ == "__main__":
    run_or_draw(main, lambda: draw_figure(read_rows(HERE.with_suffix(".csv"))))
