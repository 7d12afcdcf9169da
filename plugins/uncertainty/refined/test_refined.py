"""Tests that the wrapper returns a fit which starts from the wrapped model's prediction."""

import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.distributions.protocol import median
from framework.errors import ConfigError
from framework.model import Model
from framework.spectra.fit import fit
from framework.spectra.offsets import OFFSETS
from framework.spectra.spectrum import PRESETS, spectrum
from framework.target import Target
from plugins.uncertainty.refined.wrapper import Refined

PLACES = torch.tensor(OFFSETS, dtype=torch.float64)
TEN = PRESETS["ten"]


def model(target: Target, length: int) -> Model:
    """Return a linear model with random weights."""
    torch.manual_seed(0)
    head = build("density_head", resolve("density_head", "gaussian"), target=target)
    return Model([], head, (length,))


def test_a_fit_begins_where_the_model_says():
    wrapped = model(Target("real", TEN.target), len(OFFSETS))
    refined = Refined(lambda: wrapped, steps=3).eval()
    spectra = spectrum(torch.tensor([TEN.start, TEN.second_start], dtype=torch.float64), PLACES).float()
    with torch.no_grad():
        density = refined(spectra)
        start = median(wrapped.eval()(spectra), 100)
    wanted = fit(spectra, PLACES, TEN, start=start, most=3)
    torch.testing.assert_close(density.mean, wanted.parameters[:, :10].to(density.mean), rtol=0, atol=0)


@pytest.mark.parametrize(("names", "length"), [(TEN.target, 5), (("x", "y"), len(OFFSETS))])
def test_data_of_other_numbers_are_refused(names: tuple[str, ...], length: int):
    refined = Refined(lambda: model(Target("real", names), length))
    with pytest.raises(
        ConfigError,
        match=rf"fits 10 or 15 parameters to spectra of {len(OFFSETS)} offsets.*have {length} numbers",
    ):
        refined(torch.rand(2, length))
