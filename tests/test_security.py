"""Claims of SECURITY.md, each of which names a test that exists."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_each_claim_names_its_test() -> None:
    text = (ROOT / "SECURITY.md").read_text(encoding="utf-8")
    trusted = text.partition("## What is trusted")[2].partition("## What this does not cover")[0]
    claims = re.split(r"\n- ", trusted)[1:]
    assert len(claims) > 15
    for claim in claims:
        named = re.findall(r"`((?:tests|plugins)/[\w/]+\.py)(?:::(\w+))?`", claim)
        assert named, f"names no test: {claim}"
        for file, test in named:
            path = ROOT / file
            assert path.is_file(), f"{file} does not exist"
            tree = ast.parse(path.read_text(encoding="utf-8"))
            functions = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
            assert not test or test in functions, f"{file} has no test {test}"
