"""The mixture with equal weights, shared by wrappers of several members or samples of weights."""

import torch
from torch import nn
from torch.distributions import Distribution

from framework.distributions.density import Mixture


def equal_mixture(components: Distribution, model: nn.Module, device: torch.device) -> Mixture:
    """Return the mixture over models (1/S) Σ_s p_s over the last batch dimension of `components`.

    The weights have the dtype of the model's parameters, or float32 for parameters in half precision, in which S
    weights would not sum to 1.
    """
    dtypes = (parameter.dtype for parameter in model.parameters())
    dtype = next(dtypes, torch.get_default_dtype())  # trees have no parameters
    dtype = dtype if dtype.itemsize >= 4 else torch.float32
    mixture = Mixture(torch.zeros(components.batch_shape, dtype=dtype, device=device), components)
    mixture.over_models = True
    return mixture
