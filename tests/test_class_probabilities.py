from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special
from torch.distributions import Categorical, Distribution, Independent, Normal

from framework.configuration.schema import build, resolve
from framework.distributions.batch_shapes import Reshaped, Stacked
from framework.distributions.checks import refuse_nan
from framework.distributions.class_probabilities import class_probabilities, require_labels
from framework.distributions.density import Mixture
from framework.errors import DataError, UserError
from framework.target import Target


def categorical(logits):
    return Categorical(logits=logits, validate_args=False)


class Listed(Distribution):
    """Return a density over classes with these log-probabilities, (class, batch)."""

    arg_constraints = {}  # noqa: RUF012 - as torch has it
    has_enumerate_support = True

    def __init__(self, log_prob):
        self.values = log_prob
        super().__init__(log_prob.shape[1:], validate_args=False)

    def enumerate_support(self, expand=True):
        return torch.arange(len(self.values))[:, None].expand_as(self.values)

    def log_prob(self, value):
        return self.values.gather(0, value)


@settings(deadline=None, max_examples=80)
@given(
    st.integers(2, 10).flatmap(
        lambda classes: st.lists(
            st.lists(
                st.sampled_from([0.0, 1e-8, 1.0, -3.0, 40.0, 1e4, -1e4]) | st.floats(-1e4, 1e4),
                min_size=classes,
                max_size=classes,
            ),
            max_size=6,
        ).map(lambda rows: np.array(rows, dtype=np.float64).reshape(len(rows), classes))
    ),
    st.sampled_from([torch.float32, torch.float64]),
)
def test_are_the_softmax_of_any_logits_and_sum_to_one(logits, dtype):
    given_logits = torch.tensor(logits, dtype=dtype)
    found = class_probabilities(categorical(given_logits))
    assert found.shape == logits.shape and found.dtype == torch.float64
    assert ((found >= 0) & (found <= 1)).all()
    np.testing.assert_allclose(found.sum(-1), 1, rtol=0, atol=1e-15)
    # torch rounds logits of 1e4 less their log-sum-exp to float32: 5e-4 of each probability, the same of all
    wanted = special.softmax(given_logits.double().numpy(), -1)
    tolerance = 1e-6 if dtype == torch.float32 and np.abs(logits).max(initial=0) < 10 else 2e-3
    np.testing.assert_allclose(found, wanted, atol=1e-11 if dtype == torch.float64 else tolerance)


def test_a_mixture_averages_them():
    logits = torch.randn(7, 3, 4, generator=torch.Generator().manual_seed(0))
    weights = torch.randn(7, 3, generator=torch.Generator().manual_seed(1))
    wanted = (special.softmax(weights.double().numpy(), -1)[..., None] * special.softmax(logits, -1)).sum(1)
    for components in (categorical(logits), Stacked([categorical(logits[:, k]) for k in range(3)])):
        found = class_probabilities(Mixture(weights, components))
        np.testing.assert_allclose(found, wanted, atol=2e-7)
    folded = class_probabilities(Reshaped(categorical(logits.reshape(21, 4)), (7, 3)).density)
    np.testing.assert_allclose(folded.reshape(7, 3, 4), special.softmax(logits, -1), atol=2e-7)


def test_a_mixture_of_certain_components_never_exceeds_one():
    found = class_probabilities(
        Mixture(torch.randn(50, 9), categorical(torch.tensor([200.0, 0, 0]).expand(50, 9, 3)))
    )
    assert (found[:, 0] == 1).all() and (found[:, 1:] < 1e-80).all()


def test_probabilities_of_exactly_zero_and_one_stay():
    density = categorical(torch.tensor([[0.0, -torch.inf], [-torch.inf, 0.0]]))
    assert class_probabilities(density).tolist() == [[1.0, 0.0], [0.0, 1.0]]


def test_nothing_has_no_rows():
    assert class_probabilities(categorical(torch.zeros(0, 3))).shape == (0, 3)


def test_a_density_that_lists_no_classes_is_refused():
    density = Independent(Normal(torch.zeros(4, 2), 1.0), 1)
    with pytest.raises(
        UserError, match=r"predicts a Independent with event_shape \(2,\).*density_head=categorical"
    ):
        class_probabilities(density)


def test_nan_is_named_with_its_row():
    logits = torch.zeros(6, 3)
    logits[4, 1] = torch.nan
    with pytest.raises(UserError, match=r"1 of 6 predicted distributions over classes .* NaN, .* row 4"):
        class_probabilities(categorical(logits))


def test_probabilities_that_do_not_sum_to_one_are_refused():
    log_prob = torch.log(torch.tensor([[0.5, 0.7], [0.5, 0.7]]))
    with pytest.raises(UserError, match=r"1 of 2 .* row 1 sums to 1\.4"):
        class_probabilities(Listed(log_prob))
    with pytest.raises(UserError, match="row 0 sums to 0"):
        class_probabilities(Listed(torch.full((2, 1), -torch.inf)))


GENERIC = {
    "mixture": {"components": 2},
    "uniform_floor": {},
    "cvae": {"samples": 2, "training_samples": 2},
    "scvae": {"samples": 2, "training_samples": 2},
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "chain", [chain for depth in (1, 2) for chain in product(GENERIC, repeat=depth)], ids="-".join
)
def test_few_draws_leave_probabilities_that_sum_to_one(chain, dtype):
    config = {"name": "categorical"}
    for name in reversed(chain):
        config = {"name": name, **GENERIC[name], "component": config}
    head = build("density_head", resolve("density_head", config), target=Target("class", ("a", "b", "c")))
    torch.manual_seed(0)
    # far from what is drawn every class may be so unlikely that its probability is not float64
    raw = 3 * torch.randn(20, head.size, dtype=dtype)
    with torch.no_grad():
        found = class_probabilities(head.to(dtype)(raw))
    assert found.shape == (20, 3) and (found >= 0).all()
    np.testing.assert_allclose(found.sum(-1), 1, rtol=0, atol=1e-15)


def test_labels_that_are_no_class_are_refused():
    label = torch.tensor([0, 2, 1])
    assert require_labels(label, 3) is label
    with pytest.raises(DataError, match=r"1 of 3 targets .* row 1 is 2, but class indices go from 0 to 1"):
        require_labels(label, 2)
    with pytest.raises(DataError, match="row 0 is -1"):
        require_labels(torch.tensor([-1]), 2)


def test_refuse_nan_passes_everything_else():
    values = torch.tensor([0.0, torch.inf, -torch.inf])
    assert refuse_nan(values, "numbers") is values
    assert len(refuse_nan(values[:0], "numbers")) == 0
    with pytest.raises(UserError, match=r"2 of 3 numbers in this batch are NaN, the first in row 1"):
        refuse_nan(torch.tensor([0.0, torch.nan, torch.nan]), "numbers")
