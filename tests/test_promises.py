"""Agreement of the conformal prediction sets of predictions, served models, frozen models and tables."""

import json
import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from framework.configuration.loading import load_with_description, reader
from framework.configuration.registry import installed
from framework.configuration.settings import Settings
from framework.deployment.frozen import freeze
from framework.deployment.served import ServedModel
from framework.distributions.protocol import value_set
from framework.errors import ConfigError
from framework.modes.predict import predictions
from tests.conftest import Done, Framework

KINDS = {
    "class": ("label", "categorical"),
    "real": ("y", "gaussian"),
    "degrees": ("angle", "von_mises"),
    "several reals": ("[y,z]", "gaussian"),
}
"""Column and head of each kind of target."""
CHAINS = {
    "conformal": "[conformal]",
    "temperature": "[temperature,conformal]",
    "mc_dropout": "[mc_dropout,conformal]",
    "ensemble": "[ensemble,conformal]",
    "platt": "[platt,conformal]",
    "folds": "[folds,conformal]",
    "laplace": "[laplace,conformal]",
    "swag": "[swag,conformal]",
    "batch_ensemble": "[batch_ensemble,conformal]",
    "feature_score": "[feature_score,conformal]",
}
"""Wrappers, each inside the wrapper for conformal prediction sets."""
ELSEWHERE = {"refined"}
"""Wrappers that only fit the models of one data set: least squares for Z-spectra."""
ONLY = {"platt": ("class",)}
OFTEN = {
    "conformal": ("several reals",),
    "temperature": ("real",),
    "mc_dropout": ("degrees",),
    "ensemble": ("class",),
    "platt": ("class",),
    "folds": ("real",),
    "laplace": ("degrees",),
    "swag": ("real",),
    "batch_ensemble": ("class",),
    "feature_score": ("class",),
}
"""Kinds of targets that are always tested for each wrapper; the other kinds are slow tests."""
SHORT = {
    "batch_ensemble": ("uncertainty.batch_ensemble.members=2",),
    "swag": ("trainer.keep=last", "trainer.patience=null"),
    "ensemble": ("uncertainty.ensemble.members=2",),
    "mc_dropout": ("uncertainty.mc_dropout.samples=5",),
    "folds": ("uncertainty.folds.folds=2", "uncertainty.folds.steps=60", "uncertainty.folds.epochs=2"),
}
"""Settings of wrappers that shorten a run."""
PROMISED = 0.8


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Table of two input numbers, with a class, two real numbers and an angle that depend on them."""
    random = np.random.default_rng(0)
    a, b = random.normal(size=(2, 240))
    noisy = a + 0.3 * random.normal(size=240)
    columns = {
        "a": a,
        "b": b,
        "y": 100 + 20 * noisy,
        "z": b - 0.5 * a + 0.2 * random.normal(size=240),
        "angle": np.degrees(np.arctan2(noisy, b)) % 360,
        "label": np.select([a > 0.5, a < -0.5], ["high", "low"], "middle"),
    }
    path = tmp_path_factory.mktemp("table") / "table.csv"
    pd.DataFrame(columns).to_csv(path, index=False)
    return path


def trained(framework: Framework, table: Path, kind: str, chain: str) -> Done:
    target, head = KINDS[kind]
    done = framework(
        *("data=tabular", f"data.path={table}", f"data.target={target}", "data.columns=[a,b]"),
        *(f"data.kind={kind.removeprefix('several ').removesuffix('s') if 'real' in kind else kind}",),
        *(f"density_head={head}", "encoder=[mlp]", "encoder.mlp.widths=[16]", "encoder.mlp.dropout=0.1"),
        *("metric=[log_likelihood,prediction_set]", f"uncertainty={chain}"),
        *(f"uncertainty.conformal.miscoverage={1 - PROMISED:g}", "samples=200", "logger=none"),
        *("pictures=false", "threads=1"),
        *next((settings for wrapper, settings in SHORT.items() if wrapper in chain), ()),
        *(() if "folds" in chain else ("trainer.max_epochs=2",)),
    )
    assert done.code == 0, done.out
    return done


def drawn(kind: str, wrapper: str) -> bool:
    """Return whether sizes are volumes that are estimated from draws: those of mixtures of several numbers."""
    exact = ("conformal", "temperature", "platt", "feature_score")
    return kind == "several reals" and wrapper not in exact


def test_every_wrapper_is_asked() -> None:
    assert set(installed("uncertainty")) - set(CHAINS) == ELSEWHERE


@pytest.mark.parametrize(
    ("kind", "wrapper"),
    [
        pytest.param(kind, wrapper, marks=() if kind in OFTEN[wrapper] else pytest.mark.slow)
        for wrapper in CHAINS
        for kind in ONLY.get(wrapper, tuple(KINDS))
    ],
)
def test_a_set_is_the_same_wherever_it_is_said(
    kind: str, wrapper: str, table: Path, framework: Framework, tmp_path: Path
) -> None:
    run = trained(framework, table, kind, CHAINS[wrapper]).folder
    results = json.loads((run / "results.json").read_text(encoding="utf-8"))
    paths = {"data.path": str(table)}
    predictor, description = load_with_description(run, paths=paths)
    data = reader(description)
    data.prepare()
    # only its numbers of draws and of the seed are read
    settings = Settings.model_construct(samples=200, seed=0)

    def rows(files: list[Path], mass: float | None = None) -> pd.DataFrame:
        found, _ = predictions(predictor, data, description.target, files, settings, tmp_path, mass)
        return pd.DataFrame(found).drop(columns="sample")

    # the table's row is that of the predictions
    test = rows([])
    (size,) = [column for column in test if column.startswith("set_size")]
    key = next(key for key in results["columns"] if key.startswith("set_size"))
    assert results[key] == pytest.approx(test[size].astype(float).mean(), rel=1e-6)

    # a served model answers as mode=predict, and the frozen one has the same sets
    inputs = pd.read_csv(table)[["a", "b"]]
    inputs.to_csv(tmp_path / "inputs.csv", index=False)
    predicted = rows([tmp_path / "inputs.csv"])
    answer = ServedModel(predictor, description, data).predict_table(inputs)
    assert set(predicted) <= set(answer)
    for column in predicted:
        told = [value if isinstance(value, str) else f"{value:.10g}" for value in answer[column]]
        numbers = column != "class" and not column.endswith(("set", "set_deg"))
        if numbers:
            np.testing.assert_allclose(
                predicted[column].astype(float), np.array(told, float), rtol=1e-6, atol=1e-6
            )
        else:
            assert predicted[column].tolist() == told
    sets = value_set(freeze(run, paths=paths).density(inputs))
    assert sets is not None and sets.stated_probability == pytest.approx(PROMISED)
    unit = 180 / math.pi if size.endswith("_deg") else 1.0
    if wrapper != "mc_dropout":  # whose passes differ from call to call
        with torch.no_grad():
            sizes = sets.size().numpy()
        found = predicted[size].astype(float).to_numpy() / unit
        if drawn(kind, wrapper):  # two estimates, each with the error that it says
            error = sets.size_error().numpy()  # type: ignore[attr-defined]
            assert (np.abs(found - sizes) < 6 * math.sqrt(2) * error).all()
        else:
            # the validation row that sets the threshold lies on it, so that rounding decides about its class
            apart = ~np.isclose(found, sizes, rtol=1e-5, atol=1e-6)
            assert apart.sum() <= (kind == "class"), (found[apart], sizes[apart])

    # an interval of another mass promises nothing
    with pytest.raises(ConfigError, match=r"this model predicts sets"):
        rows([tmp_path / "inputs.csv"], 0.55)
