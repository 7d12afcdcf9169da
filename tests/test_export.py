"""Exported models: what NumPy and ONNX Runtime compute is what the model computes."""

import http.client
import importlib
import json
import math
import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats
from torch.distributions import Distribution
from torch.onnx._internal.exporter._registration import ONNXRegistry

from framework.configuration.description import Description
from framework.configuration.registry import installed
from framework.configuration.schema import build, resolve
from framework.data import Data
from framework.density_head import DensityHead
from framework.deployment import export as exporting
from framework.deployment.exported_folder.predict import Model as ExportedModel
from framework.distributions import numpy_densities as densities
from framework.distributions.circular import wrap
from framework.distributions.exported import exported
from framework.distributions.intervals import central_interval
from framework.distributions.numpy_densities import Density
from framework.distributions.protocol import median, value_set
from framework.encoder import Encoder
from framework.errors import ConfigError, UserError
from framework.evaluation.prediction_sets import require_interval
from framework.model import Model, Predictor
from framework.modes.predict import interval_or_set_columns
from framework.prediction import Prediction
from framework.target import Target
from framework.testing.contract import contract
from framework.testing.finding import seed
from framework.testing.head_subject import values
from framework.testing.rows import HeadRow
from plugins.uncertainty.conformal.numpy_prediction_set import PredictionSet
from tests.conftest import Framework, first_of_each

FITTED = ("ballistic", "extra_trees", "fit_pose", "lorentzian", "xgboost")
"""Heads that are fitted in one step; they are not networks."""
REFUSED_HEADS = {
    "implicit_pdf": "A CellDensity cannot be exported",
    "projected_normal": "A ProjectedNormal cannot be exported",
    "quantiles": "A PiecewiseQuantiles cannot be exported",
    "rotation_laplace": "A RotationLaplace cannot be exported",
    "lorentzian": "fitted in one step",
}
"""Heads whose densities have no NumPy code, and one that is not a network, with words of the refusal."""
HEADS = [name for name in installed("density_head") if name not in {*FITTED, *REFUSED_HEADS}]


REFUSED_ENCODERS = {
    "points": "A random choice of points cannot be exported|order of the farthest points",
    "pointnet2": "order of the farthest points",
    "point_nn": "order of the farthest points",
    "dgcnn": "search for nearest neighbours",
    "projection": "Its part Projection is not a sequence of operations",
    "rasterised": "Its part Rasterised is not a sequence of operations|does not accept the random inputs",
    "ballistic": "Its part BallisticEncoder is not a sequence of operations|does not accept the random inputs",
    "extrapolation": "Its part ExtrapolationEncoder is not a sequence of operations|does not accept the random inputs",
    "unet: odd size": "A crop cannot be exported",
    "unet: over its input": "A crop cannot be exported",
    "slim: odd size": "A crop cannot be exported",
    "slim: over its input": "A crop cannot be exported",
    "slim: a scale, squares of 4": "A crop cannot be exported",
    "slim: bfloat16, whole frame": "ONNX Runtime cannot load it",
    "bps: rotation-invariant": "axes of a cloud are eigenvectors",
}
"""Encoders, or single rows of them, that are refused, with words of the reason."""


def rows(name: str) -> list[HeadRow]:
    """Return the contract rows of a head."""
    return list(contract("density_head", name).rows)


def build_head(name: str, row: HeadRow) -> DensityHead:
    """Return a head of a contract row, with random parameters."""
    seed(0)
    head: DensityHead = build(
        "density_head", resolve("density_head", {"name": name, **row.config}), target=row.target
    )
    return head.eval().requires_grad_(False)


def as_numpy(density: Distribution) -> Density:
    """Return the density that NumPy computes from the parameters of a density of torch."""
    form = exported(density)
    families = {
        key: family
        for path in form.modules()
        for key, family in importlib.import_module(path).FAMILIES.items()
    }
    layout = json.loads(json.dumps(form.layout()))
    return densities.build(
        layout, {name: tensor.detach().numpy() for name, tensor in form.tensors()}, families
    )


ROWS = first_of_each(
    [(name, row) for name in HEADS for row in rows(name)],
    lambda case: case[0],
    lambda case: f"{case[0]}: {case[1].name}",
)
"""Contract rows of the heads that are exported; only the first of each head is a quick test."""


@pytest.mark.parametrize(("name", "row"), ROWS)
def test_numpy_computes_the_same_density(name: str, row: HeadRow) -> None:
    for spread in (1.0, 30.0):
        compare_densities(name, row, spread)


def compare_densities(name: str, row: HeadRow, spread: float) -> None:
    """Compare the log-densities, modes, entropies and draws of NumPy with those of torch."""
    head = build_head(name, row).double()
    generator = torch.Generator().manual_seed(1)
    raw = spread * torch.randn(5, *head.raw_shape, generator=generator, dtype=torch.float64)
    density = head(raw)
    estimated = any(exported(density).remarks())
    if estimated:  # NumPy has the mixture of the drawn components in place of an estimate
        density = getattr(density, "mixture", density)
    own = as_numpy(density)
    assert (own.batch, own.event) == (tuple(density.batch_shape), tuple(density.event_shape))
    torch.manual_seed(0)
    values = density.sample(torch.Size((9,)))
    if not any(exported(density).remarks()):
        expected = density.log_prob(values).double().numpy()
        np.testing.assert_allclose(own.log_prob(values.double().numpy()), expected, rtol=1e-9, atol=1e-9)
    if own.by_draws and isinstance(own, densities.Mixture):
        with pytest.raises(ValueError, match="The mode of a mixture of these densities is not known"):
            own.mode()
    elif not estimated:
        # the most likely value is at least as likely as torch's
        mode = torch.as_tensor(own.mode()).to(values.dtype)
        assert bool((density.log_prob(mode) >= density.log_prob(density.mode) - 1e-6).all())
    entropy = own.entropy()
    away = np.abs(entropy.value - density.entropy().double().numpy())
    several = (
        estimated or entropy.error.any()
    )  # draws, and torch's entropy is estimated from about 1000 of its own
    assert (away <= (8 * entropy.error + 0.3 if several else 1e-7 * (1 + np.abs(entropy.value)))).all()
    draws = own.sample(np.random.default_rng(0), 4000)
    assert draws.shape == (4000, *own.batch, *own.event)
    surprise = -own.log_prob(draws)
    away, error = (
        np.abs(surprise.mean(0) - entropy.value),
        np.hypot(surprise.std(0) / math.sqrt(4000), entropy.error),
    )
    # values rarer than one in 4000 may be missing among the draws
    assert (away <= 5 * error + 1e-3 * (1 + np.abs(entropy.value))).all()


@pytest.mark.parametrize(
    ("name", "row"),
    [
        case
        for case in ROWS
        if case.values[0] in ("gaussian", "mixture", "uniform_floor", "von_mises")
        and case.values[1].target.kind in ("real", "angle")
    ],
)
def test_numpy_computes_the_same_intervals(name: str, row: HeadRow) -> None:
    compare_intervals(name, row, 0.5)
    compare_intervals(name, row, 0.9)


def compare_intervals(name: str, row: HeadRow, mass: float) -> None:
    """Compare the central intervals of NumPy with those of torch."""
    head = build_head(name, row).double()
    raw = torch.randn(4, head.size, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    density = head(raw)
    own = as_numpy(density)
    if own.by_draws:
        assert abs(share_between(own, density, mass) - mass) < 0.03
        return
    expected = central_interval(density, mass)
    assert not (expected.low_error != 0).any()
    ends = own.interval(mass)
    scale = (expected.high - expected.low).numpy()
    for end, true in zip(ends, expected[:2], strict=True):
        away = end - true.numpy()
        away = wrap(torch.from_numpy(away)).numpy() if own.circular else away
        assert (np.abs(away) <= 1e-6 * scale).all()
    if own.event == (1,) and not own.circular:
        np.testing.assert_allclose(
            own.median(), median(density, 1000).numpy(), rtol=0, atol=0.2 * scale.max()
        )


def share_between(own: Density, density: Distribution, mass: float) -> float:
    """Return the share of draws of torch between the ends of NumPy's intervals, which are those of draws."""
    torch.manual_seed(0)
    draws = density.sample(torch.Size((4000,))).double().numpy()
    ends = own.interval(mass)
    inside = np.mod(draws - ends.low, 2 * math.pi) <= ends.high - ends.low
    return float(inside.mean())


@pytest.mark.parametrize(
    ("head", "target"),
    [
        ("categorical", Target("class", ("a", "b", "c"))),
        ("gaussian", Target("real", ("y",))),
        ("mixture", Target("angle", ("azimuth",))),
    ],
    ids=lambda part: part if isinstance(part, str) else part.kind,
)
@pytest.mark.parametrize("threshold", [-0.5, 0.8, 1.5, math.inf])
def test_numpy_computes_the_same_prediction_sets(head: str, target: Target, threshold: float) -> None:
    part = resolve("uncertainty", {"name": "conformal"})
    inner = build("density_head", resolve("density_head", {"name": head}), target=target).double()
    raw = 2 * torch.randn(6, inner.size, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    wrapper = build("uncertainty", part, model=lambda: Model([], inner, (inner.size,)), target=target)
    wrapper.threshold.fill_(threshold)
    wrapper.model.projection = torch.nn.Identity()
    density = wrapper.eval()(raw)
    expected = value_set(density)
    own = as_numpy(density)
    assert expected is not None
    for true, found in zip(expected.parts() or (), own.parts(), strict=True):  # type: ignore[attr-defined]
        if target.kind == "class":
            assert true == found
        else:
            np.testing.assert_allclose(np.ravel(found), np.ravel(true), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("mass", [0.0, 0.5, 0.9, 0.99])
def test_quantiles_of_numpy_have_their_probability(mass: float) -> None:
    """Check mixtures of normals with SciPy's distribution function; 0 means the median."""
    generator = np.random.default_rng(0)
    for count in (1, 2, 3, 5) * 25:
        weights, places = generator.dirichlet(np.ones(count)), 3 * generator.normal(size=count)
        widths = np.exp(generator.normal(size=count))
        normals = densities.Normal(places[None, :, None], widths[None, :, None])
        density = densities.Mixture(np.log(weights)[None], normals)
        ends = np.ravel(density.interval(mass)) if mass else np.ravel(density.median())
        below = [weights @ stats.norm.cdf(end, places, widths) for end in ends]
        np.testing.assert_allclose(below, [(1 - mass) / 2, (1 + mass) / 2][: len(ends)], atol=1e-12)


@pytest.mark.parametrize("unit", [1e-30, 1e-12, 1e12, 1e30])
def test_modes_and_sets_of_numpy_do_not_depend_on_the_unit(unit: float) -> None:
    def mixture(unit: float) -> densities.Mixture:
        places, widths = np.array([[[0.0], [1.5]]]), np.array([[[1.0], [0.6]]])
        return densities.Mixture(np.log([[0.3, 0.7]]), densities.Normal(unit * places, unit * widths))

    def results(unit: float) -> list[np.ndarray]:
        density = mixture(unit)
        parts = PredictionSet(density, 1.5 + math.log(unit), None).parts()
        return [density.mode() / unit, np.array(parts) / unit, density.interval(0.9).low / unit]

    for scaled, plain in zip(results(unit), results(1.0), strict=True):
        np.testing.assert_allclose(scaled, plain, rtol=1e-8)


class Computed(ExportedModel):
    """Exported model whose densities are given, so that no network is traced."""

    def __init__(self, density: Density, target: Target) -> None:
        self.density = density
        self.description = {"target": exporting.target_entry(target)}

    def __call__(self, inputs: Any, seed: int = 0) -> Density:
        return self.density


def outcome(columns: Callable[[], Mapping[str, Any]]) -> Mapping[str, Any] | str:
    """Return the columns of intervals and sets, or the kind of the refusal."""
    try:
        found = columns()
    except (ConfigError, ValueError) as error:
        (kind,) = {
            name
            for name, words in {
                "no interval": "no central interval|intervals of real numbers or angles, but",
                "other probability": "no such guarantee",
                "no ends": "predicts sets, which do not have",
            }.items()
            if re.search(words, str(error))
        }
        return kind
    return {
        name: cells for name, cells in found.items() if re.search("(_low|_high|set|set_size)(_deg)?$", name)
    }


def transpose(rows: Iterable[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Return rows of a table as columns."""
    listed = list(rows)
    return {name: [row[name] for row in listed] for name in listed[0]}


INTERVAL_CASES = [
    pytest.param(
        name,
        wrapper,
        id=f"{name}: {wrapper or 'alone'}",
        marks=[] if name == "gaussian" or wrapper == "conformal" else [pytest.mark.slow],
    )
    for name in HEADS
    if rows(name)[0].target.kind != "image"
    for wrapper in (None, *installed("uncertainty"))
    if name == "gaussian" or wrapper in (None, "conformal", "temperature")
]
"""Pairs of a density head and a wrapper: all wrappers for one head, and for every head those that calibrate it."""
REFUSED_PAIRS = {
    **dict.fromkeys(
        (("hybrid", wrapper) for wrapper in (None, "conformal", "temperature")), "HybridHead reads 10 numbers"
    ),
    **dict.fromkeys(
        (("lstm", wrapper) for wrapper in (None, "conformal", "temperature")), "LSTMHead reads 20 numbers"
    ),
    ("evidential", "temperature"): "it has a variance only at temperatures below",
    ("gaussian", "feature_score"): "A ScoredDensity cannot be exported",
    ("gaussian", "mc_dropout"): "needs a dropout layer",
    ("gaussian", "platt"): "describes targets of kind 'class'",
    ("gaussian", "refined"): "spectra of 93 offsets",
}
"""Pairs that the small model of the test does not fit, or that are not exported, with words of the refusal."""


@pytest.mark.parametrize(("name", "wrapper"), INTERVAL_CASES)
def test_an_exported_model_and_mode_predict_print_the_same_intervals(name: str, wrapper: str | None) -> None:
    """Both print the same ends and the same sets, or refuse the probability for the same reason."""
    target = rows(name)[0].target

    def inner() -> Model:
        encoder = build("encoder", resolve("encoder", {"name": "mlp", "widths": [4]}), input_shape=(3,))
        return Model([encoder], build_head(name, rows(name)[0]))

    torch.manual_seed(0)
    batch = {"input": torch.randn(40, 3), "target": values(target, (40,)), "index": torch.arange(40)}
    try:
        predictor: Predictor = inner()
        if wrapper is not None:
            predictor = build("uncertainty", resolve("uncertainty", wrapper), model=inner, target=target)
            predictor.calibrate([batch])
        with torch.no_grad():
            density = predictor.eval()(batch["input"][:5])
            own, estimated = as_numpy(density), any(exported(density).remarks())
    except UserError as error:
        assert REFUSED_PAIRS.get((name, wrapper), "an export") in str(error)
        return
    assert (name, wrapper) not in REFUSED_PAIRS

    def predicted(mass: float | None) -> Mapping[str, Any]:
        if mass:
            require_interval(target, mass, by="mode.interval")
        return interval_or_set_columns(target, Prediction(density, {}), mass)

    for mass in (None, 0.5, 0.9):
        expected = outcome(lambda mass=mass: predicted(mass))
        printed = outcome(lambda mass=mass: transpose(Computed(own, target).table(batch["input"], mass)))
        if isinstance(expected, str) or isinstance(printed, str):
            assert printed == expected
            continue
        if len(target.names) > 1 and own.has_sets:
            continue  # NumPy computes no volume of a set of several numbers
        assert set(printed) == set(expected)
        for column, cells in expected.items():
            if column.endswith(("set", "set_deg")):
                assert [len(json.loads(cell)) for cell in printed[column]] == [
                    len(json.loads(x)) for x in cells
                ]
            elif not (own.by_draws or estimated):  # otherwise both draw random numbers
                np.testing.assert_allclose(printed[column], cells, rtol=1e-4, atol=1e-4)


class Arrays(Data):
    """Data whose users give arrays of the model's inputs."""

    bibtex, synthetic, varies = "", True, False
    prepare = splits = read = augment = fingerprint = preview = None  # type: ignore[assignment]

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.input_shape = shape


def describe(shape: tuple[int, ...], target: Target) -> Description:
    """Return the description of a model of this shape and target."""
    return Description({"data": {"name": "arrays"}}, target, shape, (), synthetic=True, method="tested")


@pytest.fixture(scope="module", autouse=True)
def operators() -> Iterator[None]:
    """Let torch collect ONNX's forms of its operators once, and not for each export, of which this is almost half."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ONNXRegistry, "from_torchlib", staticmethod(cache(ONNXRegistry.from_torchlib)))
        yield


@pytest.fixture
def arrays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the exporter read arrays as they are."""
    Arrays.__abstractmethods__ = frozenset()  # type: ignore[attr-defined]
    monkeypatch.setattr(exporting, "reader", lambda description: Arrays(description.input_shape))


@pytest.fixture
def called_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the exporter call each form of a model once where it measures its run time, instead of again and again."""

    def call_once(call: Callable[[], object]) -> float:
        call()
        return 1.0

    monkeypatch.setattr(exporting, "_milliseconds", call_once)


class Drawing(Encoder):
    """A linear layer from six numbers to an image of raw parameters."""

    bibtex = ""

    def __init__(self, shape: tuple[int, ...]) -> None:
        super().__init__()
        self.layer = torch.nn.Linear(6, math.prod(shape))
        self.output_shape = shape

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Return the image, (batch, *shape)."""
        return self.layer(inputs).reshape(-1, *self.output_shape)


def model_of(name: str, row: HeadRow) -> tuple[Predictor, tuple[int, ...]]:
    """Return a small network with a head, and the shape of its inputs."""
    head = build_head(name, row)
    if head.direct:
        return Model([Drawing(head.raw_shape)], head).eval(), (6,)
    encoder = build("encoder", resolve("encoder", {"name": "mlp", "widths": [16]}), input_shape=(6,))
    return Model([encoder], head).eval(), (6,)


@pytest.mark.usefixtures("arrays")
@pytest.mark.parametrize("name", ["gaussian", "mixture"])
def test_an_exported_network_computes_the_same_parameters(name: str, tmp_path: Path) -> None:
    content = check_export(name, rows(name)[0], tmp_path / "model")
    times = content["milliseconds"]
    assert [*times] == ["1", "64"] and all(
        [*forms] == ["torch", "frozen", "onnxruntime"] for forms in times.values()
    )
    assert all(time > 0 for forms in times.values() for time in forms.values())


def require_no_origin(folder: Path) -> None:
    """Check that no file of an exported folder names a place, or holds a line of code, of the machine that exports."""
    for file in folder.iterdir():
        content = file.read_bytes()
        for name in (str(Path(__file__).parents[1]), sys.prefix, str(folder.parent)):
            assert name.encode() not in content, f"{file.name}: {name}"
    assert not re.search(rb"\.py\", line \d", (folder / "model.onnx").read_bytes())  # of a stack trace


def check_export(name: str, row: HeadRow, into: Path) -> Mapping[str, Any]:
    """Export a model with this head, see that the differences are small, and return its description."""
    model, shape = model_of(name, row)
    content = exporting.export(model, describe(shape, row.target), into)
    require_parity(content)
    require_no_other_imports(into)
    require_no_origin(into)
    return content


def require_parity(content: Mapping[str, Any]) -> None:
    """Require that ONNX Runtime computes the parameters of torch."""
    assert content["parity"]["random"]["parameters"] <= 1e-5
    assert content["parity"]["extreme"]["parameters"] <= 1e-4  # float32 itself rounds as much


class Distorted(exporting.Session):
    """Session whose parameter `name` is wrong by `shift` times its largest size, for extreme inputs alone."""

    name, shift = "", 0.0

    def __init__(self, model: Path | bytes) -> None:
        super().__init__(model)
        self.exact, self.run = self.run, self.distorted

    def distorted(self, names: Any, inputs: Any) -> Any:
        """Return the outputs of the session, one of which is wrong for extreme inputs."""
        outputs = self.exact(names, inputs)
        if np.abs(inputs["input"]).max() < 100:
            return outputs
        largest = [np.maximum(1, np.abs(values).max()) for values in outputs]
        return [
            values + np.float32(self.shift * size) if name == self.name else values
            for name, values, size in zip(names, outputs, largest, strict=True)
        ]


INNER = ("ensemble", "mc_dropout", "batch_ensemble", "swag", "laplace")
"""Wrappers that return a mixture over models."""
WRAPPED = first_of_each(
    [
        (head, target, inner, outer)
        for head, target in (
            ("categorical", Target("class", ("a", "b", "c"))),
            ("gaussian", Target("real", ("x",))),
            ("von_mises", Target("angle", ("azimuth",))),
        )
        for inner in INNER
        for outer in ("temperature", "platt", "conformal")
        if outer != "platt" or head == "categorical"
    ],
    lambda case: case[0],
    lambda case: f"{case[0]}: {case[2]}, {case[3]}",
)
"""Calibrated wrappers around mixtures; only the first of each density head is a quick test."""


@pytest.mark.usefixtures("arrays", "called_once")
@pytest.mark.parametrize(("head", "target", "inner", "outer"), WRAPPED)
def test_calibrated_mixtures_are_exported(
    head: str, target: Target, inner: str, outer: str, tmp_path: Path
) -> None:
    def model() -> Predictor:
        part = {"name": "mlp", "widths": [16], "dropout": 0.2}
        network = build("encoder", resolve("encoder", part), input_shape=(6,))
        return Model([network], build("density_head", resolve("density_head", head), target=target))

    def wrapped() -> Predictor:
        return build("uncertainty", resolve("uncertainty", inner), model=model, target=target)

    torch.manual_seed(0)
    predictor = build("uncertainty", resolve("uncertainty", outer), model=wrapped, target=target).eval()
    batch = {"input": torch.randn(40, 6), "target": values(target, (40,)), "index": torch.arange(40)}
    predictor.calibrate([batch])
    content = exporting.export(predictor.requires_grad_(False), describe((6,), target), tmp_path / "model")
    require_parity(content)


def moons_model() -> Predictor:
    """Return a small network of two classes with random weights, as for two moons."""
    target = Target("class", ("first", "second"))
    network = build("encoder", resolve("encoder", {"name": "mlp", "widths": [128, 128]}), input_shape=(2,))
    return Model([network], build("density_head", resolve("density_head", "bernoulli"), target=target)).eval()


@pytest.mark.usefixtures("arrays", "called_once")
@pytest.mark.parametrize("shift", [0.0, 1e-4, 1e-2])
def test_rounding_is_no_reason_to_refuse_and_a_fault_for_extreme_inputs_is(
    shift: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(0)
    description = describe((2,), Target("class", ("first", "second")))
    monkeypatch.setattr(exporting, "Session", Distorted)
    monkeypatch.setattr(Distorted, "shift", shift)
    monkeypatch.setattr(Distorted, "name", "logits")
    if not shift:
        exporting.export(moons_model(), description, tmp_path / "model")
        return
    with pytest.raises(ConfigError, match=r"in the parameter logits for extreme inputs.*rounding error of"):
        exporting.export(moons_model(), description, tmp_path / "model")


def test_an_exact_parameter_is_not_allowed_the_rounding_of_another_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    exact = np.linspace(1, 2, 16)[:, None]
    own = {"rounded": exact + 1e-3, "exact": exact + 1e-9}
    outputs = {"rounded": exact - 2e-3, "exact": exact + 1e-4}
    double = {"rounded": exact, "exact": exact}
    trial = exporting.Trial(None, outputs, own, lambda: double)  # type: ignore[arg-type]
    model = exporting.Exporting(moons_model(), describe((2,), Target("class", ("a", "b"))), None)
    exporting._require_small_error(model, "rounded", [trial], "extreme")
    with pytest.raises(
        ConfigError, match=r"error is 1\.0e-04, but at most 4 times .* of 1\.0e-09 is allowed"
    ):
        exporting._require_small_error(model, "exact", [trial], "extreme")


def require_no_other_imports(folder: Path) -> None:
    """Require that the Python files of an exported folder import only each other and a few packages."""
    imports = re.findall(
        r"^ *(?:from|import) (\w+)", "".join(file.read_text() for file in folder.glob("*.py")), re.M
    )
    own = {file.stem for file in folder.glob("*.py")} | {"numpy", "onnxruntime", "fastapi", "uvicorn"}
    assert set(imports) - own <= set(sys.stdlib_module_names)


@pytest.mark.usefixtures("arrays")
@pytest.mark.parametrize("name", REFUSED_HEADS)
def test_a_head_that_numpy_cannot_compute_is_refused(name: str, tmp_path: Path) -> None:
    head = build_head(name, rows(name)[0])
    model, description = Model([], head, (head.size,)).eval(), describe((head.size,), rows(name)[0].target)
    with pytest.raises(ConfigError, match=REFUSED_HEADS[name]):
        exporting.export(model, description, tmp_path / "model")
    assert not (tmp_path / "model").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("arrays", "called_once")
@pytest.mark.parametrize("name", HEADS)
def test_every_head_is_exported(name: str, tmp_path: Path) -> None:
    for number, row in enumerate(rows(name)):
        check_export(name, row, tmp_path / str(number))


@pytest.mark.slow
@pytest.mark.usefixtures("arrays", "called_once")
@pytest.mark.parametrize("name", installed("encoder"))
def test_every_encoder_is_exported_or_refused_with_its_reason(name: str, tmp_path: Path) -> None:
    target = Target("class", ("a", "b", "c"))
    head = build("density_head", resolve("density_head", {"name": "categorical"}), target=target)
    for number, row in enumerate(contract("encoder", name).rows):
        seed(0)
        config = resolve("encoder", {"name": name, **row.config})
        encoder = build("encoder", config, input_shape=row.input_shape, input_columns=row.columns)
        flat = build(
            "encoder", resolve("encoder", {"name": "mlp", "widths": [8]}), input_shape=encoder.output_shape
        )
        model = Model([encoder, flat], head).eval()
        description = replace(describe(row.input_shape, target), columns=row.columns)
        words = REFUSED_ENCODERS.get(name) or REFUSED_ENCODERS.get(f"{name}: {row.name}")
        into = tmp_path / str(number)
        if words is None:
            content = exporting.export(model, description, into)
            require_parity(content)
            require_no_origin(into)
        else:
            with pytest.raises(ConfigError, match=words):
                exporting.export(model, description, into)
            assert not into.exists()


@pytest.mark.slow
@pytest.mark.usefixtures("arrays", "called_once")
def test_predictions_do_not_depend_on_the_other_inputs_of_a_batch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Clouds are padded with NaN, and random numbers are the same for every input and depend on the seed alone."""
    target = Target("class", ("a", "b", "c"))
    row = contract("encoder", "deepsets").rows[0]
    encoder = build("encoder", resolve("encoder", {"name": "deepsets", **row.config}), input_shape=(40, 3))
    scvae = build(
        "density_head", resolve("density_head", {"name": "scvae", "component": "categorical"}), target=target
    )
    exporting.export(Model([encoder], scvae).eval(), describe((40, 3), target), tmp_path / "model")
    monkeypatch.syspath_prepend(str(tmp_path / "model"))
    model = importlib.import_module("predict").load(tmp_path / "model")
    generator = np.random.default_rng(0)
    clouds = [generator.normal(size=(count, 3)) for count in (40, 7, 90)]
    together = model(clouds).probabilities
    for cloud, expected in zip(clouds, together, strict=True):
        np.testing.assert_allclose(model([cloud]).probabilities[0], expected, rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(model([cloud]).probabilities, model([cloud]).probabilities)
    assert np.abs(model(clouds, seed=1).probabilities - together).max() > 1e-6

    network = build("encoder", resolve("encoder", {"name": "mlp", "dropout": 0.5}), input_shape=(6,))
    head = build("density_head", resolve("density_head", "categorical"), target=target)
    part = resolve("uncertainty", {"name": "mc_dropout", "samples": 5})
    wrapper = build("uncertainty", part, model=lambda: Model([network], head), target=target).eval()
    exporting.export(wrapper, describe((6,), target), tmp_path / "dropout")
    dropout = importlib.import_module("predict").load(tmp_path / "dropout")
    with pytest.raises(ValueError, match="predicts classes, which have no central interval"):
        list(dropout.table(generator.normal(size=(1, 6)), 0.9))
    numbers = generator.normal(size=(3, 6))
    alone = [dropout(row[None]).probabilities[0] for row in numbers]
    np.testing.assert_allclose(dropout(numbers).probabilities, alone, rtol=1e-5, atol=1e-6)
    assert np.abs(dropout(numbers, seed=1).probabilities - alone).max() > 1e-6

    for bad, words in (
        ([np.zeros((0, 3))], "Cloud 0 has no point"),
        ([clouds[0], np.full((3, 3), np.nan)], "Cloud 1 has no point"),
        ([np.array([[0, 0, 0], [0, np.inf, 0]])], "Point 1 of cloud 0 is not finite"),
        ([[[1, 2]]], "reads inputs of shape"),
        ([[1, 2, 3]], "Clouds must be arrays"),
        ([[["x", 2, 3]]], "not an array of numbers"),
    ):
        with pytest.raises(ValueError, match=words):
            model(bad)


@pytest.mark.parametrize(
    "content", [b"", b"1,2\n3,4\n", b"PK\x03\x04", b"\x93NUMPY", b"\x80\x04N."], ids=repr
)
def test_a_file_that_is_no_array_gets_a_sentence(content: bytes, tmp_path: Path) -> None:
    script = importlib.import_module("framework.deployment.exported_folder.predict")
    file = tmp_path / "rows.csv"
    file.write_bytes(content)
    with pytest.raises(
        ValueError, match=r"rows.csv is not an array .* of the shape \(batch, 2\) with numpy.save"
    ):
        script.read_array(file, ["batch", 2])


def test_words_in_a_file_are_read_as_the_data_set_reads_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script = importlib.import_module("framework.deployment.exported_folder.predict")
    levels = importlib.import_module("plugins.data.tabular.levels")
    csv_columns = importlib.import_module("framework.datasets.csv_columns")
    file = tmp_path / "new.csv"
    file.write_text("colour,x,note,size=big\nred,3,a,1\n green ,1,b,0\nviolet,2,c,1\n", encoding="utf-8")
    columns = ["x", "colour=green", "colour=red", "size=big"]
    rows = script.read_csv(file, columns)
    assert "does not know the word 'violet' of the column 'colour' (1 rows)" in capsys.readouterr().err
    cells = levels.add_levels(csv_columns.read_columns(file), columns)
    expected = np.stack([csv_columns.numbers(cells, name, missing="") for name in columns], -1)
    np.testing.assert_array_equal(rows, expected)
    for missing in ("shape=round", "y"):
        with pytest.raises(ValueError, match=f"has no column '{missing}'"):
            script.read_csv(file, [*columns, missing])
    file.write_text("colour,x\nred\n", encoding="utf-8")
    with pytest.raises(ValueError, match="line 2: the line has no cell in the column 'x'"):
        script.read_csv(file, ["colour=red", "x"])


def test_a_file_of_a_spreadsheet_in_another_notation_gets_a_sentence(tmp_path: Path) -> None:
    script = importlib.import_module("framework.deployment.exported_folder.predict")
    file = tmp_path / "new.csv"
    for sign in ";\t|":
        file.write_text(f"x{sign}y\n1,5{sign}2\n", encoding="utf-8")
        with pytest.raises(ValueError, match=r"has one column, 'x.*y'\. Separate the columns by commas"):
            script.read_csv(file, ["x", "y"])
    for cell in ("1,5", "1.234,5", "5 %", "Köln"):
        file.write_text(f'x,y\n1,2\n"{cell}",2\n', encoding="utf-8")
        with pytest.raises(
            ValueError, match=f"line 3: the column 'x' holds '{cell}', .* with a decimal point"
        ):
            script.read_csv(file, ["x", "y"])


def test_missing_numbers_of_a_table_are_read_and_filled(tmp_path: Path) -> None:
    """The network of an exported folder fills NaN; a column that ends with = marks where the numbers are missing."""
    rows = [["1", "2", "a"], ["", "4", "b"], ["5", "NA", "a"], ["0", "1", "b"]] * 10
    file = tmp_path / "holes.csv"
    file.write_text("\n".join(["x,y,class", *map(",".join, rows)]), encoding="utf-8")
    part = {"name": "tabular", "path": str(file), "target": "class", "missing": "median"}
    data = build("data", resolve("data", part))
    data.prepare()
    preprocessing = data.preprocessing()
    script = importlib.import_module("framework.deployment.exported_folder.predict")
    array = script.read_csv(file, [*data.columns], preprocessing.missing)
    assert data.columns == ("x", "y", "x=", "y=")
    np.testing.assert_array_equal(
        array[:4], [[1, 2, 0, 0], [math.nan, 4, 1, 0], [5, math.nan, 0, 1], [0, 1, 0, 0]]
    )
    torch.testing.assert_close(preprocessing.module(torch.from_numpy(array)), data.inputs(file))
    with pytest.raises(ValueError, match="line 3: the column 'x' holds '', which is not a number"):
        script.read_csv(file, ["x", "y"])
    model = script.Model.__new__(script.Model)
    model._cloud, model._shape, model._dtype, model._fills = False, ["batch", 4], np.dtype("float64"), True
    np.testing.assert_array_equal(model._array([[None, 4, 1, 0]]), array[1:2])
    with pytest.raises(ValueError, match="row 1 are not finite"):
        model._array([[1, 2, 0, 0], [math.inf, 4, 1, 0]])
    model._fills = False
    with pytest.raises(ValueError, match="row 0 are not finite"):
        model._array([[math.nan, 4, 1, 0]])


def test_the_exported_folder_needs_numpy_and_onnxruntime_alone(framework: Framework, tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    cells = generator.normal(size=(80, 2)) * [1, 50] + [0, 1000]
    lines = [f"{first},{second},{first + second / 50}" for first, second in cells.tolist()]
    (tmp_path / "rows.csv").write_text("\n".join(["a,b,y", *lines, ""]))
    table = (f"data.path={tmp_path / 'rows.csv'}", "data.target=y", "data.kind=real")
    small = ("encoder.mlp.widths=[8]", "trainer.max_epochs=1", "pictures=false", "logger=none", "threads=1")
    done = framework("data=tabular", *table, "density_head=gaussian", "encoder=[mlp]", *small)
    assert done.code == 0, done.out
    made = framework("mode=export", f"checkpoint={done.folder}", "logger=none", folder="exported")
    assert made.code == 0, made.out
    folder = made.folder / "exported"
    asked = framework(
        "mode=predict", f"checkpoint={done.folder}", f"mode.files={tmp_path / 'rows.csv'}", "mode.interval=0.9",
        "logger=none", folder="predicted",
    )  # fmt: skip
    assert asked.code == 0, asked.out

    # Only these packages can be imported: a folder with links to them is the whole search path.
    site = tmp_path / "site"
    site.mkdir()
    packages = Path(np.__file__).parents[1]
    for name in (
        "numpy",
        "numpy.libs",
        "onnxruntime",
        "flatbuffers",
        "google",
        "packaging",
        "typing_extensions.py",
    ):
        if (packages / name).exists():
            (site / name).symlink_to(packages / name)
    script = f"import sys; sys.path[:0] = [{str(folder)!r}, {str(site)!r}]; import predict; predict.command()"
    answer = subprocess.run(
        [sys.executable, "-S", "-E", "-P", "-c", script, str(tmp_path / "rows.csv"), "--interval", "0.9"],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    found = [line.split(",") for line in answer.splitlines()]
    wanted = [line.split(",") for line in (asked.folder / "predictions.csv").read_text().splitlines()]
    for name in ("y", "y_low", "y_high", "entropy_nats"):
        column, other = (
            np.array([float(row[table[0].index(name)]) for row in table[1:]]) for table in (found, wanted)
        )
        np.testing.assert_allclose(column, other, rtol=1e-5, atol=1e-5)

    # rows far outside the training rows are named by every way to predict
    (tmp_path / "far.csv").write_text("a,b\n0,1000\n0,1\n")
    words = [sys.executable, "-S", "-E", "-P", "-c", script, str(tmp_path / "far.csv")]
    messages = subprocess.run(words, capture_output=True, text=True, check=True).stderr
    assert "far.csv: 1 of 2 rows lies far outside the training rows" in messages
    assert "'b' is 1 in one of them, but " in messages
    lines = [
        f"import sys; sys.path[:0] = [{str(folder)!r}]",
        "from predict import load; from serve import _answer",
        "print(load().far([[0, 1000], [0, 1]]).astype(int).tolist())",
        """print(_answer(load(), b'{"inputs": [[0, 1], [0, 1000]]}', False, None).decode())""",
    ]
    words = [sys.executable, "-c", "\n".join(lines)]
    printed = subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines()
    assert json.loads(printed[0]) == [[0, 0], [0, 1]]
    assert json.loads(printed[1])["far"] == [0]

    # a reader such as `head` may end before everything is printed
    words = [sys.executable, "-S", "-E", "-P", "-c", script, str(tmp_path / "rows.csv")]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as early:
        assert early.stdout is not None and early.stderr is not None
        early.stdout.close()
        assert b"Traceback" not in early.stderr.read()

    require_no_other_imports(folder)
    again = framework(
        "mode=export", f"checkpoint={done.folder}", f"mode.into={folder}", "logger=none", folder="again"
    )
    assert again.code != 0 and "is not empty" in again.out


@pytest.mark.parametrize("name", ["this", "os.path", "../densities", "/densities"])
def test_a_description_of_another_person_imports_no_module(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("onnxruntime")
    from framework.deployment.exported_folder.predict import load

    (tmp_path / "density.json").write_text(json.dumps({"modules": [name]}))
    (tmp_path / "densities.py").write_text("print('run')")
    with pytest.raises(ValueError, match=r"names the module '.*', which is not beside .*predict\.py"):
        load(tmp_path)
    assert capfd.readouterr().out == ""


MALFORMED = (
    b"", b"{", b"\xff\xfe", b"null", b"[]", b"[" * 5000 + b"]" * 5000, b'{"inputs": "x"}', b'{"inputs": null}',
    b'{"inputs": {"a": 1}}', b'{"inputs": []}', b'{"inputs": [[1, 2]]}', b'{"inputs": [[1, 2, 3], [1]]}',
    b'{"inputs": [[1, 2, 3, 4, 5, NaN]]}', b'{"inputs": [[1, 2, 3, 4, 5, 1e999]]}',
    b'{"inputs": [[1, 2, 3, 4, 5, "x"]]}',
    b'{"inputs": [[1, 2, 3, 4, 5, 6]], "interval": 2}', b'{"inputs": [[1, 2, 3, 4, 5, 6]], "interval": "x"}',
    b'{"inputs": [[1, 2, 3, 4, 5, 6]], "other": 1}', b'{"inputs": [[[[[[[[[[1]]]]]]]]]]}',
    b'{"inputs": [[' + b"9" * 5000 + b"]]}", b"\x93NUMPY\x01\x00\x05\x00{[(,\n",
    b"\x93NUMPY\x01\x00\x46\x00{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000,), }  ",
)  # fmt: skip
"""Bodies of requests that must be refused."""


@pytest.mark.slow
@pytest.mark.usefixtures("arrays", "called_once")
def test_the_service_predicts_and_refuses_malformed_requests(tmp_path: Path) -> None:
    target = rows("gaussian")[0].target
    model, shape = model_of("gaussian", rows("gaussian")[0])
    exporting.export(model, describe(shape, target), tmp_path / "model")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    script = [sys.executable, str(tmp_path / "model" / "serve.py"), "--port", str(port)]
    with subprocess.Popen(script, cwd=tmp_path) as service:
        try:
            answer = ask(port, b'{"inputs": [[1, 2, 3, 4, 5, 6]], "interval": 0.9}')
            (row,) = json.loads(answer[1])["predictions"]
            (name,) = target.names
            assert answer[0] == 200 and row[f"{name}_low"] < row[name] < row[f"{name}_high"]
            for content in MALFORMED:
                for kind in ("application/json", "application/octet-stream"):
                    status, text = ask(port, content, kind)
                    assert status == 400 and str(tmp_path) not in text, (content[:40], kind, text)
        finally:
            service.terminate()


def ask(port: int, content: bytes, kind: str = "application/json") -> tuple[int, str]:
    """Return the status and the text of the service's answer; wait up to 60 seconds for the service to start."""
    end = time.monotonic() + 60
    while True:
        try:
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
            connection.request("POST", "/predict", content, {"Content-Type": kind})
            response = connection.getresponse()
            return response.status, response.read().decode()
        except ConnectionRefusedError:
            if time.monotonic() > end:
                raise
            time.sleep(0.1)
        finally:
            connection.close()
