"""The checks of shapes and types that `CHECK_TYPES=1` switches on."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
import conftest, torch
from framework.geometry import quaternions
from framework.testing.finding import seed
ended = []
for call in (
    lambda: quaternions.product(torch.zeros(2, 3), torch.zeros(2, 4)),  # a shape
    lambda: seed("0"),  # a type, in a signature without shapes
    lambda: quaternions.product(torch.zeros(2, 4), torch.zeros(2, 4)),  # right
):
    try:
        call()
        ended.append("passed")
    except Exception as error:
        ended.append(type(error).__name__)
print(*ended)
"""


@pytest.mark.slow
def test_a_wrong_shape_and_a_wrong_type_are_found_and_right_calls_pass() -> None:
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", SCRIPT],
        cwd=Path(__file__).parent.parent,
        env={**os.environ, "CHECK_TYPES": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    shape, kind, right = done.stdout.split()
    assert "Check" in shape or "Violation" in shape
    assert "Violation" in kind
    assert right == "passed"
