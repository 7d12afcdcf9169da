"""Tests of the Lorentzian head: its stored state is empty, and other targets are refused."""

import pytest

from framework.errors import ConfigError
from framework.spectra.spectrum import PRESETS
from framework.target import Target
from plugins.density_head.lorentzian.head import LorentzianHead


def test_the_head_holds_nothing_that_was_fitted():
    head = LorentzianHead(Target("real", PRESETS["ten"].target))
    assert not head.state_dict()


def test_a_target_of_other_numbers_is_refused():
    with pytest.raises(
        ConfigError,
        match=r"fits 10 or 15 parameters of Lorentzian lines.*targets of this data set are x, y\.",
    ):
        LorentzianHead(Target("real", ("x", "y")))
