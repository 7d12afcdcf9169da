"""Division of the entropy of a mixture over models into an expected entropy and a mutual information."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.batch_shapes import Reshaped, Stacked
from framework.distributions.density import Mixture


def expected_entropy(density: Distribution) -> Float[Tensor, "*batch"]:
    """Return the mean entropy of the models of a mixture over models (`Mixture.over_models`), nats, (*batch).

    This mean is the aleatoric part of the entropy, which remains if the model is known. The rest of the mixture's
    entropy is the mutual information of target and model, the epistemic part (Depeweg et al. 2018). Mixtures of
    mixtures over models are divided down to single models. Any other density comes from one model, and the result is
    its entropy.
    """
    if isinstance(density, Mixture):
        single = density.log_weights.shape[-1] == 1
        if density.over_models or single:
            return (density.log_weights.exp() * expected_entropy(density.components)).sum(-1)
    if isinstance(density, Stacked):
        return torch.stack([expected_entropy(part) for part in density.densities], -1)
    if isinstance(density, Reshaped):
        return expected_entropy(density.density).reshape(density.batch_shape)
    return density.entropy()
