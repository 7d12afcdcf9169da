import math
from contextlib import suppress
from functools import partial

import pytest
import torch
from torch import nn
from torch.distributions import Independent, Normal

from framework.calibration.validation import predict_densities
from framework.configuration.registry import installed
from framework.configuration.schema import build, resolve
from framework.distributions.density import Mixture
from framework.distributions.tempering import temper
from framework.errors import ConfigError
from framework.model import Model
from framework.storage.weights import describe_mismatch
from framework.target import Target
from framework.testing.plain import Plain
from framework.uncertainty import held_out
from plugins.uncertainty.folds.chain import NARROW, ROWS, Chain, build_chain
from plugins.uncertainty.folds.groups import Apart, Together
from plugins.uncertainty.folds.training import Training, assign_folds
from plugins.uncertainty.folds.wrapper import PSEUDO, fit_log_weights, fit_model_share, pool_temperature

TARGET = Target("real", ("y",), location=(3.0,), scale=(2.0,))
SHORT = {"folds": 3, "steps": 40, "epochs": 1}


def model(target=TARGET, name="student_t", width=16, **settings):
    encoder = build(
        "encoder",
        resolve("encoder", {"name": "mlp", "widths": [width], "activation": "silu"}),
        input_shape=(2,),
    )
    return Model(
        [encoder], build("density_head", resolve("density_head", {"name": name, **settings}), target=target)
    )


def folds(build_model=model, **config):
    torch.manual_seed(0)
    return build(
        "uncertainty",
        resolve("uncertainty", {"name": "folds", **SHORT, **config}),
        model=build_model,
        target=TARGET,
    )


def table(count=120):
    generator = torch.Generator().manual_seed(1)
    inputs = torch.randn(count, 2, generator=generator)
    noise = 0.2 * torch.randn(count, generator=generator)
    return inputs, (3 + 2 * inputs[:, 0].sin() + noise).double().unsqueeze(1)


def test_a_short_test_run_takes_at_most_its_steps():
    wrapper, (inputs, target) = folds(), table()
    trained = {"seed": 0, "batch_size": 16}
    expected = folds(steps=3).train_models(inputs, target, **trained, most_steps=3)
    assert wrapper.train_models(inputs, target, **trained, most_steps=3) == expected
    assert wrapper.train_models(inputs, target, **trained) < expected


def test_each_sample_is_predicted_by_models_that_did_not_see_it():
    wrapper, (inputs, target) = folds(), table()
    loss = wrapper.train_models(inputs, target, seed=0, batch_size=16)
    rows = torch.arange(len(inputs))
    batch = {"input": inputs, "target": target, "row": rows}
    (density,) = predict_densities(wrapper, [batch])
    assert density.log_prob(target).mean().item() == pytest.approx(-loss, rel=1e-6)
    with torch.no_grad():  # as in predictions, whose products are computed in another order
        groups = wrapper.models.densities(inputs)
    expected = torch.stack([part.log_prob(target.unsqueeze(1))[rows, wrapper._fold] for part in groups], 1)
    torch.testing.assert_close(density.log_prob(target), torch.logsumexp(expected + wrapper.log_weights, 1))
    whole = torch.stack([part.log_prob(target.unsqueeze(1)).logsumexp(1) - math.log(3) for part in groups], 1)
    with torch.no_grad():
        mixture = wrapper(inputs)
    torch.testing.assert_close(mixture.log_prob(target), torch.logsumexp(whole + wrapper.log_weights, 1))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_predictions_without_gradient_are_those_of_training(dtype):
    """Both kinds of products, and samples in one block, in full blocks and in a block that is not full."""
    for outputs in (1, 2, NARROW - 1, NARROW):
        networks = [nn.Sequential(nn.Linear(3, 20), nn.SiLU(), nn.Linear(20, outputs)) for _ in range(2)]
        chain = Chain([network.to(dtype) for network in networks], [None])
        for samples in (0, 1, ROWS, 2 * ROWS + 1):
            inputs = torch.randn(samples, 3, dtype=dtype)
            with torch.no_grad():
                predicted = chain(inputs)
            expected = torch.stack([network(inputs) for network in networks])
            torch.testing.assert_close(chain(inputs), expected)
            torch.testing.assert_close(predicted, expected)


def test_gradients_of_a_sample_reach_no_model_that_predicts_it_held_out():
    wrapper, (inputs, target) = folds(), table()
    fold = assign_folds(inputs, 3)
    training = Training(wrapper.models, inputs, target, fold, 3, wrapper.schedule)
    for step in range(training.batches):
        for member, rows in enumerate(training._batch(step)):
            assert (fold[rows] != member % 3).all()


def test_the_same_seed_gives_the_same_bits_and_leaves_the_generator_alone():
    inputs, target = table()
    states = []
    for _ in range(2):
        wrapper = folds()
        before = torch.get_rng_state()
        wrapper.train_models(inputs, target, seed=5, batch_size=16)
        assert torch.equal(torch.get_rng_state(), before)
        states.append(wrapper.state_dict())
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])


@pytest.mark.parametrize("dropout", [[None, 0.0], [0.3]])
def test_chains_train_as_separate_models_do(dropout):
    """Compare the gradients of stacked layers with those of the models themselves, without dropout."""
    models = [model() for _ in range(2 * len(dropout))]
    networks = [nn.Sequential(part.encoders, part.projection) for part in models]
    chain = build_chain(networks, dropout)
    assert chain is not None
    together, separate = Together(chain.eval(), models[0].head, len(dropout)), Apart(models, dropout).eval()
    inputs, target = table(len(models) * 5)
    parts = inputs.unflatten(0, (len(models), 5)), target.unflatten(0, (len(models), 5))
    losses = [group.losses(*parts) for group in (together, separate)]
    torch.testing.assert_close(*losses)
    for loss in losses:
        loss.sum().backward()
    for number, network in enumerate(networks):
        linear = [layer for layer in network.modules() if isinstance(layer, nn.Linear)]
        for weight, bias, layer in zip(chain.weights, chain.biases, linear, strict=True):
            torch.testing.assert_close(weight.grad[number].T, layer.weight.grad)
            torch.testing.assert_close(bias.grad[number, 0], layer.bias.grad)


def test_dropout_has_the_probability_of_each_group():
    networks = [nn.Sequential(nn.Linear(1, 4000), nn.Dropout(0.5), nn.Identity()) for _ in range(4)]
    chain = build_chain(networks, [None, 0.1])
    for layer in (chain.weights, chain.biases):
        layer[0].data.fill_(1.0)
    out = chain.train()(torch.zeros(2, 1))
    shares = (out == 0).float().mean((1, 2))
    assert shares.tolist() == pytest.approx([0.5, 0.5, 0.1, 0.1], abs=0.03)
    assert out.mean().item() == pytest.approx(1, abs=0.02)
    assert (chain.eval()(torch.zeros(2, 1)) == 1).all()


def test_networks_that_compute_something_else_are_not_stacked():
    class Doubling(nn.Module):
        def __init__(self):
            super().__init__()
            self.layers = nn.Sequential(nn.Linear(2, 2))

        def forward(self, inputs):
            return 2 * self.layers(inputs)

    assert build_chain([Doubling(), Doubling()], [None]) is None
    assert build_chain([nn.Sequential(nn.Conv1d(1, 1, 1))] * 2, [None]) is None
    assert isinstance(folds(lambda: Plain(TARGET)).models, Apart)


@pytest.mark.parametrize("head", ["student_t", "gaussian"])
def test_other_models_train_too(head):
    inputs, target = torch.randn(60, 6), torch.randn(60, 1)
    wrapper = folds(lambda: Plain(TARGET)) if head == "gaussian" else folds(lambda: model(name=head))
    inputs = inputs if head == "gaussian" else inputs[:, :2]
    before = [parameter.clone() for parameter in wrapper.parameters()]
    assert math.isfinite(wrapper.train_models(inputs, target, seed=0, batch_size=16))
    assert all(not torch.equal(*pair) for pair in zip(before, wrapper.parameters(), strict=True))
    assert wrapper(inputs).log_prob(target).isfinite().all()


def test_training_improves_the_likelihood_and_calibrates_the_head():
    inputs, target = table(300)
    wrapper = folds(steps=400)
    before = wrapper(inputs).log_prob(target).mean()
    wrapper.train_models(inputs, target, seed=0, batch_size=32)
    new_inputs, new_target = table(600)
    after = wrapper(new_inputs[300:]).log_prob(new_target[300:]).mean()
    assert after > before + 1
    assert any(head.factor.item() != 1 for head in wrapper.models.heads)
    assert "log-likelihood" in wrapper.remark and "weights of the groups" in wrapper.remark


def test_equal_inputs_are_in_the_same_fold():
    torch.manual_seed(0)
    inputs = torch.randn(50, 3).repeat(4, 1)
    fold = assign_folds(inputs, 5).view(4, 50)
    assert (fold == fold[0]).all() and torch.bincount(fold[0]).tolist() == [10] * 5
    few = assign_folds(torch.zeros(40, 2), 5)
    assert torch.bincount(few).tolist() == [8] * 5


def test_weights_of_groups_have_the_highest_likelihood():
    log_prob = torch.tensor([[-1.0, -3.0]] * 30 + [[-3.0, -1.0]] * 10, dtype=torch.float64)
    weights = fit_log_weights(log_prob).exp()
    assert weights.sum().item() == pytest.approx(1)
    first = weights[0].item()
    totals = []
    for weight in (first - 0.03, first, first + 0.03):
        both = torch.tensor([weight, 1 - weight], dtype=torch.float64).log()
        totals.append((torch.logsumexp(log_prob + both, 1).sum() + PSEUDO * both.sum()).item())
    assert totals[1] > max(totals[0], totals[2])
    assert fit_log_weights(torch.tensor([[0.0, -math.inf]] * 50).double()).exp()[1] > 0


def simulated(share, groups=2, models=5, count=20_000):
    """Return the locations of calibrated models, (sample, group, model), and targets, (sample, 1)."""
    generator = torch.Generator().manual_seed(2)
    draws = torch.randn(count, 1 + groups * models, dtype=torch.float64, generator=generator)
    return math.sqrt(share) * draws[:, 1:].unflatten(1, (groups, models)), math.sqrt(1 - share) * draws[:, :1]


def normals(locations):
    return Independent(Normal(locations.unsqueeze(-1), torch.ones((*locations.shape, 1)).double()), 1)


def pool_of(locations, weights):
    models = locations.shape[-1]
    log_weights = (weights / models).log().repeat_interleave(models)
    return Mixture(log_weights.expand(len(locations), -1), normals(locations.flatten(1)))


@pytest.mark.parametrize("share", [0.0, 0.1, 0.3])
@pytest.mark.parametrize("weight", [0.5, 0.9])
def test_a_narrowed_mixture_is_as_wide_as_the_errors_of_its_mean(share, weight):
    """Compare the variance of mixtures with the squared errors of their means, which are drawn."""
    locations, target = simulated(share)
    weights = torch.tensor([weight, 1 - weight]).double()
    temperature = pool_temperature(torch.tensor(share).double(), weights.log(), 5)
    pool = temper(pool_of(locations, weights), temperature)
    assert pool.variance.mean().item() == pytest.approx((target - pool.mean).square().mean().item(), rel=0.03)


def test_one_model_is_not_narrowed():
    assert pool_temperature(torch.tensor(0.3).double(), torch.zeros(1).double(), 1) == 1
    assert pool_temperature(torch.tensor(0.0).double(), torch.tensor([0.5, 0.5]).double().log(), 5) == 1


@pytest.mark.parametrize("groups", [2, 3])
def test_the_share_of_the_models_follows_from_left_out_samples(groups):
    locations, target = simulated(0.2, groups)
    several = [
        Mixture(torch.zeros(len(target), 1).double(), normals(part[:, :1])) for part in locations.unbind(1)
    ]
    share = fit_model_share([several], [{"target": target}])
    assert 0.14 < share < 0.22
    weights = torch.full((groups,), 1 / groups).double()
    wide = pool_of(locations, weights)
    narrow = temper(wide, pool_temperature(torch.tensor(share).double(), weights.log(), 5))
    assert narrow.log_prob(target).mean() > wide.log_prob(target).mean() + 0.02
    torch.manual_seed(0)
    covered = [
        (density.log_prob(density.sample((100,))) >= density.log_prob(target))
        .double()
        .mean(0)
        .le(0.9)
        .double()
        .mean()
        for density in (wide, narrow)
    ]
    assert covered[0] > 0.94 and abs(covered[1] - 0.9) < 0.02


def test_models_that_agree_and_widths_that_are_wrong_do_not_narrow_the_mixture():
    locations, target = simulated(0.0)
    several = [
        Mixture(torch.zeros(len(target), 1).double(), normals(part[:, :1])) for part in locations.unbind(1)
    ]
    for factor in (1.0, 0.7, 1.3):  # the models are calibrated, too wide, or too narrow
        assert fit_model_share([several], [{"target": factor * target}]) == pytest.approx(0, abs=1e-9)


def test_a_loaded_mixture_is_as_narrow_as_the_stored_one():
    inputs, target = table(300)
    wrapper = folds(steps=200, sharpen=True)
    wrapper.train_models(inputs, target, seed=0, batch_size=32)
    assert wrapper.model_share > 0 and "The mixture of all models has the temperature" in wrapper.remark
    loaded = folds(steps=200, sharpen=True).eval()
    loaded.load_state_dict(wrapper.state_dict())
    log_prob = wrapper(inputs).log_prob(target)
    assert torch.equal(loaded(inputs).log_prob(target), log_prob)
    wide = folds(steps=200)
    wide.train_models(inputs, target, seed=0, batch_size=32)
    assert wide.model_share == 0 and not torch.equal(wide(inputs).log_prob(target), log_prob)


def test_every_head_of_a_number_is_narrowed_or_says_why_not():
    inputs, target = table(60)
    remarks = {}
    with_components = [{"name": name, "component": {"name": "gaussian"}} for name in ("mixture", "cvae")]
    for head in [*({"name": name} for name in installed("density_head")), *with_components]:
        with suppress(ConfigError):  # heads of other targets
            wrapper = folds(partial(model, **head), steps=5, sharpen=True)
            wrapper.train_models(inputs, target, seed=0, batch_size=32)
            remarks[head["name"]] = wrapper.remark
            assert wrapper.eval()(inputs).log_prob(target).isfinite().all()
    assert remarks.keys() >= {"gaussian", "student_t", "evidential", "quantiles", "mixture", "cvae"}
    for name, remark in remarks.items():
        words = "the powers of its densities are not known" if name == "quantiles" else "has the temperature"
        assert words in remark, name


def test_mixtures_that_are_not_narrowed_say_why():
    inputs, target = table()
    wrapper = folds(dropout=[0.1], weight_decay=[0.1], sharpen=True)
    wrapper.train_models(inputs, target, seed=0, batch_size=32)
    assert "has one group of models, and two are needed" in wrapper.remark
    both = Target("class", ("a", "b"))
    resolved = resolve("uncertainty", {"name": "folds", **SHORT, "sharpen": True})
    classes = build("uncertainty", resolved, model=lambda: model(both, "categorical"), target=both)
    classes.train_models(inputs, (target[:, 0] > 3).long(), seed=0, batch_size=32)
    assert "its target is of kind class, not real" in classes.remark and classes.model_share == 0


def test_a_state_without_the_share_of_the_models_loads_and_predicts_as_before():
    """States of versions before `sharpen` have no such number, and their configs do not have the setting."""
    inputs, target = table(300)
    wrapper = folds(steps=200)
    wrapper.train_models(inputs, target, seed=0, batch_size=32)
    groups = wrapper.models.densities(inputs)
    each = torch.stack([part.log_prob(target.unsqueeze(1)).logsumexp(1) - math.log(3) for part in groups], 1)
    before = torch.logsumexp(each + wrapper.log_weights, 1)
    state = {name: value for name, value in wrapper.state_dict().items() if name != "model_share"}
    loaded = folds().eval()
    loaded.load_state_dict(state)
    assert describe_mismatch(loaded.state_dict(), state) is None
    torch.testing.assert_close(loaded(inputs).log_prob(target), before)


def test_samples_that_are_nearly_impossible_are_reported():
    inputs, target = table()
    target[11] += 1e9
    wrapper = folds(lambda: model(name="gaussian"))
    wrapper.train_models(inputs, target, seed=0, batch_size=16)
    assert (
        "1 of these samples are more than 20 nats less likely" in wrapper.remark
        and "sample 11" in wrapper.remark
    )


def test_wrong_settings_are_refused():
    with pytest.raises(ConfigError, match="each needs one number for each group"):
        folds(dropout=[0.1])
    with pytest.raises(ConfigError, match="needs at least 6 samples"):
        folds().train_models(*table(5), seed=0, batch_size=16)


def test_held_out_is_reset_after_an_error():
    wrapper = folds()
    with pytest.raises(RuntimeError), held_out(wrapper, {"row": torch.zeros(1)}):
        raise RuntimeError
    assert wrapper.rows is None


def test_wrappers_around_it_are_calibrated_on_held_out_predictions():
    inputs, target = table()
    parts = [{"name": "temperature"}, {"name": "conformal", "miscoverage": 0.2}]
    target_class = Target("class", ("a", "b"))
    labels = (target[:, 0] > 3).long()
    classes = build(
        "uncertainty",
        resolve("uncertainty", {"name": "folds", **SHORT}),
        model=lambda: model(target_class, "categorical"),
        target=target_class,
    )
    classes.train_models(inputs, labels, seed=0, batch_size=16)
    inner = build("uncertainty", resolve("uncertainty", parts[0]), model=lambda: classes, target=target_class)
    outer = build(
        "uncertainty", resolve("uncertainty", parts[1]), model=lambda: inner, target=target_class
    ).eval()
    batch = {"input": inputs, "target": labels}
    thresholds = []
    for rows in ({"row": torch.arange(len(inputs))}, {}):
        outer.calibrate([{**batch, **rows}])
        thresholds.append(outer.threshold.item())
    assert thresholds[0] != thresholds[1]  # the second is fitted to samples that the models have seen
    with held_out(outer, {"row": torch.arange(len(inputs))}):
        log_prob = outer(inputs).log_prob(labels)
    assert not torch.equal(log_prob, outer(inputs).log_prob(labels))
