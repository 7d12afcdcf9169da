"""The recommended start for tables, from the command to predictions of new rows."""

import json
import math

import numpy as np
import pandas as pd
import pytest

import framework
from framework.testing.commands import run_commands

SHORT = ["uncertainty.folds.steps=150", "uncertainty.folds.epochs=1"]


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    folder = tmp_path_factory.mktemp("table")
    generator = np.random.default_rng(0)
    frame = pd.DataFrame({"x": generator.lognormal(size=300), "kind": generator.choice(["a", "b"], 300)})
    frame["y"] = 100 + 10 * np.log(frame.x) + 5 * (frame.kind == "a") + generator.standard_t(4, 300)
    frame["label"] = np.where(frame.y > 102, "high", "low")
    frame.to_csv(folder / "mine.csv", index=False)
    frame[["kind", "x"]].head(3).to_csv(folder / "new.csv", index=False)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("task, target", [("regression", "y"), ("classification", "label")])
def test_a_table_is_learned_with_two_settings(table, task, target):
    folder = table / task
    columns = "data.columns=[x,kind]"
    start = [
        f"experiment=tabular/{task}",
        f"data.path={table / 'mine.csv'}",
        f"data.target={target}",
        columns,
    ]
    done = run_commands(
        table,
        [*start, *SHORT, "pictures=svg", f"hydra.run.dir={folder}"],
        [
            "mode=predict",
            f"checkpoint={folder}",
            f"mode.files={table / 'new.csv'}",
            f"hydra.run.dir={folder}/p",
        ],
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "trained on 255 samples of training and validation" in done.stdout
    assert "weights of the groups" in done.stdout
    results = json.loads((folder / "results.json").read_text())
    least = -2.3 if task == "regression" else -0.35  # a constant density has -3.8 and -0.69
    assert results["log_likelihood"] > least
    assert 0.75 < results["set_coverage"] <= 1
    if task == "regression":  # the intervals of the figure are the conformal prediction sets
        drawn = (folder / "figures" / "predicted_intervals.svg").read_text()
        assert f"{45 * results['set_coverage']:.0f} of 45 true values are inside" in drawn
        assert "stated: 90 %" in drawn
    frame = pd.read_csv(table / "new.csv")
    model, frozen = framework.load(folder), framework.freeze(folder)
    predicted = pd.read_csv(folder / "p" / "predictions.csv")
    assert len(predicted) == 3
    if task == "regression":
        np.testing.assert_allclose(frozen.density(frame).mean, model(frame).mean, rtol=1e-6)
        assert (np.abs(predicted["y"] - model(frame).mean[:, 0].numpy()) < 2).all()
    else:
        np.testing.assert_allclose(frozen(frame).sum(1), 1, rtol=1e-5)
        assert all(
            math.isclose(total, 1, abs_tol=1e-5) for total in predicted[["p_high", "p_low"]].sum(axis=1)
        )


@pytest.mark.parametrize(
    "setting, message",
    [
        ("trainer.max_epochs=3", "Folds trains its models itself, by its own settings in uncertainty.folds"),
        ("optimizer.learning_rate=0.1", "Folds trains its models itself"),
        ("objective=[adversarial]", "an objective has no effect"),
    ],
)
@pytest.mark.slow
def test_settings_without_effect_are_refused(table, setting, message):
    start = ["experiment=tabular/classification", f"data.path={table / 'mine.csv'}", "data.target=label"]
    done = run_commands(table, [*start, setting, f"hydra.run.dir={table / 'refused'}"])
    assert done.returncode != 0 and message in done.stderr + done.stdout
