"""Check that targets belong to their inputs, by nearest neighbours, where inputs predict targets at all."""

import torch
from torch import Tensor

from framework.data import Data
from framework.datasets.fields import fetch
from framework.testing.data_samples import batches, numbers, parts, trimmed
from framework.testing.finding import SEED, Worst

LEAST, MOST = 192, 960
"""Smallest number of samples of a split that is checked, and number of its first samples that are used."""
BLOCK = 48
NEIGHBOURS = 7
SIZE = 64
"""Largest number of values of an input; larger inputs are projected at random to this number."""
SURE, CHANCE = 0.2, 0.8
"""Bounds on the error relative to that of random targets.

Inputs predict targets if the error is below the first bound, and do not if it is above the second.
"""


def belong(data: Data, worst: Worst) -> None:
    """Check that no block of a split has inputs that do not predict its targets, where those of most blocks do.

    A target is predicted by the median over the nearest other samples. Where inputs do not predict their own targets,
    they must not predict those of the sample before or after either.
    """
    for name, split in parts(data).items():
        asked = numbers(split)[:MOST]
        worst.count(False, f"{name} has {len(asked)} samples")
        if len(asked) < LEAST:
            continue
        inputs, targets = [], []
        for part in batches(asked, [64]):
            batch = fetch(split, part)
            inputs.append(torch.stack([_numbers(one) for one in batch["input"]]))
            targets.append(_targets(data, batch["target"]))
        x, y = torch.cat(inputs), torch.cat(targets)
        if x.shape[1] > SIZE:
            generator = torch.Generator().manual_seed(SEED)
            x = x @ torch.randn(x.shape[1], SIZE, dtype=x.dtype, generator=generator)
        x = (x - x.mean(0)) / x.std(0).clamp(min=1e-12)
        chance = 2 * y.var(0, correction=0).sum().item()  # expected squared distance of two targets at random
        if chance == 0:
            continue
        near = torch.cdist(x, x).fill_diagonal_(torch.inf).topk(NEIGHBOURS, largest=False).indices
        share = _error(y, near) / chance
        blocks = torch.stack([part.mean() for part in share.split(BLOCK)[: len(share) // BLOCK]])
        if blocks.median() < SURE:
            wrong = blocks > CHANCE
            first = asked[BLOCK * int(wrong.double().argmax())]
            worst.count(
                wrong,
                f"{name}: the inputs of {int(wrong.sum())} stretches of {BLOCK} samples, the first from {first} on, "
                "tell nothing of their targets, where those of most others do",
            )
        elif share.mean() > CHANCE:
            for step in (1, -1):
                beside = (_error(y.roll(step, 0), near) / chance).mean().item()
                worst.count(
                    beside < SURE,
                    f"{name}: inputs tell the targets of the samples {step:+d} away, not their own",
                )


def _error(targets: Tensor, near: Tensor) -> Tensor:
    """Return the squared error of the median of the neighbours' targets."""
    return 2 * (targets - targets[near].median(1).values).square().sum(-1)


def _numbers(inputs: Tensor) -> Tensor:
    """Return the values of one input; those of a cloud are its moments, since its points have no order."""
    inputs = inputs.double()
    if inputs.dim() != 2:
        return inputs.reshape(-1)
    points = trimmed(inputs)
    centred = points - points.mean(0)
    return torch.cat([points.mean(0), (centred.T @ centred).reshape(-1) / len(points), centred.abs().amax(0)])


def _targets(data: Data, targets: Tensor) -> Tensor:
    """Return targets as numbers whose differences are meaningful, (samples, number)."""
    if data.target.kind == "class":
        return torch.nn.functional.one_hot(targets.long(), len(data.target.names)).double()
    flat = targets.double().flatten(1)
    if data.target.kind == "angle":
        return torch.cat([flat.sin(), flat.cos()], 1)
    # at most three deviations, so that a few far targets do not dominate
    spread = flat.std(0).clamp(min=1e-12)
    return ((flat - flat.median(0).values) / spread).clamp(-3, 3)
