"""The contract of every installed plugin: a row in its `rows.py` buys every test."""

import pytest

from framework.configuration.registry import installed
from framework.testing.contract import CONTRACTS, Row, contract
from framework.testing.finding import require

ROWS = [
    pytest.param(group, name, row, id=f"{group} {name}: {row.name}")
    for group in CONTRACTS
    for name in installed(group)
    for row in contract(group, name).rows
]


@pytest.mark.parametrize("group, name, row", ROWS)
def test_contract(group: str, name: str, row: Row) -> None:
    require(*contract(group, name).findings(row))
