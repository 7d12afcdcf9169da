"""Contract tests of encoders of point clouds: a correct encoder passes, and each faulty one fails the test made for
its fault."""

import pytest
import torch

from framework.encoder import Encoder
from framework.errors import ConfigError, DataError
from framework.geometry.clouds import require_clouds, sizes
from framework.testing.encoders import examine_encoder
from framework.testing.finding import failures, require
from framework.testing.rows import CloudRow

ROW = CloudRow("mean and spread", (12, 4))


class Moments(Encoder):
    """Encoder that returns the mean and mean square of each column over the points without padding."""

    bibtex = ""

    def __init__(self, input_shape):
        super().__init__()
        require_clouds(input_shape, by="encoder moments")
        self.output_shape = (2 * input_shape[1],)

    def forward(self, inputs):
        counts = sizes(inputs)[:, None].to(inputs)
        points = inputs.where(~inputs.isnan(), 0)
        return torch.cat([points.sum(1), points.square().sum(1)], 1) / counts


class Padded(Moments):
    """Encoder that reads padding as points at 0."""

    def forward(self, inputs):
        return super().forward(inputs.nan_to_num(0))


class First(Moments):
    """Encoder whose features depend on which point is first."""

    def forward(self, inputs):
        return super().forward(inputs) + inputs[:, 0, :1]


class Leaking(Moments):
    """Encoder in which padding makes the gradient NaN (NaN times 0), though not the features."""

    def forward(self, inputs):
        return super().forward(inputs) + inputs.square().where(~inputs.isnan(), 0).sum((1, 2))[:, None]


class Silent(Moments):
    """Encoder that leaves out points that are not finite, without an error."""

    def forward(self, inputs):
        return super().forward(inputs.where(inputs.isfinite().all(-1, keepdim=True), torch.nan))


class Vague(Moments):
    """Encoder whose error messages do not name the input."""

    def forward(self, inputs):
        try:
            return super().forward(inputs)
        except DataError as error:
            raise DataError("bad cloud") from error


class Greedy(Moments):
    """Encoder that accepts any input."""

    def __init__(self, input_shape):
        super().__init__((1, 3))
        self.output_shape = (2 * input_shape[-1],)


class Curt(Moments):
    """Encoder whose error messages do not state the input that it got."""

    def __init__(self, input_shape):
        if len(input_shape) != 2 or input_shape[1] < 3:
            raise ConfigError("no cloud")
        super().__init__(input_shape)


def test_a_sound_encoder_passes():
    require(*examine_encoder(ROW, Moments))


@pytest.mark.parametrize(
    "kind, caught",
    [
        (Padded, "padding"),
        (First, "points in any order"),
        (Leaking, "gradients of padding"),
        (Silent, "bad clouds are named"),
        (Vague, "bad clouds are named"),
        (Greedy, "inputs that are not clouds are refused"),
        (Curt, "inputs that are not clouds are refused"),
    ],
)
def test_an_unsound_encoder_is_caught(kind, caught):
    assert caught in failures(examine_encoder(ROW, kind))


def test_what_a_row_leaves_out_is_not_examined():
    row = CloudRow("first", ROW.input_shape, leave_out={"points in any order": "the first counts"})
    findings = list(examine_encoder(row, First))
    require(*findings)
    assert "points in any order" not in [finding.name for finding in findings]
