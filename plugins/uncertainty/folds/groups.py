"""The models of a cross-fitted ensemble: as one chain of stacked layers, or computed one after the other.

There are G groups of K models. Model k of group g has the number g K + k.
"""

import copy
from collections.abc import Sequence
from typing import cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.distributions import Distribution

from framework.data import Batch
from framework.density_head import DensityHead, Fitted
from framework.distributions.batch_shapes import Stacked
from framework.model import Model, Predictor
from plugins.uncertainty.folds.chain import Chain, build_chain


class Together(nn.Module):
    """Models whose layers are stacked and computed together, with one head for each group.

    Args:
        chain: networks of all models, from inputs to raw parameters.
        head: density head without trained parameters, which is copied for each group.
        groups: G, the number of groups; model k of group g has the number g K + k in the chain.
    """

    def __init__(self, chain: Chain, head: DensityHead, groups: int) -> None:
        super().__init__()
        self.chain = chain
        self.heads = nn.ModuleList(copy.deepcopy(head) for _ in range(groups))
        self._best: list[Tensor] = []

    def losses(self, inputs: Tensor, target: Tensor) -> Float[Tensor, "member batch"]:
        """Return the loss of each model for its own samples, nats.

        Each model has its own row of `inputs`, (member, batch, *input), and of `target`, (member, batch, *event).
        """
        return self._head(0).loss(self.chain(inputs.flatten(2)), target)

    @torch.no_grad()
    def decay(self, shares: Float[Tensor, "member"]) -> None:
        """Multiply the weights of each model by 1 minus the model's share; biases do not change."""
        for weight in self.chain.weights:
            weight.mul_((1 - shares.to(weight)).view(-1, 1, 1))

    @torch.no_grad()
    def remember(self, better: Bool[Tensor, "member"]) -> None:
        """Store the present weights of the models where `better` is true."""
        present = [parameter.detach() for parameter in self.chain.parameters()]
        if not self._best:
            self._best = [part.clone() for part in present]
        for best, part in zip(self._best, present, strict=True):
            best[better] = part[better]

    @torch.no_grad()
    def restore(self) -> None:
        """Set the weights to those that were stored."""
        for parameter, best in zip(self.chain.parameters(), self._best, strict=True):
            parameter.copy_(best)
        self._best = []
        self.chain.forget_masks()

    def densities(self, inputs: Tensor) -> list[Distribution]:
        """Return one distribution for each group: the densities of its K models, batch_shape (batch, K)."""
        return [self._head(group)(raw) for group, raw in enumerate(self._raw(inputs))]

    def training_densities(self, inputs: Tensor) -> list[Distribution]:
        """Return the densities that objectives read in training: one for each model, batch_shape (batch,)."""
        groups = enumerate(self._raw(inputs))
        return [self._head(group)(part) for group, raw in groups for part in raw.unbind(1)]

    def losses_of_all(self, inputs: Tensor, target: Tensor) -> Float[Tensor, "batch member"]:
        """Return the losses of all models for the same samples, nats."""
        raw = torch.cat(list(self._raw(inputs)), 1)
        return self._head(0).loss(raw, _repeat(target, raw.shape[1]))

    def calibrate(self, batches: Sequence[Batch], fold: Sequence[Int[Tensor, "sample"]] | None) -> None:
        """Calibrate the heads.

        Args:
            batches: samples.
            fold: for each batch, the fold of each of its samples; model k of each group has not seen the samples of
                fold k. None if no model has seen any of the samples.
        """
        raws: list[list[Tensor]] = [[] for _ in self.heads]
        targets = []
        for number, batch in enumerate(batches):
            target = batch["target"]
            for group, raw in enumerate(self._raw(batch["input"])):
                rows = torch.arange(len(raw), device=raw.device)
                raws[group].append(
                    raw.flatten(0, 1) if fold is None else raw[rows, fold[number].to(raw.device)]
                )
            models = self.chain.members // len(self.heads)
            targets.append(_repeat(target, models).flatten(0, 1) if fold is None else target)
        for group, parts in enumerate(raws):
            self._head(group).calibrate(torch.cat(parts), torch.cat(targets))

    def _raw(self, inputs: Tensor) -> Sequence[Float[Tensor, "batch member size"]]:
        """Return one tensor for each group: the raw parameters of its K models."""
        return self.chain(inputs.flatten(1)).movedim(0, 1).chunk(len(self.heads), 1)

    def _head(self, group: int) -> DensityHead:
        return cast(DensityHead, self.heads[group])


def _repeat(target: Tensor, models: int) -> Tensor:
    """Return the targets (batch, *event) once for each of several models, (batch, member, *event)."""
    return target.unsqueeze(1).expand(len(target), models, *target.shape[1:])


class Apart(nn.Module):
    """Models that are computed one after the other.

    Args:
        models: the models of all groups, one group after another; all groups have the same number of models.
        dropout: probability of all dropout layers, for each group; None leaves them as they are.
    """

    def __init__(self, models: Sequence[Predictor], dropout: Sequence[float | None]) -> None:
        super().__init__()
        self.models = nn.ModuleList(models)
        self.size = len(models) // len(dropout)
        for number, model in enumerate(models):
            probability = dropout[number // self.size]
            for module in model.modules():
                if isinstance(module, nn.Dropout) and probability is not None:
                    module.p = probability
        self._best: list[dict[str, Tensor]] = [{} for _ in models]

    def losses(self, inputs: Tensor, target: Tensor) -> Float[Tensor, "member batch"]:
        """Return the loss of each model for its own samples, nats.

        Each model has its own row of `inputs`, (member, batch, *input), and of `target`, (member, batch, *event).
        """
        triples = zip(self._all(), inputs, target, strict=True)
        return torch.stack([model.loss(own_inputs, own_target) for model, own_inputs, own_target in triples])

    @torch.no_grad()
    def decay(self, shares: Float[Tensor, "member"]) -> None:
        """Multiply the parameters of each model that have two dimensions or more by 1 minus the model's share."""
        for model, share in zip(self.models, shares.tolist(), strict=True):
            for parameter in model.parameters():
                if parameter.dim() > 1 and parameter.requires_grad:
                    parameter.mul_(1 - share)

    def remember(self, better: Bool[Tensor, "member"]) -> None:
        """Store the present weights of the models where `better` is true."""
        for number in better.nonzero().flatten().tolist():
            state = self.models[number].state_dict()
            self._best[number] = {name: value.clone() for name, value in state.items()}

    def restore(self) -> None:
        """Set the weights to those that were stored."""
        for model, best in zip(self.models, self._best, strict=True):
            model.load_state_dict(best)
            best.clear()

    def densities(self, inputs: Tensor) -> list[Distribution]:
        """Return one distribution for each group: the densities of its K models, batch_shape (batch, K)."""
        several = [model(inputs) for model in self._all()]
        return [Stacked(several[first : first + self.size]) for first in range(0, len(several), self.size)]

    def training_densities(self, inputs: Tensor) -> list[Distribution]:
        """Return the densities that objectives read in training: one for each model, batch_shape (batch,)."""
        return [model.training_densities(inputs) for model in self._all()]

    def losses_of_all(self, inputs: Tensor, target: Tensor) -> Float[Tensor, "batch member"]:
        """Return the losses of all models for the same samples, nats."""
        return torch.stack([model.loss(inputs, target) for model in self._all()], 1)

    def calibrate(self, batches: Sequence[Batch], fold: Sequence[Int[Tensor, "sample"]] | None) -> None:
        """Calibrate the models, each with the samples that it has not seen.

        Args:
            batches: samples.
            fold: for each batch, the fold of each of its samples; model k of each group has not seen the samples of
                fold k. None if no model has seen any of the samples.
        """
        for number, model in enumerate(self._all()):
            own = batches
            if fold is not None:
                own = _select(batches, [part == number % self.size for part in fold])
            model.calibrate(own)

    def _all(self) -> list[Predictor]:
        return cast(list[Predictor], list(self.models))


def _select(batches: Sequence[Batch], masks: Sequence[Bool[Tensor, "sample"]]) -> list[Batch]:
    """Return the samples of the batches where the masks are true, without empty batches."""
    pairs = zip(batches, masks, strict=True)
    chosen = ({name: field[mask.to(field.device)] for name, field in batch.items()} for batch, mask in pairs)
    return [batch for batch in chosen if len(batch["target"])]


def build_models(models: Sequence[Predictor], dropout: Sequence[float | None]) -> Together | Apart:
    """Return the models as `Together` if their layers can be stacked, and as `Apart` otherwise.

    The layers can be stacked if `build_chain` accepts them and the density head has no trained parameters. `dropout` is
    the probability of all dropout layers, for each group; None leaves them as they are.
    """
    first = models[0]
    if not isinstance(first, Model) or isinstance(first.head, Fitted) or first.head.direct:
        return Apart(models, dropout)
    if any(parameter.requires_grad for parameter in first.head.parameters()):
        return Apart(models, dropout)
    networks = [nn.Sequential(model.encoders, model.projection) for model in cast(Sequence[Model], models)]
    chain = build_chain(networks, dropout)
    return Apart(models, dropout) if chain is None else Together(chain, first.head, len(dropout))
