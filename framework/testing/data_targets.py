"""Check by nearest neighbours that targets belong to their inputs, if targets can be predicted from inputs at all."""

import torch
from torch import Tensor

from framework.data import Data
from framework.datasets.fields import fetch
from framework.testing.data_samples import batches, indices_to_check, remove_padding, splits_by_name
from framework.testing.finding import SEED, Worst

LEAST, MOST = 192, 960
"""Smallest number of samples with which a split is checked, and largest number of its samples that are used."""
BLOCK = 48
"""Number of consecutive samples whose errors are averaged."""
NEIGHBOURS = 7
"""Number of neighbours whose targets predict the target of a sample."""
SIZE = 64
"""Dimension of the space in which neighbours are searched for; larger inputs are projected to it at random."""
SURE, CHANCE = 0.2, 0.8
"""Bounds on the error of predicting targets from inputs, relative to the error for random targets.

Below the first bound, inputs predict targets. Above the second bound, they do not.
"""


def check_targets_belong(data: Data, worst: Worst) -> None:
    """Check that inputs predict their own targets in every block of a split, if they predict them in most blocks.

    A target is predicted by the median target of the samples with the nearest inputs. If inputs do not predict their
    own targets, they must not predict the targets of the previous or the next sample either.

    Args:
        data: Prepared data set.
        worst: Recorder of the largest error.
    """
    for name, split in splits_by_name(data).items():
        indices = indices_to_check(split)[:MOST]
        worst.count(False, f"{name} has {len(indices)} samples to check")
        if len(indices) < LEAST:
            continue
        inputs, targets = [], []
        for part in batches(indices, [64]):
            batch = fetch(split, part)
            inputs.append(torch.stack([_input_features(sample_input) for sample_input in batch["input"]]))
            targets.append(_target_features(data, batch["target"]))
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
            first = indices[BLOCK * int(wrong.double().argmax())]
            worst.count(
                wrong,
                f"{name}: the inputs of {int(wrong.sum())} blocks of {BLOCK} samples, the first from {first} on, do "
                "not predict their targets, while those of most other blocks do",
            )
        elif share.mean() > CHANCE:
            for step in (1, -1):
                beside = (_error(y.roll(step, 0), near) / chance).mean().item()
                worst.count(
                    beside < SURE,
                    f"{name}: inputs do not predict their own targets, but those of the samples at index {-step:+d}",
                )


def _error(targets: Tensor, near: Tensor) -> Tensor:
    """Return twice the squared error of predicting each target by the median target of its neighbours, (samples,).

    For neighbours that say nothing about the target, this is about the squared distance of two random targets.

    Args:
        targets: Targets as numbers, (samples, number).
        near: Indices of the neighbours of each sample.
    """
    return 2 * (targets - targets[near].median(1).values).square().sum(-1)


def _input_features(inputs: Tensor) -> Tensor:
    """Return the features of one input, (number,): its values, or moments for a cloud, whose points have no order."""
    inputs = inputs.double()
    if inputs.dim() != 2:
        return inputs.reshape(-1)
    points = remove_padding(inputs)
    centred = points - points.mean(0)
    return torch.cat([points.mean(0), (centred.T @ centred).reshape(-1) / len(points), centred.abs().amax(0)])


def _target_features(data: Data, targets: Tensor) -> Tensor:
    """Return targets as numbers whose distances measure how different the targets are, (samples, number).

    They are sine and cosine of angles, one number for each class, or real numbers in standard deviations, up to 3.
    """
    if data.target.kind == "class":
        return torch.nn.functional.one_hot(targets.long(), len(data.target.names)).double()
    flat = targets.double().flatten(1)
    if data.target.kind == "angle":
        return torch.cat([flat.sin(), flat.cos()], 1)
    # at most three standard deviations, so that a few far targets do not dominate
    spread = flat.std(0).clamp(min=1e-12)
    return ((flat - flat.median(0).values) / spread).clamp(-3, 3)
