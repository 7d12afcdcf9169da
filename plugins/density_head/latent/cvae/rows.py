"""Rows of the contract: CVAEs, with bounds summed in NumPy proposal by proposal."""

import math
from collections.abc import Iterator

import numpy as np
import torch
from scipy import special, stats
from torch import nn

from framework.density_head import DensityHead
from framework.distributions.monte_carlo import Effort, NormalPoints
from framework.target import Target
from framework.testing.finding import SEED
from framework.testing.rows import Case, HeadRow
from plugins.density_head.latent.cvae.head import LARGEST_LOG_SCALE, CVAEHead

ONE, TWO = Target("angle", ("azimuth",)), Target("angle", ("azimuth", "elevation"))
CLASSES = Target("class", ("a", "b", "c"))
SMALL = {"latent": 2, "hidden": 16, "training_samples": 5, "samples": 50}


def component(head: CVAEHead, number: np.ndarray, value: np.ndarray) -> float:
    """One component's log-density; its own rows check it."""
    return head.component(torch.from_numpy(number)).log_prob(torch.from_numpy(value)).item()


def through(layers: nn.Sequential, numbers: np.ndarray) -> np.ndarray:
    """What a network of linear layers and rectifiers makes of a vector."""
    for layer in layers:
        if isinstance(layer, nn.Linear):
            numbers = layer.weight.detach().numpy() @ numbers + layer.bias.detach().numpy()
        else:
            numbers = np.maximum(numbers, 0)
    return numbers


def gaussian(layers: nn.Sequential, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of z."""
    mean, log_scale = np.split(through(layers, numbers), 2)
    return mean, np.exp(LARGEST_LOG_SCALE * np.tanh(log_scale / LARGEST_LOG_SCALE))


def bound(head: CVAEHead, raw: np.ndarray, value: np.ndarray, noise: np.ndarray) -> float:
    """The importance-weighted bound of one item (eq. 3.19) at standard normal noise (sample, latent)."""
    for_prior, for_posterior, for_decoder = np.split(raw, [head.hidden, 2 * head.hidden])
    features, shared, turned = np.split(for_decoder, np.cumsum(head.decoder.parts)[:2])
    spread = head.decoder.spread.detach().numpy()
    prior = gaussian(head.prior, for_prior)
    seen = head.from_value.weight.detach().numpy() @ np.concatenate([np.cos(value), np.sin(value)])
    posterior = gaussian(head.posterior, for_posterior + seen)
    log_weights = []
    for one in noise:
        z = posterior[0] + posterior[1] * one
        number = through(head.decoder.body, features + head.decoder.from_latent.weight.detach().numpy() @ z)
        number = number + shared + (spread + turned.reshape(spread.shape)) @ z
        ratio = (stats.norm.logpdf(z, *prior) - stats.norm.logpdf(z, *posterior)).sum()
        log_weights.append(component(head, number, value) + ratio)
    return float(special.logsumexp(np.array(log_weights) - math.log(len(noise))))  # pyright: ignore[reportArgumentType]


def stiff(head: DensityHead) -> Iterator[Case]:
    """Ordinary raw numbers, and large ones: narrow components, a narrow prior, an encoder that misses it."""
    assert isinstance(head, CVAEHead)
    generator = torch.Generator().manual_seed(7)
    ordinary = torch.randn(4, head.size, generator=generator).double()
    value = 3 * torch.randn(4, head.component.size // 3, generator=generator).double()
    effort = Effort(head.samples)
    for name, raw in {"ordinary": ordinary, "large": 8 * ordinary}.items():
        torch.manual_seed(SEED)  # as before the density is built
        latent = head.decoder.spread.shape[-1]
        points = NormalPoints(4, effort.replicates, latent, dtype=torch.float64, device=raw.device)
        noise = points(torch.arange(4), 0, effort.first).flatten(0, 1).numpy()
        log_prob = [bound(head, raw[item].numpy(), value[item].numpy(), noise[:, item]) for item in range(4)]
        yield Case(name, raw, value, torch.tensor(log_prob, dtype=torch.float64))


BOUND = {
    "integral": "log_prob is a lower bound, loose with an untrained encoder; test_cvae.py integrates the mixture",
    "samples follow log_prob": "they follow the mixture, and log_prob is a bound on it",
    "entropy": "that of the mixture",
    "mode": "that of the mixture",
    "median": "that of the mixture",
    "marginals": "those of the mixture",
}
ADAPTIVE = {
    **BOUND,
    "float32 against float64": "either may stop a round of samples before the other",
    "finite for any raw numbers": "slow: most of them take every sample there is; the other rows see them",
}

ROWS = {
    "cvae": (
        HeadRow("one angle", ONE, SMALL, cases=stiff, leave_out=BOUND),
        HeadRow("two angles", TWO, SMALL, cases=stiff, leave_out=BOUND),
        HeadRow(
            "mixtures", ONE, {**SMALL, "component": {"name": "mixture", "components": 2}}, leave_out=BOUND
        ),
        HeadRow("classes", CLASSES, {**SMALL, "component": {"name": "categorical"}}, leave_out=BOUND),
        HeadRow("to 0.05 nats", ONE, {**SMALL, "latent": 1, "tolerance": 0.05}, leave_out=ADAPTIVE),
    )
}
