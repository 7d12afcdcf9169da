"""Work-precision curves of log-likelihoods that are integrals over a latent variable, on a toy known by quadrature.

    python benchmarks/latent.py

Writes latent.md, latent.csv and latent.png beside this file; about three minutes on one core.
"""

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import matplotlib as mpl
import numpy as np
import torch
from torch import Tensor, nn

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from benchmarks.machine import machine
from framework.configuration.schema import build, resolve
from framework.density_head import DensityHead
from framework.distributions.closed_forms import normal_quantile
from framework.distributions.protocol import estimate
from framework.evaluation.pareto import front
from framework.evaluation.tradeoff import run_times
from framework.reports import table
from framework.target import Target
from plugins.density_head.latent.monte_carlo import NormalPoints, lattice

mpl.use("Agg")
from matplotlib import pyplot as plt

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
COLUMNS = {
    "method": "method",
    "knob": "knob",
    "value": "value",
    "error_nats": "one sample's error, nats",
    "error_of_mean_nats": "error of the mean, nats",
    "bias_nats": "bias, nats",
    "debiased_bias_nats": "debiased bias, nats",
    "told_error_nats": "error it tells, nats",
    "samples_mean": "samples",
    "excess_nats": "above the truth's entropy, nats",
    "milliseconds_per_sample": "ms / sample",
    "pareto": "Pareto",
}


class IndependentPoints:
    """Ordinary Monte Carlo in the place of plugins.density_head.latent.monte_carlo.NormalPoints."""

    def __init__(
        self,
        items: int,
        replicates: int,
        dimensions: int,
        *,
        dtype: torch.dtype,
        device: torch.device,
        kept: int = 0,
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
    """Means, concentrations and weights of the two von Mises of p(φ|x), (batch, 2); x within ±1."""
    mean = torch.cat([2 * x, math.pi - x], -1)
    concentration = torch.cat([8 + 4 * x, 4 - 2 * x], -1)
    weight = torch.cat([0.6 + 0.2 * x, 0.4 - 0.2 * x], -1)
    return mean, concentration, weight


def true_log_prob(x: Tensor, value: Tensor) -> Tensor:
    mean, kappa, weight = components(x)
    log_prob = kappa * (value - mean).cos() - math.log(2 * math.pi) - torch.special.i0e(kappa).log() - kappa
    return torch.logsumexp(log_prob + weight.log(), -1)


def drawn(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """x and φ, (count, 1)."""
    generator = np.random.default_rng(seed)
    x = torch.from_numpy(generator.uniform(-1, 1, (count, 1)))
    mean, kappa, weight = (part.numpy() for part in components(x))
    which = (generator.uniform(size=count) > weight[:, 0]).astype(int)
    rows = np.arange(count)
    return x.float(), torch.from_numpy(generator.vonmises(mean[rows, which], kappa[rows, which]))[
        :, None
    ].float()


def trained(config: dict[str, object]) -> tuple[nn.Module, DensityHead]:
    torch.manual_seed(0)
    head = build("density_head", resolve("density_head", config), target=Target("angle", ("azimuth",)))
    encoder = nn.Sequential(
        nn.Linear(1, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, head.size)
    )
    parameters = [*encoder.parameters(), *head.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    x, value = drawn(20_000, 1)
    order = torch.randint(len(x), (STEPS, 128))
    for rows in order:
        optimizer.zero_grad()
        head.loss(encoder(x[rows]), value[rows]).mean().backward()
        optimizer.step()
        schedule.step()
    head.eval().requires_grad_(False)
    return encoder.requires_grad_(False), head


def integral(head: DensityHead, raw: Tensor, value: Tensor) -> Tensor:
    """log p(φ|x) of the head itself by the trapezium rule over ±8 standard deviations of z, float64, (items,)."""
    if not hasattr(head, "decoder"):
        return head(raw).log_prob(value)
    latent = head.decoder.spread.shape[-1]
    axis = torch.linspace(-8, 8, 8001 if latent == 1 else 301, dtype=torch.float64)
    z = torch.stack(torch.meshgrid(*[axis] * latent, indexing="ij"), -1).reshape(-1, latent)
    log_weight = -z.square().sum(-1) / 2 + latent * (
        math.log(16 / (len(axis) - 1)) - math.log(2 * math.pi) / 2
    )
    found = []
    for row, target in zip(raw, value, strict=True):
        if hasattr(head, "networks"):
            networks = head.networks(row)
            number = networks.decode(networks.prior.at(z))
        else:
            number = head.decoder(row, z)
        found.append(torch.logsumexp(head.component(number).log_prob(target) + log_weight, 0))
    return torch.stack(found)


@contextmanager
def points(kind: str) -> Iterator[None]:
    """Points by lattice, or independent."""
    if kind == "lattice":
        yield
        return
    with (
        patch("plugins.density_head.latent.density.NormalPoints", IndependentPoints),
    ):
        yield


def turned(head: DensityHead, knob: str, value: float) -> None:
    if knob == "samples":
        head.samples, head.tolerance = int(value), None
    elif knob == "tolerance":
        head.samples, head.tolerance = 64, value


def curve(method: str, encoder: nn.Module, head: DensityHead) -> list[dict[str, object]]:
    """Rows of one head: for every knob, both kinds of points."""
    x, value = drawn(ITEMS, 2)
    with torch.no_grad():
        raw = encoder(x)
        double = head.double()
        truth = integral(double, raw.double(), value.double())
        head.float()
        family = float((true_log_prob(x.double(), value.double()) - truth).mean())
        kinds = [("exact", "none", (0.0,))]
        if hasattr(head, "samples"):
            kinds = [("lattice", "samples", SAMPLES), ("independent", "samples", SAMPLES)]
            kinds.append(("lattice", "tolerance", TOLERANCES))
        rows: list[dict[str, object]] = []
        for kind, knob, values in kinds:
            with points("lattice" if kind == "exact" else kind):

                def predict(setting: float, knob: str = knob) -> None:
                    turned(head, knob, setting)
                    head(raw).log_prob(value)

                # knobs are numbers here, of which `samples` are whole
                taken = run_times(predict, values, CPU, calls=7, budget_seconds=6.0)  # pyright: ignore
                for setting, seconds in zip(values, taken, strict=True):
                    turned(head, knob, setting)
                    found = []
                    for seed in range(SEEDS):
                        torch.manual_seed(seed)
                        found.append(estimate(head(raw), value))
                    log_prob = torch.stack([one.log_mean for one in found]).double()
                    debiased = torch.stack([one.debiased for one in found]).double()
                    told = torch.stack([one.standard_error for one in found]).double()
                    rows.append(
                        {
                            "method": f"{method}, {kind}" if kind != "exact" else method,
                            "knob": knob,
                            "value": setting,
                            "error_nats": float((log_prob - truth).square().mean().sqrt()),
                            "error_of_mean_nats": float((log_prob - truth).mean(1).square().mean().sqrt()),
                            "bias_nats": float((log_prob - truth).mean()),
                            "debiased_bias_nats": float((debiased - truth).mean()),
                            "told_error_nats": float(told.square().mean().sqrt()),
                            "samples_mean": float(
                                torch.stack([one.samples for one in found]).double().mean()
                            ),
                            "family_excess_nats": family,
                            "excess_nats": family - float((log_prob - truth).mean()),
                            "milliseconds_per_sample": 1e3 * seconds / ITEMS,
                            "synthetic": True,
                        }
                    )
    return rows


def mark(rows: list[dict[str, object]]) -> None:
    """Pareto points of each method and knob."""
    for method, knob in dict.fromkeys((row["method"], row["knob"]) for row in rows):
        own = [row for row in rows if (row["method"], row["knob"]) == (method, knob)]
        best = front([row["error_nats"] for row in own], [row["milliseconds_per_sample"] for row in own])  # pyright: ignore
        for row, kept in zip(own, best, strict=True):
            row["pareto"] = kept


def picture(rows: list[dict[str, object]]) -> None:
    figure, axes = plt.subplots(1, 2, figsize=(13, 5.5), layout="constrained")
    colors = {name: f"C{index}" for index, name in enumerate(HEADS)}
    for method, knob in dict.fromkeys((row["method"], row["knob"]) for row in rows):
        own = [row for row in rows if (row["method"], row["knob"]) == (method, knob)]
        color = next(color for name, color in colors.items() if str(method).startswith(name))
        style = {"samples": ":" if "independent" in str(method) else "-", "tolerance": "--"}.get(
            str(knob), ""
        )
        label = f"{method}" + (" to a tolerance" if knob == "tolerance" else "")
        time = [row["milliseconds_per_sample"] for row in own]
        for axis, key in zip(axes, ("error_nats", "excess_nats"), strict=True):
            if knob == "none" and key == "error_nats":
                continue  # exact: no place on a logarithmic axis
            marker = "s" if knob == "none" else "."
            axis.plot(
                time, [row[key] for row in own], linestyle=style, marker=marker, color=color, label=label
            )
        if knob != "none":
            best = [row for row in own if row["pareto"]]
            where = [[row[key] for row in best] for key in ("milliseconds_per_sample", "error_nats")]
            axes[0].plot(*where, "o", markerfacecolor="none", color=color, markersize=8)
    for axis in axes:
        axis.set(xscale="log", yscale="log", xlabel="milliseconds per sample (batch of 64, one core)")
        axis.grid(alpha=0.3, which="both", linewidth=0.4)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set(ylabel="error of one log-likelihood against the head's own integral, nats (RMS)")
    axes[0].set_title("error of the estimate (circled: Pareto)")
    axes[1].set(ylabel="negative log-likelihood above the entropy of the truth, nats")
    axes[1].set_title("error of the model")
    axes[1].legend(fontsize=7, frameon=False)
    figure.suptitle("Latent-variable heads on a synthetic toy: two von Mises whose modes move with x")
    figure.savefig(HERE.with_suffix(".png"), dpi=110)
    plt.close(figure)


def kronecker(count: int, dimensions: int) -> Tensor:
    """i (g⁻¹, g⁻², …) mod 1 with g^(d+1) = g + 1 (Roberts 2018)."""
    root = 1.5
    for _ in range(100):
        root = (1 + root) ** (1 / (dimensions + 1))
    powers = torch.tensor([root**-power for power in range(1, dimensions + 1)], dtype=torch.float64)
    return torch.remainder(torch.outer(torch.arange(count, dtype=torch.float64), powers), 1.0)


def sobol(count: int, dimensions: int) -> Tensor:
    return torch.quasirandom.SobolEngine(dimensions).draw(count, dtype=torch.float64)


SEQUENCES = {
    "Kronecker": kronecker,
    "Sobol": sobol,
    "lattice": lambda count, dimensions: lattice(0, count, dimensions),
}
INTEGRANDS: tuple[Callable[[Tensor], Tensor], ...] = (
    lambda z: torch.exp(2 * torch.cos(z.sum(-1) / z.shape[-1] ** 0.5 - 0.5)),
    lambda z: torch.exp(50 * (torch.cos(z.sum(-1) / z.shape[-1] ** 0.5 - 0.5) - 1)),
    lambda z: torch.exp(-2 * (z - 0.4).square().sum(-1)),
    lambda z: torch.exp(z.sum(-1) / z.shape[-1] ** 0.5 / 2),
    lambda z: torch.exp(10 * torch.cos(2 * z[..., 0] - 0.3 * z.sum(-1))),
)


def sequences(repeats: int = 400) -> list[dict[str, object]]:
    """Variance of independent points over that of each sequence, randomly shifted: mean of five, and worst."""
    rows: list[dict[str, object]] = []
    torch.manual_seed(0)
    for dimensions in (1, 2, 4, 8):
        for count in (62, 64, 125, 512):
            shift = torch.rand(repeats, 1, dimensions, dtype=torch.float64)
            row: dict[str, object] = {"dimensions": dimensions, "points": count}
            z = torch.randn(4 * repeats, count, dimensions, dtype=torch.float64)
            plain = torch.stack([integrand(z).mean(1).var() for integrand in INTEGRANDS])
            for name, sequence in SEQUENCES.items():
                z = normal_quantile(torch.remainder(sequence(count, dimensions) + shift, 1.0))
                ratios = plain / torch.stack([integrand(z).mean(1).var() for integrand in INTEGRANDS])
                # a gain of a million is exact for any purpose
                row[name] = float(ratios.clamp(max=1e6).log().mean().exp())
                row[f"{name}, worst"] = float(ratios.min())
            rows.append(row)
    return rows


def main() -> None:
    torch.set_num_threads(1)
    assert NormalPoints is not IndependentPoints
    rows: list[dict[str, object]] = []
    for method, config in HEADS.items():
        rows += curve(method, *trained(config))
    mark(rows)
    table.csv(rows, [*COLUMNS, "family_excess_nats"], HERE.with_suffix(".csv"))
    picture(rows)
    shown = [
        row
        for row in rows
        if row["knob"] != "samples" or row["value"] in (1, 10, 100, 1000) or row["value"] == 500
    ]
    gains = sequences()
    text = (
        "# Log-likelihoods that are integrals over a latent variable\n\n"
        "`python benchmarks/latent.py`: heads trained briefly (same MLP encoder) on a synthetic toy, two von Mises "
        f"whose modes, widths and weights move with x; {ITEMS} test samples, {SEEDS} seeds, one thread. Errors are "
        "root mean squares against the head's own integral by quadrature; the last error is the mean negative "
        "log-likelihood above that of the truth, on the same samples. `lattice`: randomised "
        "quasi-Monte-Carlo points of the framework; `independent`: plain Monte Carlo. "
        "All values: `latent.csv`; picture: `latent.png`.\n\n"
        f"{table.markdown(shown, COLUMNS)}\n\n"
        "## Points\n\n"
        "Variance of independent normal points over that of a sequence with a random shift, same number of points: "
        "geometric mean over five smooth weights, and the worst of them.\n\n"
        f"{table.markdown(gains, {key: key for key in gains[0]})}\n\n"
        f"{machine('torch')}\n"
    )
    HERE.with_suffix(".md").write_text(text, encoding="utf-8")
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
