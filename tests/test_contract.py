"""The contract of every installed plugin: a row in its `rows.py` buys every test.

The first row of each registry is always tested; the others are slow tests, which .ci/run runs with checked types. All
rows of a plugin: `pytest tests/test_contract.py -m "" -k <name>`.
"""

import pytest

from framework.configuration.registry import installed
from framework.testing.contract import CONTRACTS, Row, contract
from framework.testing.finding import require
from tests.conftest import first_of_each

CHEAP = {"density_head": "gaussian"}
"""Plugins of registries whose first plugin is slow to check: the quick tests check these plugins instead."""
ROWS = [
    (group, name, row)
    for group in CONTRACTS
    for name in sorted(installed(group), key=lambda name: name != CHEAP.get(group))
    for row in contract(group, name).rows
]


@pytest.mark.parametrize(
    "group, name, row",
    first_of_each(ROWS, lambda case: case[0], lambda case: f"{case[0]} {case[1]}: {case[2].name}"),
)
def test_contract(group: str, name: str, row: Row) -> None:
    require(*contract(group, name).findings(row))
