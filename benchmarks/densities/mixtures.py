"""Measure the time of the log-density and of the mode of mixtures.

    python -m benchmarks.densities.mixtures

Writes mixtures.md into the folder of this file. The script ends without a measurement if other processes use the
machine.
"""

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor
from torch import distributions as torchs

from benchmarks.pages import machine, write_page
from benchmarks.timing import ROUNDS, Rounds, require_idle, time_interleaved
from framework.distributions.density import Mixture
from plugins.density_head.gaussian.density import Gaussian
from plugins.density_head.von_mises.density import VonMises

VALUES = 10**6
"""Number of values times components of a log-density."""
COMPONENTS = (5, 100)
MODES = (1000, 3000, 10_000, 30_000)
"""Numbers of components whose mode is searched."""
MOST_PAIRS = 10_000
"""Largest number of components for which every component is evaluated at the mode of every component."""
OURS = {"von Mises": VonMises, "normal": Gaussian}
THEIRS = {"von Mises": torchs.VonMises, "normal": torchs.Normal}


def our_log_prob(kind: str, parameters: tuple[Tensor, ...], value: Tensor) -> Tensor:
    """Return the log-density of mixtures by this project."""
    weights, location, spread = parameters
    return Mixture(weights, OURS[kind](location, spread)).log_prob(value)


def torch_log_prob(kind: str, parameters: tuple[Tensor, ...], value: Tensor) -> Tensor:
    """Return the log-density of mixtures by torch.distributions."""
    weights, location, spread = parameters
    components = torchs.Independent(
        THEIRS[kind](location, spread, validate_args=False), 1, validate_args=False
    )
    mixture = torchs.MixtureSameFamily(
        torchs.Categorical(logits=weights, validate_args=False), components, validate_args=False
    )
    return mixture.log_prob(value)


@torch.no_grad()
def compute_value(
    log_prob: Callable[..., Tensor], kind: str, parameters: tuple[Tensor, ...], value: Tensor
) -> None:
    """Compute the log-density without a gradient."""
    log_prob(kind, parameters, value)


def compute_gradients(
    log_prob: Callable[..., Tensor], kind: str, parameters: tuple[Tensor, ...], value: Tensor
) -> None:
    """Compute the log-density and its gradients in all parameters."""
    torch.autograd.grad(log_prob(kind, parameters, value).sum(), parameters)


def density_table() -> list[str]:
    """Return the lines of the table of times of log-densities, in nanoseconds for each value and component."""
    lines = [
        "| components | K | implementation | log p, ns | speed-up over torch | log p and gradients, ns | "
        "speed-up over torch |",
        "|---|---|---|---|---|---|---|",
    ]
    functions = {"torch": torch_log_prob, "ours": our_log_prob}
    for kind in OURS:
        for count in COMPONENTS:
            rows = VALUES // count
            parameters = (
                torch.randn(rows, count, requires_grad=True),
                torch.randn(rows, count, 1, requires_grad=True),
                torch.randn(rows, count, 1).exp().requires_grad_(),
            )
            value = torch.randn(rows, 1)
            times = [
                time_interleaved(
                    {
                        name: partial(compute, function, kind, parameters, value)
                        for name, function in functions.items()
                    }
                )
                for compute in (compute_value, compute_gradients)
            ]
            for name in functions:
                cells = [kind, str(count), name]
                for rounds in times:
                    nanoseconds = Rounds(tuple(1e6 * number / VALUES for number in rounds[name].milliseconds))
                    cells += [nanoseconds.text(), rounds[name].times_faster(rounds["torch"])]
                lines.append(f"| {' | '.join(cells)} |")
    return lines


def mixture_of(kind: str, count: int) -> Mixture:
    """Return one mixture of components with random weights, and with places and widths that differ."""
    weights, place, logarithm = torch.randn(3, 1, count, generator=torch.Generator().manual_seed(count))
    width = (logarithm - 2).exp()
    spread = width.square().reciprocal() if kind == "von Mises" else width
    return Mixture(weights, OURS[kind]((math.pi * place / 2)[..., None], spread[..., None]))


@torch.no_grad()
def highest_of_all_modes(mixture: Mixture) -> Tensor:
    """Return the highest log-density of a mixture at the modes of its components."""
    return mixture.log_prob(mixture.components.mode.movedim(-2, 0)).max()


def mode_table() -> list[str]:
    """Return the lines of the table of times of the mode."""
    lines = [
        "| components | K | mode, ms | all pairs, ms | log-density at the mode minus the highest at the modes |",
        "|---|---|---|---|---|",
    ]
    for kind in OURS:
        for count in MODES:
            mixture = mixture_of(kind, count)
            calls: dict[str, Callable[[], object]] = {"mode": partial(getattr, mixture, "mode")}
            if count <= MOST_PAIRS:
                calls["pairs"] = partial(highest_of_all_modes, mixture)
            times = time_interleaved(calls, seconds=0.05)
            cells = [kind, f"{count:,}", times["mode"].text(), "–", "–"]
            if "pairs" in times:
                gain = mixture.log_prob(mixture.mode) - highest_of_all_modes(mixture)
                cells[3:] = [times["pairs"].text(), f"{gain.item():.1e}"]
            lines.append(f"| {' | '.join(cells)} |")
    return lines


def main() -> None:
    """Measure and write the page."""
    torch.set_num_threads(1)
    require_idle()
    conditions = (
        f"All times on this page are processor times of one thread, in float32. A number is the median of {ROUNDS} "
        f"interleaved rounds (least to largest). {machine('torch', 'numpy', 'numba')} Command: `python -m "
        "benchmarks.densities.mixtures`."
    )
    write_page(
        __file__,
        [
            "# Mixtures: time of the log-density and of the mode",
            "",
            "This page compares the speed of this project's mixtures with `torch.distributions`, and says how the time "
            "to find the mode grows with the number of components.",
            "",
            "## Log-density",
            "",
            "The table shows the time to compute the log-density of mixtures of K components over one number. It is "
            f"computed for {VALUES:,} pairs of a value and a component, and times are for one pair. `ours` is "
            "`Mixture` with the densities of the heads `von_mises` and `gaussian`, as the mixture head makes it, and "
            "`torch` is MixtureSameFamily of torch.distributions. Both are constructed in every call. The gradients "
            "are with respect to the weights, the means and the widths of the components.",
            "",
            *density_table(),
            "",
            "## Mode",
            "",
            "The table shows the time to find the mode of one mixture of K components of different widths. The "
            "search first computes the density of the mixture at the modes of all components, and then climbs "
            "from a few of the highest. With 2,048 components or more, these densities are interpolated, in a "
            "time that grows with K log K. The column `all pairs` is the time to compute them without "
            "interpolation, from all pairs of components, and without the climb. The last column is the "
            "log-density of the mixture at the found mode, minus its highest log-density at the mode of a "
            "component. It should be 0 or more.",
            "",
            *mode_table(),
            "",
            conditions,
        ],
    )


if __name__ == "__main__":
    main()
