"""Draws from mixtures whose components are mixtures; only the components that are drawn are computed."""

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.description import PlainDensity
from framework.distributions.protocol import pick, take


class PickedMixture(PlainDensity):
    """Density of one of K mixtures, chosen for each item of a batch; only `sample` is defined.

    Args:
        log_weights: log-weights of the J components of each mixture, (*batch, K, J), nats, normalised.
        components: components of the mixtures, with batch_shape (*batch, K, J).
        index: index of the chosen mixture among K, (*sample, *batch).
        rows: number of draws (of the whole batch) that are computed at once.
    """

    def __init__(self, log_weights: Tensor, components: Distribution, index: Tensor, rows: int) -> None:
        self.log_weights = log_weights
        self.components = components
        self.index = index
        self.rows = rows
        super().__init__(index.shape, components.event_shape, validate_args=False)

    @torch.no_grad()
    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        *batch, _, _ = self.log_weights.shape
        lead = torch.Size(sample_shape) + self.index.shape[: self.index.dim() - len(batch)]
        index = self.index.expand((*sample_shape, *self.index.shape)).reshape(lead.numel(), *batch)
        samples = torch.cat([self._sample_once(part) for part in index.split(self.rows)])
        return samples.reshape(*lead, *batch, *self.event_shape)

    def _sample_once(self, index: Tensor) -> Tensor:
        """Return one sample of each mixture that `index` (sample, *batch) chooses."""
        *_, mixtures, count = self.log_weights.shape
        which = torch.zeros_like(index)
        if count > 1 and index.numel() > 0:  # torch.multinomial refuses to draw nothing
            weights = take(self.log_weights, index).exp()
            which = torch.multinomial(weights.reshape(-1, count), 1).reshape(index.shape)
        # pick the drawn component number in every mixture, then pick the chosen mixture
        wide = which.unsqueeze(-1).expand(*index.shape, mixtures)
        return pick(pick(self.components, wide), index).sample()
