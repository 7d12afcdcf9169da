"""Optimisers: all that a config can name, those of discriminators, and the result of one step."""

import copy
import math
from typing import Any, ClassVar, Literal

import pytest
import pytorch_lightning as pl
import torch
from pytorch_lightning.plugins.precision import MixedPrecision
from torch import Tensor, nn
from torch.distributions import Independent, Normal

from framework.configuration.assembly import assemble, build_predictor
from framework.configuration.schema import build, resolve
from framework.configuration.settings import OptimizerSettings, Settings
from framework.data import Batch
from framework.density_head import DensityHead
from framework.encoder import Encoder
from framework.errors import ConfigError
from framework.model import FrozenFrontEnd, Model, Predictor, one_pass
from framework.objective import AdversaryOptimizer, Objective
from framework.target import Target
from framework.testing.plain import LENGTH, Plain
from framework.training.batches import Batches
from framework.training.module import FUSED, OPTIMIZERS, LoadedBatches, Training
from framework.training.schedules import make_schedule, update_plateaus


@pytest.mark.parametrize("momentum", [None, 0.0, 0.9])
@pytest.mark.parametrize("name", ["adam", "adamw", "sgd", "nadam", "radam"])
def test_settings_reach_the_optimiser(
    monkeypatch: pytest.MonkeyPatch, name: str, momentum: float | None
) -> None:
    if momentum is not None and name != "sgd":
        with pytest.raises(
            ValueError, match=f"momentum is a setting of sgd only, and the optimiser is {name}"
        ):
            OptimizerSettings(name=name, momentum=momentum)
        return
    settings = OptimizerSettings(name=name, learning_rate=0.25, weight_decay=0.5, momentum=momentum)
    data = build("data", resolve("data", {"name": "moons"}))
    training = Training(Plain(Target("real", ("x",))), [], data, settings, 0, {})
    training.trainer = pl.Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    monkeypatch.setattr(training, "_planned_steps", lambda: (10, 5))
    made = training.configure_optimizers()["optimizer"]
    (group,) = made.param_groups
    assert type(made).__name__.lower() == name
    assert (group["initial_lr"], group["weight_decay"]) == (0.25, 0.5)
    assert group["params"] == list(training.parameters())
    if name == "sgd":
        assert group["momentum"] == (momentum or 0.0)


@pytest.mark.parametrize("patience", [1, 2, 5])
def test_plateau_reduces_when_torchs_does(patience: int) -> None:
    """torch's scheduler needs a patience of one less, since it reduces in the first epoch after its patience."""
    settings = OptimizerSettings(schedule="plateau", factor=0.5, patience=patience, learning_rate=0.25)
    ours, theirs = (torch.optim.SGD([nn.Parameter(torch.zeros(2))], lr=0.25) for _ in range(2))
    rates = torch.optim.lr_scheduler.LambdaLR(ours, [make_schedule(settings, 100, 4)])
    reference = torch.optim.lr_scheduler.ReduceLROnPlateau(
        theirs, factor=0.5, patience=patience - 1, threshold=0, eps=0
    )
    losses = torch.randint(20, (40,), generator=torch.Generator().manual_seed(patience)).double().tolist()
    for epoch, loss in enumerate(losses):
        for _ in range(4):
            ours.step()
            rates.step()
        update_plateaus(rates, loss, epoch + 1)
        reference.step(loss)
        assert ours.param_groups[0]["lr"] == theirs.param_groups[0]["lr"]
    assert 0 < ours.param_groups[0]["lr"] < 0.25


def test_step_reduces_after_the_epochs_that_it_names() -> None:
    """The learning rate equals that of torch's MultiStepLR by epochs."""
    settings = OptimizerSettings(schedule="step", factor=0.1, milestones=[2, 3], learning_rate=0.25)
    ours, theirs = (torch.optim.SGD([nn.Parameter(torch.zeros(2))], lr=0.25) for _ in range(2))
    rates = torch.optim.lr_scheduler.LambdaLR(ours, [make_schedule(settings, 20, 5)])
    reference = torch.optim.lr_scheduler.MultiStepLR(theirs, [2, 3], gamma=0.1)
    for step in range(20):
        assert ours.param_groups[0]["lr"] == pytest.approx(theirs.param_groups[0]["lr"], rel=1e-12)
        ours.step()
        rates.step()
        if step % 5 == 4:
            theirs.step()
            reference.step()
    with pytest.raises(ValueError, match="milestones is empty"):
        OptimizerSettings(schedule="step")
    with pytest.raises(
        ValueError, match="milestones are a setting of schedule=step only, and the schedule is plateau"
    ):
        OptimizerSettings(schedule="plateau", milestones=[3])


class Against(Objective):
    """Objective whose own weight is trained against the weight of the predictor."""

    bibtex = ""

    def __init__(self, schedule: Literal["constant", "cosine"]) -> None:
        super().__init__()
        self.own = nn.Parameter(torch.tensor([0.5, -1.0]))
        self.adversary_optimizer = AdversaryOptimizer(learning_rate=0.03, schedule=schedule)

    def forward(self, predictor: Predictor, batch: Batch) -> Tensor:
        weight = next(predictor.parameters())
        self.logged_terms = {"against": (self.own.square().sum() + weight.sum()).detach()}
        return (self.own.detach().sum() * weight).sum() + (
            self.own - weight.detach().mean()
        ).square().sum() * 50


@pytest.mark.parametrize("clip", [None, 0.7])
@pytest.mark.parametrize("schedule", ["constant", "cosine"])
def test_a_rival_steps_as_by_an_optimiser_of_its_own(
    monkeypatch: pytest.MonkeyPatch, clip: float | None, schedule: Literal["constant", "cosine"]
) -> None:
    """The steps are bit-equal to those of two optimisers of torch, stepped one after the other and clipped
    separately."""
    torch.manual_seed(0)
    data = build("data", resolve("data", {"name": "moons"}))
    predictor, objective = Plain(Target("real", ("x",))).eval(), Against(schedule)
    twins = copy.deepcopy((predictor, objective))
    settings = OptimizerSettings(name="adamw", learning_rate=0.01, weight_decay=0.1)
    training = Training(predictor, [objective], data, settings, 0, {})
    training.trainer = pl.Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    monkeypatch.setattr(training, "_planned_steps", lambda: (6, 3))
    made = training.configure_optimizers()
    first = torch.optim.AdamW(twins[0].parameters(), lr=0.01, weight_decay=0.1, fused=True)
    second = torch.optim.AdamW(
        twins[1].parameters(), lr=0.03, weight_decay=0.0, betas=(0.5, 0.999), fused=True
    )
    for step in range(5):
        given = torch.randn(4, LENGTH), torch.randn(4, 1)
        for pair, optimizers in (((predictor, objective), [made["optimizer"]]), (twins, [first, second])):
            for one in optimizers:
                one.zero_grad()
            (pair[0].loss(*given).mean() + pair[1](pair[0], {})).backward()
        if clip:
            training.configure_gradient_clipping(made["optimizer"], clip, "norm")
            for one in twins:
                nn.utils.clip_grad_norm_(one.parameters(), clip)
        if schedule == "cosine":
            second.param_groups[0]["lr"] = 0.03 * 0.5 * (1 + math.cos(math.pi * step / 6))
        for one in (made["optimizer"], first, second):
            one.step()
        made["lr_scheduler"]["scheduler"].step()
    for ours, theirs in zip((predictor, objective), twins, strict=True):
        for one, other in zip(ours.parameters(), theirs.parameters(), strict=True):
            assert torch.equal(one, other)


class Picture(Encoder):
    """Encoder that returns one number for each pixel, and counts its calls."""

    bibtex = ""

    def __init__(self) -> None:
        super().__init__()
        self.output_shape = (3, 2, 2)
        self.gain = nn.Parameter(torch.ones(()))
        self.calls = 0

    def forward(self, inputs: Tensor) -> Tensor:
        self.calls += 1
        return self.gain * inputs


class Flat(Encoder):
    """Numbers in a row."""

    bibtex = ""
    output_shape = (12,)

    def forward(self, inputs: Tensor) -> Tensor:
        return inputs.flatten(1)


class Whole(DensityHead):
    """The location of the Laplace density is the image itself."""

    bibtex = ""
    knobs: ClassVar = {}
    direct = True
    size = 12

    def forward(self, raw: Tensor) -> Independent:
        return Independent(Normal(raw.unflatten(-1, (3, 2, 2)).movedim(-3, -1), 1.0), 3)

    def loss(self, raw: Tensor, target: Tensor) -> Tensor:
        return -self(raw).log_prob(target)

    def calibrate(self, raw: Tensor, target: Tensor) -> None:
        pass


def test_a_direct_head_reads_what_the_encoder_gives_once_a_step() -> None:
    encoder = Picture()
    model = Model([encoder], Whole())
    inputs = torch.rand(5, 3, 2, 2)
    assert torch.equal(model(inputs).mean, inputs.movedim(1, -1))
    encoder.calls = 0
    with one_pass(model):
        loss = model.loss(inputs, inputs.movedim(1, -1)).sum() + model.training_densities(inputs).mean.sum()
        assert encoder.calls == 1
        model(inputs.clone())
        assert encoder.calls == 2
    loss.backward()
    assert encoder.gain.grad == inputs.sum()
    model(inputs)
    model(inputs)
    assert encoder.calls == 4
    with pytest.raises(ConfigError, match=r"gives 3×2×2 numbers, but Odd reads 13 numbers"):
        Model([encoder], type("Odd", (Whole,), {"size": 13})())


@pytest.mark.parametrize("wrapper", [None, "ensemble"])
@pytest.mark.parametrize("direct", [True, False])
def test_fixed_features_are_computed_once_a_step(direct: bool, wrapper: str | None) -> None:
    """Features are computed only once, also if several models read them."""
    reals = Target("real", ("x",))

    def inner() -> Predictor:
        if direct:
            return Model([Picture()], Whole())
        head: DensityHead = build("density_head", resolve("density_head", "gaussian"), target=reals)
        return Model([build("encoder", resolve("encoder", "mlp"), input_shape=(12,), input_columns=())], head)

    made = inner()
    if wrapper is not None:
        made = build("uncertainty", resolve("uncertainty", wrapper), model=inner, target=reals)
    first = Picture()
    front = FrozenFrontEnd([first] if direct else [first, Flat()], made)
    inputs = torch.rand(5, 3, 2, 2)
    with one_pass(front):
        front.loss(inputs, inputs.movedim(1, -1) if direct else torch.rand(5, 1))
        front.training_densities(inputs)
        assert first.calls == 1
        front(inputs.clone())
        assert first.calls == 2
    front(inputs)
    front(inputs)
    assert first.calls == 4


@pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning", "ignore:.*lr_scheduler.step:UserWarning")
@pytest.mark.parametrize("algorithm", ["norm", "value"])
@pytest.mark.parametrize("precision", ["32-true", "64-true", "bf16-mixed", "16-mixed"])
@pytest.mark.parametrize("members", [1, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", OPTIMIZERS)
def test_gradients_are_clipped_in_every_precision(
    name: str, members: int, precision: Any, algorithm: str
) -> None:
    """A step of SGD has the length of the clipped gradient; each other optimiser makes a step, fused if possible."""
    config = {
        "data": "moons",
        "encoder": {"mlp": {"name": "mlp", "widths": [8]}},
        "density_head": "bernoulli",
        "uncertainty": {"ensemble": {"name": "ensemble", "members": members}} if members > 1 else {},
    }
    resolved = assemble(Settings.of(config)).parts
    data = build("data", resolved["data"])
    data.prepare()
    most, rate = 1e-3, 0.5
    training = Training(
        build_predictor(resolved, data.target, (2,), 0),
        [],
        data,
        OptimizerSettings(name=name, learning_rate=rate, weight_decay=0.0),  # pyright: ignore[reportArgumentType]
        0,
        {},
    )
    before = [parameter.detach().clone() for parameter in training.parameters()]
    batches = Batches(data, batch_size=32, workers=0, seed=0)
    scaled = MixedPrecision("16-mixed", "cpu", torch.amp.GradScaler("cpu"))
    trainer = pl.Trainer(
        accelerator="cpu",
        # by its name Lightning gives it to GPUs alone
        **({"plugins": [scaled]} if precision == scaled.precision else {"precision": precision}),
        max_steps=1,
        gradient_clip_val=most,
        gradient_clip_algorithm=algorithm,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        limit_val_batches=0,
    )
    trainer.fit(training, datamodule=LoadedBatches(batches, trainer))
    moved = [now.detach() - then for now, then in zip(training.parameters(), before, strict=True)]
    assert any(bool(one.any()) for one in moved)
    fused = name in FUSED and precision != scaled.precision
    assert bool(trainer.optimizers[0].defaults.get("fused")) == fused
    if name == "sgd" and algorithm == "value":
        assert max(float(one.abs().max()) for one in moved) == pytest.approx(rate * most, rel=1e-3)
    elif name == "sgd":
        each = torch.cat([one.double().reshape(members, -1) for one in moved], 1).norm(dim=1)
        torch.testing.assert_close(each, torch.full_like(each, rate * most), rtol=1e-3, atol=0)
