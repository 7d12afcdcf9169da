"""What heads fitted at once share: normal densities also of an empty batch, and what the framework asks of them."""

import numpy as np
import pytest
import torch
from scipy import stats

from framework.distributions.density import Mixture
from framework.distributions.protocol import mahalanobis, marginal, median, normals, pick
from framework.distributions.tempering import temper
from plugins.density_head.trees.fitted_head import IndependentNormals, single, take_shapes


@pytest.mark.parametrize("shape", [(4, 3), (2, 5, 2), (0, 2), (3,)])
def test_log_prob_and_entropy_are_sums_of_scipys(shape):
    mean, scale, value = torch.randn(3, *shape, dtype=torch.float64).unbind()
    scale = scale.exp()
    density = IndependentNormals(mean, scale)
    arrays = [part.numpy() for part in (value, mean, scale)]
    np.testing.assert_allclose(
        density.log_prob(value).numpy(), stats.norm.logpdf(*arrays).sum(-1), rtol=1e-12
    )
    np.testing.assert_allclose(density.entropy().numpy(), stats.norm.entropy(*arrays[1:]).sum(-1), rtol=1e-12)
    assert density.event_shape == shape[-1:]
    assert torch.equal(median(density, 3), mean)


def test_the_framework_treats_them_as_any_independent_normals():
    mean, scale = torch.randn(4, 3, 2), torch.rand(4, 3, 2) + 0.5
    density = IndependentNormals(mean, scale)
    one = marginal(density, 1)
    assert one.event_shape == (1,)
    assert torch.equal(normals(one).mean, mean[..., 1:].double())
    assert pick(density, torch.tensor([0, 1, 2, 1])).batch_shape == (4,)
    value = torch.randn(4, 3, 2)
    wanted = ((value - mean) / scale).double().square().sum(-1)
    torch.testing.assert_close(mahalanobis(density, value), wanted, rtol=1e-6, atol=1e-6)
    hot = temper(Mixture(torch.zeros(4, 3), density), torch.tensor(4.0))
    torch.testing.assert_close(hot.components.base_dist.scale, 2 * scale)


def test_single_precision_cuts_off_what_exceeds_it():
    largest = torch.finfo(torch.float32).max
    found = single(torch.tensor([1e300, -1e300, 0.1], dtype=torch.float64))
    assert found.tolist() == [largest, -largest, float(np.float32(0.1))]
    assert single(torch.ones(3, 2).T).is_contiguous()


class Sized(torch.nn.Module):
    """Holds numbers of any count."""

    def __init__(self, count):
        super().__init__()
        self.register_buffer("numbers", torch.arange(count, dtype=torch.int32))

    def _load_from_state_dict(self, state_dict, prefix, *rest):
        take_shapes(self, state_dict, prefix)
        super()._load_from_state_dict(state_dict, prefix, *rest)


def test_a_state_of_another_shape_is_taken():
    holder = torch.nn.Sequential(Sized(0), Sized(2))
    holder.load_state_dict(torch.nn.Sequential(Sized(5), Sized(1)).state_dict())
    assert holder[0].numbers.tolist() == [0, 1, 2, 3, 4]
    assert holder[1].numbers.tolist() == [0]
    with pytest.raises(RuntimeError, match="Missing key"):
        holder.load_state_dict({"0.numbers": torch.zeros(1)})
