"""Metrics against run time along a knob, and the landscape of a classifier of two inputs."""

import math
from functools import partial

import numpy as np
import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from framework.evaluation.tradeoff import Turn, owners, rows, tradeoff
from framework.model import Model
from framework.reports.landscape_picture import POINTS, Plane, half_width, landscapes, probabilities
from framework.reports.tradeoff_picture import tradeoff as drawn
from framework.target import Target

TARGET = Target("class", ("a", "b"))


def predictor(*wrappers, head="bernoulli", target=TARGET):
    def model():
        encoder = resolve("encoder", {"name": "mlp", "widths": [8], "dropout": 0.5})
        built = build("encoder", encoder, input_shape=(2,))
        return Model([built], build("density_head", resolve("density_head", head), target=target))

    torch.manual_seed(0)
    make = model
    for wrapper in wrappers:
        make = partial(build, "uncertainty", resolve("uncertainty", wrapper), model=make, target=target)
    return make().eval()


def batches():
    generator = torch.Generator().manual_seed(0)
    inputs = torch.randn(60, 2, generator=generator)
    fields = {"input": inputs, "target": (inputs[:, 0] > 0).long(), "index": torch.arange(60)}
    fields["group"] = torch.zeros(60, dtype=torch.int64)
    return [{name: field[start : start + 20] for name, field in fields.items()} for start in (0, 20, 40)]


def metrics():
    return [build("metric", resolve("metric", "nll"), target=TARGET)]


def test_each_value_gives_the_metric_of_the_predictor_so_set():
    whole = predictor({"name": "ensemble", "members": 3})
    turns = tradeoff(
        whole,
        batches(),
        metrics(),
        knob="members",
        values=(1, 3),
        samples=1,
        seed=0,
        repeats=2,
        timed_calls=3,
    )
    assert whole.members == 3  # as before
    for turn in turns:
        whole.members = turn.value
        with torch.no_grad():
            nll = [-whole(batch["input"]).log_prob(batch["target"]) for batch in batches()]
        assert turn.metrics["nll"] == pytest.approx(torch.cat(nll).double().mean().item(), rel=1e-6)
        assert turn.spreads["nll"] == 0  # nothing is drawn
        assert turn.milliseconds > 0


def test_repeats_differ_where_something_is_drawn():
    whole = predictor({"name": "mc_dropout", "samples": 4})
    state = torch.get_rng_state()
    turns = tradeoff(
        whole,
        batches(),
        metrics(),
        knob="samples",
        values=(1, 30),
        samples=1,
        seed=0,
        repeats=6,
        timed_calls=3,
    )
    assert torch.equal(torch.get_rng_state(), state)
    assert whole.samples == 4
    assert turns[0].spreads["nll"] > 2 * turns[1].spreads["nll"] > 0


def test_the_wrappers_knob_hides_a_heads_of_the_same_name():
    angle = Target("angle", ("azimuth",))
    whole = predictor({"name": "mc_dropout"}, head="scvae", target=angle)
    assert owners(whole, "samples") == [whole]
    assert owners(predictor(head="scvae", target=angle), "samples")[0].knobs
    assert owners(whole, "") == []
    with pytest.raises(ConfigError, match="Did you mean 'samples'"):
        owners(whole, "sample")
    with pytest.raises(ConfigError, match="got 0 and 1"):
        tradeoff(whole, [], metrics(), knob="samples", values=(1,), samples=1, seed=0)


def turn(value, nll, milliseconds):
    return Turn(value, {"nll": nll}, {"nll": math.nan}, milliseconds)


def test_rows_say_which_points_no_other_beats():
    curve = [turn(1, 0.5, 1.0), turn(2, 0.6, 2.0), turn(3, 0.4, 3.0)]
    found = rows({"x": curve}, ["nll"], {"nll": True}, synthetic=True)
    assert [row["nll_pareto"] for row in found] == [True, False, True]
    found = rows({"x": curve}, ["nll"], {"nll": False}, synthetic=True)
    assert [row["nll_pareto"] for row in found] == [True, True, False]


def test_the_picture_has_a_panel_a_metric_and_says_synthetic(tmp_path):
    figure = drawn(
        {"x": [turn(1, 0.5, 1.0), turn(2, 0.4, 2.0)], "y": [turn(1, 0.3, 0.5)]},
        {"nll": "NLL"},
        title="t",
        synthetic=True,
    )
    figure.savefig(tmp_path / "x.png")
    assert figure.get_suptitle() == "t (synthetic data)"
    assert [panel.get_ylabel() for panel in figure.axes] == ["NLL"]


@pytest.mark.parametrize("names, head", [(("a", "b"), "bernoulli"), (("a", "b", "c"), "categorical")])
def test_a_landscape_holds_the_probabilities_at_its_points(names, head, tmp_path):
    model = predictor(head=head, target=Target("class", names))
    found = probabilities(model, 3.0)
    assert found.shape == (POINTS, POINTS)
    axis = np.linspace(-3, 3, POINTS)
    point = torch.tensor(
        [[axis[10], axis[50]]], dtype=torch.float32
    )  # the 11th from the left, the 51st from below
    with torch.no_grad():
        shares = model(point).probs[0].double().numpy()
    wanted = shares[1] if len(names) == 2 else -(shares * np.log(shares)).sum() / math.log(3)
    assert found[50, 10] == pytest.approx(wanted, abs=1e-5)
    points, labels = np.random.default_rng(0).normal(size=(9, 2)), np.arange(9) % len(names)
    plane = Plane(points, labels, points[:0], names, half_width(points, points[:0]))
    figure = landscapes({"one": found, "two": found}, plane, title="t", synthetic=True)
    figure.savefig(tmp_path / "x.png")
    assert figure.get_suptitle() == "t (synthetic data)"
