"""Contract-test cases: CVAEs and simplified CVAEs, with log-densities computed sample by sample in NumPy."""

import math
from collections.abc import Iterator

import numpy as np
import torch
from scipy import special, stats
from torch import nn

from framework.density_head import DensityHead
from framework.target import Target
from framework.testing.finding import SEED
from framework.testing.rows import Case, HeadRow
from plugins.density_head.latent.cvae import LARGEST_LOG_SCALE, CVAEHead
from plugins.density_head.latent.decoder import LatentDecoder
from plugins.density_head.latent.monte_carlo import Effort, NormalPoints
from plugins.density_head.latent.scvae import SCVAEHead

ONE, TWO = Target("angle", ("azimuth",)), Target("angle", ("azimuth", "elevation"))
REAL, REALS = Target("real", ("height",)), Target("real", ("x", "y"))
CLASSES = Target("class", ("a", "b", "c"))
SMALL = {"latent": 2, "hidden": 16, "training_samples": 5, "samples": 50}


def component(head: CVAEHead | SCVAEHead, number: np.ndarray, value: np.ndarray) -> float:
    """Return the log-density of a component with raw parameters `number` at `value`, nats.

    It is computed by the component's head, which has contract-test cases of its own.
    """
    return head.component(torch.from_numpy(number)).log_prob(torch.from_numpy(value)).item()


def apply_layers(layers: nn.Sequential, numbers: np.ndarray) -> np.ndarray:
    """Return the output of a network of linear layers and rectifiers for one input vector."""
    for layer in layers:
        if isinstance(layer, nn.Linear):
            numbers = layer.weight.detach().numpy() @ numbers + layer.bias.detach().numpy()
        else:
            numbers = np.maximum(numbers, 0)
    return numbers


def decode(decoder: LatentDecoder, raw: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the component's raw parameters at one z (plugins.density_head.latent.decoder), layer by layer."""
    features, shared, turned = np.split(raw, np.cumsum(decoder.parts)[:2])
    spread = decoder.spread.detach().numpy() + turned.reshape(decoder.spread.shape)
    layer = features + decoder.from_latent.weight.detach().numpy() @ z
    return apply_layers(decoder.body, layer) + shared + spread @ z


def gaussian(layers: nn.Sequential, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean and the standard deviation of z that a network predicts from `numbers`."""
    mean, log_scale = np.split(apply_layers(layers, numbers), 2)
    return mean, np.exp(LARGEST_LOG_SCALE * np.tanh(log_scale / LARGEST_LOG_SCALE))


def log_weights(
    head: CVAEHead | SCVAEHead, raw: np.ndarray, value: np.ndarray, noise: np.ndarray
) -> list[float]:
    """Return the log of the importance weights of one item (eq. 3.19) at standard normal noise (sample, latent).

    For a simplified CVAE the noise is z, and the weights are the terms of eq. 3.21.
    """
    if isinstance(head, SCVAEHead):
        return [component(head, decode(head.decoder, raw, point), value) for point in noise]
    for_prior, for_posterior, for_decoder = np.split(raw, [head.hidden, 2 * head.hidden])
    prior = gaussian(head.prior, for_prior)
    encoded_value = head.from_value.weight.detach().numpy() @ np.concatenate([np.cos(value), np.sin(value)])
    posterior = gaussian(head.posterior, for_posterior + encoded_value)
    weights = []
    for point in noise:
        z = posterior[0] + posterior[1] * point
        ratio = (stats.norm.logpdf(z, *prior) - stats.norm.logpdf(z, *posterior)).sum()
        weights.append(component(head, decode(head.decoder, for_decoder, z), value) + ratio)
    return weights


def hard_cases(head: DensityHead) -> Iterator[Case]:
    """Yield cases with ordinary raw parameters, and hard ones.

    For a CVAE, hard raw parameters are large; they give narrow components, a narrow prior, and an encoder whose mean is
    far from the prior. For a simplified CVAE, they give narrow components and targets far from all components.
    """
    assert isinstance(head, CVAEHead | SCVAEHead)
    generator = torch.Generator().manual_seed(7)
    ordinary = torch.randn(4, head.size, generator=generator)
    value = 3 * torch.randn(4, head.component.size // 3, generator=generator).double()
    if isinstance(head, CVAEHead):
        name, hard = "large", 8 * ordinary.double()
    else:
        name, hard = "narrow and far", ordinary.clone()
        hard[:, head.hidden :] *= 10
    effort, latent = Effort(head.samples), head.decoder.spread.shape[-1]
    for case, raw in {"ordinary": ordinary.double(), name: hard.double()}.items():
        torch.manual_seed(SEED)  # as before the density is built
        points = NormalPoints(4, effort.replicates, latent, dtype=torch.float64, device=raw.device)
        noise = points(torch.arange(4), 0, effort.first).flatten(0, 1).numpy()
        terms = [
            log_weights(head, raw[item].numpy(), value[item].numpy(), noise[:, item]) for item in range(4)
        ]
        log_prob = special.logsumexp(np.array(terms) - math.log(head.samples), axis=1)
        yield Case(case, raw, value, torch.tensor(np.array(log_prob), dtype=torch.float64))


BOUND = {
    "integral": "log_prob is a lower bound, loose for an untrained encoder; test_cvae.py integrates the mixture",
    "samples follow log_prob": "samples follow the mixture, and log_prob is a bound on its log-density",
    "entropy": "the entropy is that of the mixture",
    "mode": "the mode is that of the mixture",
    "median": "the median is that of the mixture",
    "marginals": "the marginals are those of the mixture",
    "mean and variance": "they are those of the mixture",
}
ADAPTIVE_BOUND = {
    **BOUND,
    "float32 against float64": "one precision may stop a round of samples before the other",
    "finite for any raw parameters": "slow, because most need the largest number of samples; the other cases test this",
}
ADAPTIVE = {
    "float32 against float64": "one precision may stop a round of samples before the other",
    "samples follow log_prob": "the samples do not depend on the tolerance",
    "entropy": "the entropy is that of the mixture",
    "median": "the median is that of the mixture",
}
MIXTURES = {**SMALL, "component": {"name": "mixture", "components": 2}}
OF_CLASSES = {**SMALL, "component": {"name": "categorical"}}
OF_REALS = {**SMALL, "hidden": 8, "samples": 20, "component": {"name": "gaussian"}}
TOLERANT = {**SMALL, "latent": 1, "tolerance": 0.05}
# A check draws millions of samples where the tolerance is not reached, and a quadrature over two angles evaluates every
# component at each of its nodes.
QUICK, FEW = {"hidden": 8}, {"samples": 20}

ROWS = {
    "cvae": (
        HeadRow("one angle", ONE, SMALL, cases=hard_cases, leave_out=BOUND),
        HeadRow("two angles", TWO, SMALL, cases=hard_cases, leave_out=BOUND),
        HeadRow("mixtures", ONE, MIXTURES, leave_out=BOUND),
        HeadRow("classes", CLASSES, OF_CLASSES, leave_out=BOUND),
        HeadRow("a real number", REAL, OF_REALS, leave_out=BOUND),
        HeadRow("two real numbers", REALS, OF_REALS, leave_out=BOUND),
        HeadRow("to 0.05 nats", ONE, TOLERANT, leave_out=ADAPTIVE_BOUND),
    ),
    "scvae": (
        HeadRow("one angle", ONE, SMALL, cases=hard_cases),
        HeadRow("two angles", TWO, {**SMALL, **FEW}, cases=hard_cases),
        HeadRow(
            "one sample",
            ONE,
            {**SMALL, "samples": 1, "training_samples": 1},
            cases=hard_cases,
        ),
        HeadRow("mixtures", ONE, MIXTURES),
        HeadRow("classes", CLASSES, OF_CLASSES),
        HeadRow("a real number", REAL, OF_REALS),
        HeadRow("two real numbers", REALS, OF_REALS),
        HeadRow(
            "to 0.05 nats",
            ONE,
            {**TOLERANT, **QUICK},
            limits={"integral": 0.05, "mode": 0.3},
            leave_out=ADAPTIVE,
        ),
    ),
}
