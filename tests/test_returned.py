"""Parts of a model that return something wrong are named, with the line, before the training."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor, nn
from torch.distributions import Distribution, Independent, Normal

from framework.data import Data, Splits
from framework.density_head import DensityHead
from framework.encoder import Encoder
from framework.errors import ConfigError, DataError
from framework.evaluation.splits import numbers
from framework.metric import Metric
from framework.model import Model, Predictor
from framework.runs.returned import check_parts, require_inputs, require_losses, require_splits
from framework.target import Target
from framework.uncertainty import Uncertainty

TARGET = Target("real", ("height", "width"))
INPUTS, TRUTH = torch.randn(3, 4), torch.randn(3, 2)


class Line(Encoder):
    bibtex = ""

    def __init__(self, change: Callable[[Tensor], Any] = lambda features: features) -> None:
        super().__init__()
        self.layer = nn.Linear(4, 5)
        self.change = change
        self.output_shape = (5,)

    def forward(self, inputs: Tensor) -> Tensor:
        return self.change(self.layer(inputs))


class Plain(DensityHead):
    bibtex = ""
    size = 2

    def __init__(
        self, change: Callable[[Tensor], Any] = lambda raw: Independent(Normal(raw, 1.0), 1)
    ) -> None:
        super().__init__()
        self.change = change

    def forward(self, raw: Tensor) -> Distribution:
        return self.change(raw)


class Loss(Plain):
    def __init__(self, change: Callable[[Tensor], Any]) -> None:
        super().__init__()
        self.change_loss = change

    def loss(self, raw: Tensor, target: Tensor) -> Tensor:
        return self.change_loss(super().loss(raw, target))


class Wrapper(Uncertainty):
    bibtex = ""

    def __init__(self, model: Predictor, change: Callable[[Distribution], Any]) -> None:
        super().__init__()
        self.model = model
        self.change = change

    def forward(self, inputs: Tensor) -> Distribution:
        return self.change(self.model(inputs))


def rehearse(predictor: Predictor) -> None:
    with torch.no_grad(), check_parts(predictor, TARGET):
        predictor(INPUTS)
        require_losses(predictor.loss(INPUTS, TRUTH), predictor, len(INPUTS))


FAULTS: dict[str, tuple[Predictor, str]] = {
    "one feature fewer": (
        Model([Line(lambda features: features[:, 1:])], Plain()),
        r"Line returned a tensor of shape \(3, 4\) for 3 samples, but its output_shape \(5,\).*Line\.forward",
    ),
    "features of the whole batch": (
        Model([Line(lambda features: features.mean(0))], Plain()),
        r"Line returned a tensor of shape \(5,\) for 3 samples",
    ),
    "features in double precision": (
        Model([Line(Tensor.double)], Plain()),
        r"features of type torch\.float64, but its parameters have the type torch\.float32.*Line\.forward",
    ),
    "no features": (Model([Line(lambda _: None)], Plain()), "Line returned an object of type NoneType"),
    "raw parameters for a density": (
        Model([Line()], Plain(lambda raw: raw)),
        r"Plain returned a tensor of shape \(3, 2\), but a torch\.distributions\.Distribution.*Plain\.forward",
    ),
    "a pair for a density": (
        Model([Line()], Plain(lambda raw: (raw, 1))),
        "Plain returned an object of type tuple",
    ),
    "numbers for samples": (
        Model([Line()], Plain(lambda raw: Normal(raw, 1.0))),
        r"Plain returned a Normal with the batch_shape \(3, 2\) and the event_shape \(\), but \(3,\) and \(2,\).*"
        "Independent",
    ),
    "one number of two": (
        Model([Line()], Plain(lambda raw: Independent(Normal(raw[:, :1], 1.0), 1))),
        r"batch_shape \(3,\) and the event_shape \(1,\), but \(3,\) and \(2,\)",
    ),
    "a mean of losses": (
        Model([Line()], Loss(Tensor.mean)),
        r"training loss of 3 samples is a tensor of shape \(\).*Loss\.loss \(tests/test_returned\.py, line \d+\)",
    ),
    "losses of all pairs": (
        Model([Line()], Loss(lambda loss: loss - loss[:, None])),
        r"a tensor of shape \(3, 3\)",
    ),
    "a mean for a mixture": (
        Wrapper(Model([Line()], Plain()), lambda density: density.mean),
        r"Wrapper returned a tensor of shape \(3, 2\).*Wrapper\.forward",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_the_part_at_fault_is_named(name: str) -> None:
    predictor, message = FAULTS[name]
    with pytest.raises(ConfigError, match=message):
        rehearse(predictor)


class Points(Data):
    bibtex = ""
    groups = ("points",)
    synthetic = True
    target = TARGET

    def __init__(self, input_shape: tuple[int, ...], returned: Any = None) -> None:
        self.input_shape = input_shape
        self.returned = returned

    def prepare(self) -> None: ...

    def splits(self) -> Splits:
        return self.returned

    def read(self, files: Any) -> Any: ...

    def augment(self, batch: Any) -> Any:
        return batch

    def fingerprint(self) -> dict[str, str]:
        return {}

    def preview(self, inputs: Tensor) -> Any: ...


@pytest.mark.parametrize("stated, given", [((4,), (4,)), ((9, 3), (7, 3)), ((3, 8, 8), (3, 8, 8))])
def test_inputs_of_the_stated_shape_pass(stated: tuple[int, ...], given: tuple[int, ...]) -> None:
    require_inputs({"input": torch.zeros(2, *given)}, Points(stated))


@pytest.mark.parametrize(
    "stated, given", [((2,), (1,)), ((9, 3), (10, 3)), ((9, 3), (9, 4)), ((3, 8, 8), (8, 8, 3))]
)
def test_inputs_of_another_shape_are_refused(stated: tuple[int, ...], given: tuple[int, ...]) -> None:
    message = (
        rf"Points gives inputs of shape {re.escape(str(given))}, .* input_shape = {re.escape(str(stated))}"
    )
    with pytest.raises(DataError, match=rf"{message}.*Points\.prepare \(tests/test_returned\.py, line \d+\)"):
        require_inputs({"input": torch.zeros(2, *given)}, Points(stated))


def test_splits_of_another_type_are_refused() -> None:
    splits = Splits([], [], [])  # type: ignore[arg-type]
    assert require_splits(Points((1,), splits)) is splits
    with pytest.raises(
        DataError, match=r"Points\.splits returned an object of type tuple.*Splits\(train, validation"
    ):
        require_splits(Points((1,), ([], [], [])))


class Count(Metric):
    bibtex = ""
    columns: ClassVar[dict[str, str]] = {"count": "number"}

    def __init__(self, returned: Any) -> None:
        super().__init__()
        self.returned = returned

    def update(self, prediction: Any) -> None: ...

    def compute(self) -> Any:
        return self.returned


@pytest.mark.filterwarnings("ignore:The ``compute`` method")
@pytest.mark.parametrize(
    "returned, given", [(torch.ones(()), "a Tensor"), ({"cuont": torch.ones(())}, "cuont")]
)
def test_a_metric_without_the_numbers_of_its_columns_is_refused(returned: Any, given: str) -> None:
    assert numbers([Count({"count": torch.ones(()), "further": torch.ones(())})]) == {
        "count": 1.0,
        "further": 1.0,
    }
    with pytest.raises(ConfigError, match=rf"Count\.compute returns {given}, .* required: count\."):
        numbers([Count(returned)])


def test_right_parts_pass_and_are_left_as_they_are() -> None:
    predictor = Wrapper(
        Model(
            [
                Line(),
            ],
            Plain(),
        ),
        lambda density: density,
    )
    rehearse(predictor)
    assert not any(module._forward_hooks for module in predictor.modules())


def test_the_line_is_that_of_the_method() -> None:
    with pytest.raises(ConfigError) as raised:
        rehearse(FAULTS["one feature fewer"][0])
    line = int(str(raised.value).rpartition("line ")[2].rstrip(")."))
    assert "def forward" in Path(__file__).read_text(encoding="utf-8").splitlines()[line - 1]
