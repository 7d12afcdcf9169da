"""Training of several models at once, each on all samples but those of its own fold."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.errors import NonFiniteLoss
from plugins.uncertainty.folds.groups import Apart, Together

BETAS = (0.9, 0.99)
"""Decay rates of the moments in AdamW."""
WARMUP = 0.02
"""Share of the steps in which the learning rate rises linearly."""
VALIDATIONS = 40
"""Number of times that the losses of the left-out folds are computed during training."""
MOST_STEPS = 20_000
"""Largest number of steps; if there are very many samples, the training makes fewer passes than it otherwise would."""
AT_ONCE = 8192
"""Largest number of left-out samples of a model whose losses are computed at once."""


@dataclass(frozen=True)
class Schedule:
    """Length and step sizes of a training.

    Attributes:
        steps, epochs: smallest number of steps, and smallest number of passes over the samples.
        learning_rate: largest learning rate of AdamW.
        weight_decay: weight decay for each group of models (see `Folds`); biases do not decay.
        batch_size: samples of a batch of each model.
        most_steps: largest number of steps, even if `steps` and `epochs` ask for more.
    """

    steps: int
    epochs: int
    learning_rate: float
    weight_decay: Sequence[float]
    batch_size: int = 64
    most_steps: int = MOST_STEPS

    def count_steps(self, batches: int) -> int:
        """Return the number of steps of the training, if one pass over the samples has `batches` batches."""
        return min(self.most_steps, max(self.steps, self.epochs * batches))

    def rate(self, step: int, steps: int) -> float:
        """Return the learning rate at a step: a linear rise, then half a cosine to 0."""
        warmup = max(1, int(WARMUP * steps))
        return (
            self.learning_rate * min(1.0, (step + 1) / warmup) * 0.5 * (1 + math.cos(math.pi * step / steps))
        )


class Training:
    """Training of all models, each on the samples outside its fold; an iterable with one item for each step.

    After the last step, each model has the weights with the lowest loss on its fold. Random numbers come from torch's
    global generator.

    Args:
        models: the models.
        inputs: inputs of all samples.
        target: targets of all samples.
        fold: fold of each sample; model k of each group leaves out fold k.
        folds: number of folds.
        schedule: length and step sizes.

    Raises:
        NonFiniteLoss: a model never had a finite loss on its fold.
    """

    def __init__(
        self,
        models: Together | Apart,
        inputs: Float[Tensor, "sample *input"],
        target: Tensor,
        fold: Int[Tensor, "sample"],
        folds: int,
        schedule: Schedule,
    ) -> None:
        self.models, self.inputs, self.target, self.schedule = models, inputs, target, schedule
        groups = range(len(schedule.weight_decay))
        self.samples = [torch.nonzero(fold != number).flatten() for _ in groups for number in range(folds)]
        self.held_out = [torch.nonzero(fold == number).flatten() for _ in groups for number in range(folds)]
        self.decay = torch.tensor(schedule.weight_decay).repeat_interleave(folds)
        fewest = min(map(len, self.samples))
        self.batch_size = min(schedule.batch_size, fewest)
        self.batches = fewest // self.batch_size

    def __len__(self) -> int:
        return self.schedule.count_steps(self.batches)

    def __iter__(self) -> Iterator[int]:
        models, steps = self.models, len(self)
        trained = [parameter for parameter in models.parameters() if parameter.requires_grad]
        optimizer = torch.optim.Adam(trained, betas=BETAS, fused=True)
        best = torch.full((len(self.samples),), math.inf, dtype=torch.float64)
        every = max(1, steps // VALIDATIONS)
        for step in range(steps):
            rate = optimizer.param_groups[0]["lr"] = self.schedule.rate(step, steps)
            rows = self._batch(step)
            losses = models.losses(self.inputs[rows], self.target[rows])
            (losses.sum() / self.batch_size).backward()  # each model has the gradient of its own mean loss
            models.decay(rate * self.decay)  # decoupled from the gradient (Loshchilov & Hutter 2019)
            optimizer.step()
            optimizer.zero_grad()
            if (step + 1) % every == 0 or step + 1 == steps:
                loss = self._held_out_losses()
                models.remember(loss < best)
                best = torch.fmin(best, loss)
            yield step
        if not bool(best.isfinite().all()):
            raise NonFiniteLoss(
                "The loss of a model on its left-out fold was never finite. Check the table for extreme numbers, or "
                "lower uncertainty.folds.learning_rate."
            )
        models.restore()

    def _batch(self, step: int) -> Int[Tensor, "member sample"]:
        """Return the numbers of the samples of each model's batch; at the start of a pass, draw new orders."""
        position = step % self.batches
        if position == 0:
            length = self.batches * self.batch_size
            self.orders = torch.stack([part[torch.randperm(len(part))[:length]] for part in self.samples])
        return self.orders[:, position * self.batch_size : (position + 1) * self.batch_size]

    @torch.no_grad()
    def _held_out_losses(self) -> Float[Tensor, "member"]:
        """Return the mean loss of each model on the samples that it leaves out, float64."""
        self.models.eval()
        longest = max(map(len, self.held_out))
        # shorter folds are filled with their first sample, which does not count
        rows = torch.stack(
            [torch.cat([part, part[:1].expand(longest - len(part))]) for part in self.held_out]
        )
        parts = [self.models.losses(self.inputs[part], self.target[part]) for part in rows.split(AT_ONCE, 1)]
        self.models.train()
        counts = torch.tensor([len(part) for part in self.held_out])
        counted = torch.arange(longest) < counts.unsqueeze(1)
        return torch.where(counted, torch.cat(parts, 1).double(), 0.0).sum(1) / counts


def assign_folds(inputs: Float[Tensor, "sample *input"], folds: int) -> Int[Tensor, "sample"]:
    """Return the fold of each sample, at random; samples with equal inputs are in the same fold.

    A repeated sample would otherwise be predicted by a model that was trained on its copy. If there are fewer different
    inputs than twice the number of folds, every sample is assigned on its own.
    """
    distinct, number = torch.unique(inputs.flatten(1), dim=0, return_inverse=True)
    count = len(distinct)
    if count < 2 * folds:
        count, number = len(inputs), torch.arange(len(inputs))
    order = torch.randperm(count)
    fold = torch.empty_like(order)
    fold[order] = torch.arange(count) % folds
    return fold[number]
