"""The mixture with equal weights, shared by wrappers of several members or samples of weights."""

import torch
from torch import nn
from torch.distributions import Distribution

from framework.distributions.density import Mixture


def equal_mixture(components: Distribution, model: nn.Module, device: torch.device) -> Mixture:
    """Return the mixture, with equal weights, of the S densities p_s along the last batch dimension of `components`.

    Its density is (1/S) Σ_s p_s. Its weights have the dtype of the model's parameters; for parameters in half
    precision, they are float32, because S weights in half precision would not sum to 1.
    """
    dtypes = (parameter.dtype for parameter in model.parameters())
    dtype = next(dtypes, torch.get_default_dtype())  # trees have no parameters
    dtype = dtype if dtype.itemsize >= 4 else torch.float32
    mixture = Mixture(torch.zeros(components.batch_shape, dtype=dtype, device=device), components)
    mixture.over_models = True
    return mixture
