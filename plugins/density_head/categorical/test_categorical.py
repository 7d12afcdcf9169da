import numpy as np
import pytest
import torch
from scipy import special

from framework.configuration.schema import build, resolve
from framework.distributions.density import Mixture
from framework.distributions.protocol import median
from framework.errors import ConfigError
from framework.target import Target
from plugins.density_head.categorical.rows import FIVE, TWO


def head(name, target):
    return build("density_head", resolve("density_head", {"name": name}), target=target)


def test_the_loss_is_cross_entropy():
    raw, label = torch.randn(6, 5), torch.randint(5, (6,))
    wanted = torch.nn.functional.cross_entropy(raw, label, reduction="none")
    torch.testing.assert_close(head("categorical", FIVE).loss(raw, label), wanted)
    raw, label = torch.randn(6, 1), torch.randint(2, (6,))
    wanted = torch.nn.functional.binary_cross_entropy_with_logits(raw[:, 0], label.float(), reduction="none")
    torch.testing.assert_close(head("bernoulli", TWO).loss(raw, label), wanted)


def test_large_logits_keep_digits_that_torchs_own_normalisation_loses():
    logits = torch.tensor([-1e4, 1e4, 1e4, 1e4, 1e4])
    wanted = -np.log(4)
    ours = head("categorical", FIVE)(logits).log_prob(torch.tensor(1)).item()
    assert ours == pytest.approx(wanted, rel=2e-7)
    assert (
        abs(torch.distributions.Categorical(logits=logits).log_prob(torch.tensor(1)).item() - wanted) > 1e-4
    )


def test_a_mixture_averages_probabilities_and_not_logits():
    raw = torch.tensor([[[8.0, 0.0], [0.0, 2.0]]])
    density = Mixture(torch.zeros(1, 2), head("categorical", TWO)(raw))
    wanted = special.softmax(raw.double().numpy(), -1).mean(1)[0]
    probabilities = density.log_prob(torch.tensor([[0], [1]])).exp()[:, 0]
    np.testing.assert_allclose(probabilities.numpy(), wanted, rtol=1e-6)
    assert density.mode.item() == median(density, 10).item() == wanted.argmax()
    assert density.entropy().item() == pytest.approx(-(wanted * np.log(wanted)).sum(), rel=1e-6)
    torch.manual_seed(0)
    share = density.sample((20_000,)).double().mean().item()
    assert share == pytest.approx(wanted[1], abs=4 * 0.5 / 20_000**0.5)


def test_the_likeliest_class_of_a_mixture_need_not_be_one_of_its_components():
    # two components prefer different classes, and both give 0.45 to a third class
    probabilities = torch.tensor([[[0.5, 0.05, 0.45], [0.05, 0.5, 0.45]]])
    density = Mixture(
        torch.zeros(1, 2), head("categorical", Target("class", ("a", "b", "c")))(probabilities.log())
    )
    assert density.mode.item() == 2


def test_more_than_two_classes_are_refused_by_bernoulli():
    with pytest.raises(ConfigError, match=r"has 5: a, b, c, d, e\. Choose density_head=categorical"):
        head("bernoulli", FIVE)


@pytest.mark.parametrize("name", ["categorical", "bernoulli"])
def test_other_targets_are_refused(name):
    with pytest.raises(ConfigError, match="describes targets of kind 'class'"):
        head(name, Target("real", ("x", "y")))
