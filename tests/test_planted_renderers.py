"""Planted faults in renderers, each found by its own contract test of `mode=check`; correct renderers pass."""

import pytest

from framework.testing.finding import require
from framework.testing.renderers import examine_renderer
from framework.testing.rows import RendererRow
from tests.conftest import first_of_each
from tests.planted_renderers import ALL, ALL_FAULTS, RIGHT, Fault


@pytest.mark.parametrize("fault", first_of_each(ALL_FAULTS, lambda fault: fault.by, lambda fault: fault.name))
def test_the_fault_is_found(fault: Fault) -> None:
    others = {name: "another test's" for name in ALL if name != fault.by}
    (found,) = examine_renderer(RendererRow("", leave_out=others), fault.build)
    assert found.name == fault.by and not found.holds


@pytest.mark.parametrize("name", RIGHT)
def test_a_right_renderer_passes(name: str) -> None:
    build, left_out = RIGHT[name]
    require(*examine_renderer(RendererRow("", leave_out=left_out), build))
