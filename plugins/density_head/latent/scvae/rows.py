"""Rows of the contract: simplified CVAEs, with log-densities summed in NumPy sample by sample."""

import math
from collections.abc import Iterator

import numpy as np
import torch
from scipy import special
from torch import nn

from framework.density_head import DensityHead
from framework.distributions.monte_carlo import Effort, NormalPoints
from framework.target import Target
from framework.testing.finding import SEED
from framework.testing.rows import Case, HeadRow
from plugins.density_head.latent.scvae.head import SCVAEHead

ONE, TWO = Target("angle", ("azimuth",)), Target("angle", ("azimuth", "elevation"))
CLASSES = Target("class", ("a", "b", "c"))
SMALL = {"latent": 2, "hidden": 16, "training_samples": 5, "samples": 50}


def component(head: SCVAEHead, number: np.ndarray, value: np.ndarray) -> float:
    """One component's log-density; its own rows check it."""
    return head.component(torch.from_numpy(number)).log_prob(torch.from_numpy(value)).item()


def decoded(head: SCVAEHead, raw: np.ndarray, z: np.ndarray) -> np.ndarray:
    """The component's raw numbers at one z (plugins.density_head.latent.decoder), layer by layer."""
    hidden, numbers = head.decoder.parts[:2]
    spread = head.decoder.spread.detach().numpy() + raw[hidden + numbers :].reshape(numbers, -1)
    layer = raw[:hidden] + head.decoder.from_latent.weight.detach().numpy() @ z
    for part in head.decoder.body:
        if isinstance(part, nn.Linear):
            layer = part.weight.detach().numpy() @ layer + part.bias.detach().numpy()
        else:
            layer = np.maximum(layer, 0)
    return layer + raw[hidden : hidden + numbers] + spread @ z


def stiff(head: DensityHead) -> Iterator[Case]:
    """Ordinary raw numbers, narrow components, and targets far from all of them (eq. 3.21)."""
    assert isinstance(head, SCVAEHead)
    generator = torch.Generator().manual_seed(7)
    ordinary = torch.randn(4, head.size, generator=generator)
    value = 3 * torch.randn(4, head.component.size // 3, generator=generator).double()
    narrow = ordinary.clone()
    narrow[:, head.hidden :] *= 10
    effort = Effort(head.samples)
    for name, raw in {"ordinary": ordinary.double(), "narrow and far": narrow.double()}.items():
        torch.manual_seed(SEED)  # as before the density is built
        points = NormalPoints(4, effort.replicates, head.latent, dtype=torch.float64, device=raw.device)
        z = points(torch.arange(4), 0, effort.first).flatten(0, 1).numpy()
        terms = [
            [
                component(head, decoded(head, raw[item].numpy(), one), value[item].numpy())
                for one in z[:, item]
            ]
            for item in range(4)
        ]
        log_prob = special.logsumexp(np.array(terms) - math.log(head.samples), axis=1)
        yield Case(name, raw, value, torch.tensor(np.array(log_prob), dtype=torch.float64))


DRAWN = {"median": 0.02}
"""Of 2000 draws."""
ADAPTIVE = {
    "float32 against float64": "either may stop a round of samples before the other",
    "samples follow log_prob": "the samples do not depend on the tolerance",
    "entropy": "that of the mixture",
    "median": "that of the mixture",
}

ROWS = {
    "scvae": (
        HeadRow("one angle", ONE, SMALL, cases=stiff, limits=DRAWN),
        HeadRow("two angles", TWO, SMALL, cases=stiff),
        HeadRow(
            "one sample",
            ONE,
            {**SMALL, "samples": 1, "training_samples": 1},
            cases=stiff,
            # nothing is averaged: what float32 rounds of the one z, times a narrow component's slope, stays (7e-6)
            limits={**DRAWN, "log_prob, float32": 1e-5},
        ),
        HeadRow("mixtures", ONE, {**SMALL, "component": {"name": "mixture", "components": 2}}, limits=DRAWN),
        HeadRow("classes", CLASSES, {**SMALL, "component": {"name": "categorical"}}),
        HeadRow(
            "to 0.05 nats",
            ONE,
            {**SMALL, "latent": 1, "tolerance": 0.05},
            limits={"integral": 0.05, "mode": 0.3},
            leave_out=ADAPTIVE,
        ),
    )
}
