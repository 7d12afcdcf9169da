import copy

import pytest
import torch
from torch import nn
from torch.distributions import Categorical

from framework.calibration.equal_mixture import equal_mixture
from framework.configuration.schema import build, resolve
from framework.density_head import DensityHead
from framework.distributions.density import Mixture
from framework.errors import ConfigError, UserError
from framework.model import Model, Predictor
from framework.target import Target
from framework.uncertainty import own_batches
from plugins.uncertainty.members.ensemble import Ensemble, network
from plugins.uncertainty.members.side_by_side import SideBySide

CLASSES = Target("class", ("a", "b", "c"))
ANGLE = Target("angle", ("azimuth",))


def factory(head="categorical", target=CLASSES, encoder=None, shape=(4,)):
    """Return a function that builds a fresh model at each call, as the framework does."""
    encoder = resolve("encoder", encoder or {"name": "mlp", "widths": [16, 16]})
    config = resolve("density_head", head)

    def model() -> Predictor:
        built = build("encoder", encoder, input_shape=shape)
        return Model([built], build("density_head", config, target=target))

    return model


def ensemble(members=3, seed=0, **kind):
    torch.manual_seed(seed)
    return Ensemble(factory(**kind), members=members)


def members_of(wrapper, **kind):
    """Return each member as a model of its own."""
    members = []
    for index in range(wrapper.model_count):
        model = factory(**kind)()
        network(model).load_state_dict(wrapper.together.read(index))
        head = wrapper.heads[min(index, len(wrapper.heads) - 1)]
        model.head.load_state_dict(head.state_dict())
        members.append(model.train(wrapper.training))
    return members


def data(target=CLASSES, count=64):
    generator = torch.Generator().manual_seed(1)
    inputs = torch.randn(count, 4, generator=generator)
    if target.kind == "class":
        return inputs, torch.randint(len(target.names), (count,), generator=generator)
    return inputs, torch.randn(count, 1, generator=generator)


def train(predictor, optimizer, inputs, target, steps=40):
    for step in range(steps):
        rows = slice(step % 4 * 16, step % 4 * 16 + 16)
        optimizer.zero_grad()
        predictor.loss(inputs[rows], target[rows]).mean().backward()
        optimizer.step()


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-4), (torch.float64, 1e-11)])
@pytest.mark.parametrize(
    "make",
    [
        lambda parameters: torch.optim.SGD(parameters, lr=0.1, momentum=0.9),
        lambda parameters: torch.optim.Adam(parameters, lr=1e-2),
        lambda parameters: torch.optim.AdamW(parameters, lr=1e-2, weight_decay=0.1),
    ],
    ids=["sgd", "adam", "adamw"],
)
@pytest.mark.parametrize(
    "kind",
    [{"head": "categorical"}, {"head": "von_mises", "target": ANGLE}, {"head": "scvae", "target": ANGLE}],
    ids=["categorical", "von_mises", "scvae"],
)
def test_each_member_becomes_what_it_becomes_alone(kind, make, dtype, tolerance):
    """Compare with single models of the same start and batches.

    Heads with weights of their own (scvae) draw random numbers; for them the test only checks that the weights change.
    """
    inputs, target = data(kind.get("target", CLASSES))
    inputs = inputs.to(dtype)
    target = target if target.dtype == torch.int64 else target.to(dtype)
    whole = ensemble(3, **kind).to(dtype)
    alone = [model.to(dtype) for model in members_of(whole, **kind)]
    started = copy.deepcopy(whole.together)
    train(whole, make(whole.parameters()), inputs, target)
    assert not torch.equal(whole.together.read(0)["1.weight"], started.read(0)["1.weight"])
    if kind["head"] == "scvae":
        for head, model in zip(whole.heads, alone, strict=True):
            begun = model.head.state_dict()
            assert all(not torch.equal(value, begun[name]) for name, value in head.named_parameters())
        return
    for index, model in enumerate(alone):
        train(model, make(model.parameters()), inputs, target)
        for name, parameter in network(model).named_parameters():
            torch.testing.assert_close(
                whole.together.read(index)[name], parameter, rtol=tolerance, atol=tolerance
            )


ANOTHER = {"name": "mlp", "widths": [16, 16], "batch_norm": True}


@pytest.mark.parametrize("clip", [None, 0.02])
@pytest.mark.parametrize(
    "kind",
    [
        {"head": "categorical"},
        {"head": "cvae", "target": ANGLE},
        {"head": "categorical", "encoder": ANOTHER},
    ],
    ids=["side by side", "heads with weights", "one after the other"],
)
def test_each_member_reads_its_own_batches_and_clips_its_own_gradient(kind, clip):
    """Compare with a single model on a member's rows, whose gradient torch clips."""
    inputs, target = (
        field.to(torch.float64) if field.is_floating_point() else field
        for field in data(kind.get("target", CLASSES))
    )
    whole = ensemble(3, **kind).double()
    if whole.together is None:
        alone = copy.deepcopy(list(whole.apart))
    else:
        alone = [model.double() for model in members_of(whole, **kind)]
        for index, model in enumerate(alone):
            model.head.load_state_dict(whole.heads[min(index, len(whole.heads) - 1)].state_dict())
    rows = [torch.randperm(64, generator=torch.Generator().manual_seed(seed))[:16] for seed in range(3)]
    torch.manual_seed(0)
    with own_batches(whole):
        joint_losses = whole.loss(inputs[torch.cat(rows)], target[torch.cat(rows)])
    joint_losses.mean().backward()
    losses = []
    torch.manual_seed(0)
    for model, some in zip(alone, rows, strict=True):
        losses.append(model.loss(inputs[some], target[some]))
        losses[-1].mean().backward()
    torch.testing.assert_close(joint_losses, torch.cat(losses), rtol=1e-12, atol=1e-12)
    if clip is not None:
        whole.clip_each_model(clip)
        for model in alone:
            nn.utils.clip_grad_norm_(model.parameters(), clip)
    for index, model in enumerate(alone):
        if whole.together is None:
            gradients = [parameter.grad for parameter in whole.apart[index].parameters()]
        else:
            gradients = [parameter.grad[index] for parameter in whole.together.parameters()]
            gradients += (
                [parameter.grad for parameter in whole.heads[index].parameters()]
                if len(whole.heads) > 1
                else []
            )
        wanted = [parameter.grad for parameter in model.parameters()]
        for mine, theirs in zip(gradients, wanted, strict=True):
            torch.testing.assert_close(mine, theirs, rtol=1e-9, atol=1e-12)
    assert not any(wrapper.own_batches for wrapper in whole.modules() if isinstance(wrapper, Ensemble))


def test_members_start_as_models_built_one_after_the_other():
    """Check that the first member equals the single model with that seed."""
    whole = ensemble(3, seed=5)
    torch.manual_seed(5)
    for index in range(3):
        model = factory()()
        for name, parameter in network(model).named_parameters():
            assert torch.equal(whole.together.read(index)[name], parameter)


@pytest.mark.parametrize(
    "kind",
    [
        {"head": "categorical"},
        {"head": "von_mises", "target": ANGLE},
        {"head": {"name": "von_mises", "concentration": "fixed"}, "target": ANGLE},
    ],
    ids=["no state", "no state, angle", "heads with buffers"],
)
def test_the_density_is_the_mean_of_the_members_densities(kind):
    inputs, target = data(kind.get("target", CLASSES))
    whole = ensemble(3, **kind).eval()
    whole.calibrate([{"input": inputs, "target": target}])
    with torch.no_grad():
        probability = whole(inputs).log_prob(target).exp()
        parts = [model(inputs).log_prob(target).exp() for model in members_of(whole, **kind)]
        torch.testing.assert_close(probability, torch.stack(parts).mean(0), rtol=1e-5, atol=1e-7)
        whole.members = 2
        torch.testing.assert_close(
            whole(inputs).log_prob(target).exp(), torch.stack(parts[:2]).mean(0), rtol=1e-5, atol=1e-7
        )


def test_members_calibrate_each_for_itself():
    kind = {"head": {"name": "von_mises", "concentration": "fixed"}, "target": ANGLE}
    inputs, target = data(ANGLE)
    whole = ensemble(2, **kind).eval()
    alone = members_of(whole, **kind)
    batch = {"input": inputs, "target": target}
    whole.calibrate([batch])
    for index, model in enumerate(alone):
        model.eval().calibrate([batch])
        for name, value in model.head.state_dict().items():
            torch.testing.assert_close(whole.heads[index].state_dict()[name], value)


def test_the_loss_is_the_mean_and_its_gradient_each_members_own():
    inputs, target = data()
    whole = ensemble(3)
    alone = members_of(whole)
    loss = whole.loss(inputs, target)
    torch.testing.assert_close(loss, torch.stack([member.loss(inputs, target) for member in alone]).mean(0))
    loss.mean().backward()
    for index, model in enumerate(alone):
        model.loss(inputs, target).mean().backward()
        grown = dict(network(model).named_parameters())
        for name, parameter in whole.together.stacked.named_parameters():
            torch.testing.assert_close(parameter.grad[index], grown[name].grad, rtol=1e-4, atol=1e-7)


def test_each_member_drops_other_outputs():
    encoder = {"name": "mlp", "widths": [64], "dropout": 0.5}
    torch.manual_seed(0)
    whole = SideBySide([network(factory(encoder=encoder)())] * 4).train()  # four times one network
    outputs = whole(torch.ones(2, 4))
    assert len({tuple(row) for row in outputs.detach().flatten(0, 1).tolist()}) == 8
    whole.eval()
    same = whole(torch.ones(2, 4)).detach()
    assert torch.equal(same[:, :1].expand_as(same), same)


def test_dropout_of_the_members_can_be_active_where_all_else_evaluates():
    """Check dropout as MC dropout around an ensemble uses it."""
    torch.manual_seed(0)
    whole = SideBySide(
        [network(factory(encoder={"name": "mlp", "widths": [64], "dropout": 0.5})())] * 2
    ).eval()
    still = whole(torch.ones(2, 4))
    assert torch.equal(still[:, 0], still[:, 1])
    for module in whole.modules():
        if isinstance(module, torch.nn.Dropout):
            module.train()
    assert not torch.equal(whole(torch.ones(2, 4))[:, 0], whole(torch.ones(2, 4))[:, 1])


def test_networks_that_do_not_vectorise_are_computed_one_after_the_other():
    encoder = {"name": "mlp", "widths": [8], "batch_norm": True}
    whole = ensemble(2, encoder=encoder).eval()
    assert whole.together is None
    inputs, target = data()
    with torch.no_grad():
        parts = torch.stack([member(inputs).log_prob(target).exp() for member in whole.apart])
        torch.testing.assert_close(whole(inputs).log_prob(target).exp(), parts.mean(0))
        assert whole.training_densities(inputs).batch_shape == (64, 2)
    whole.train().loss(inputs, target).mean().backward()
    assert all(parameter.grad is not None for parameter in whole.parameters())


class Reading(DensityHead):
    """A head that holds all trained parameters and reads features unchanged."""

    direct = True
    size = 4

    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(4, 3)

    def forward(self, raw):
        return Categorical(logits=self.layer(raw))

    def loss(self, raw, target):
        return -self(raw).log_prob(target)

    def calibrate(self, raw, target):
        raise AssertionError


def test_heads_that_learn_all_there_is_are_mixed_too():
    inputs, target = data()
    wrapper = Ensemble(lambda: Model([], Reading(), (4,)), members=3)
    assert wrapper.together is None
    train(wrapper, torch.optim.SGD(wrapper.parameters(), 0.1), inputs, target)
    density = wrapper.eval()(inputs)
    alone = torch.stack([member(inputs).probs for member in wrapper.apart])
    assert (alone.std(0) > 1e-3).any()
    torch.testing.assert_close(density.log_prob(target).exp(), alone.mean(0).gather(1, target[:, None])[:, 0])


@pytest.mark.parametrize("batch_norm", [False, True], ids=["together", "apart"])
def test_a_member_that_is_not_finite_is_named(batch_norm):
    whole = ensemble(3, encoder={"name": "mlp", "widths": [8], "batch_norm": batch_norm}).eval()
    with torch.no_grad():
        if batch_norm:
            whole.apart[1].projection.bias.fill_(torch.nan)
        else:
            bad = whole.together.read(1)
            whole.together.write(1, {**bad, "1.bias": torch.full_like(bad["1.bias"], torch.nan)})
        with pytest.raises(UserError, match="Member 1 of 3"):
            whole(data()[0])
        whole.members = 1  # only the first member is finite
        assert whole(data()[0]).log_prob(data()[1]).isfinite().all()


@pytest.mark.parametrize("batch_norm", [False, True], ids=["together", "apart"])
@pytest.mark.parametrize("head", ["categorical", {"name": "von_mises", "concentration": "fixed"}])
def test_joins_models_that_were_trained_apart(batch_norm, head):
    target = CLASSES if head == "categorical" else ANGLE
    kind = {
        "head": head,
        "target": target,
        "encoder": {"name": "mlp", "widths": [8], "batch_norm": batch_norm},
    }
    inputs, labels = data(target)
    torch.manual_seed(3)
    models = [factory(**kind)().eval() for _ in range(3)]
    for model in models[1:]:
        model.calibrate([{"input": inputs, "target": labels}])
    whole = ensemble(3, **kind).eval()
    whole.join(models)
    with torch.no_grad():
        parts = torch.stack([model(inputs).log_prob(labels).exp() for model in models])
        torch.testing.assert_close(whole(inputs).log_prob(labels).exp(), parts.mean(0))
    with pytest.raises(ConfigError, match="Got 2 members"):
        whole.join(models[:2])


def test_refuses_more_members_than_were_trained():
    whole = ensemble(2).eval()
    for wrong in (0, 3):
        whole.members = wrong
        with pytest.raises(ConfigError, match="from 1 to 2"):
            whole(data()[0])
    with pytest.raises(ConfigError, match=r"uncertainty\.members"):
        resolve("uncertainty", {"name": "ensemble", "members": 0})


def test_an_ensemble_of_one_is_trained_like_the_model():
    inputs, target = data()
    whole = ensemble(1, seed=2)
    torch.manual_seed(2)
    model = factory()()
    for predictor in (whole, model):
        train(predictor, torch.optim.Adam(predictor.parameters(), lr=1e-2), inputs, target)
    assert torch.equal(whole(inputs).log_prob(target), model(inputs).log_prob(target))
    assert not isinstance(whole(inputs), Mixture)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
@pytest.mark.parametrize("members", [1, 3, 50])
def test_equal_weights_sum_to_one_in_any_precision(dtype, members):
    components = Categorical(logits=torch.zeros(2, members, 3), validate_args=False)
    mixed = equal_mixture(components, nn.Linear(1, 1).to(dtype), torch.device("cpu"))
    assert mixed.log_weights.dtype == (torch.float64 if dtype == torch.float64 else torch.float32)
    log_prob = mixed.log_prob(torch.zeros(2, dtype=torch.int64))
    torch.testing.assert_close(log_prob.float(), torch.full((2,), -1.0986123), rtol=0, atol=1e-6)
