"""Beginnings of docstrings, which are a verb in the imperative or a noun phrase, and names that say nothing."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PREPOSITIONS = (
    *(
        "About",
        "Above",
        "Against",
        "Among",
        "At",
        "Below",
        "Beside",
        "Between",
        "Beyond",
        "By",
        "For",
        "From",
        "In",
    ),
    *("Into", "Of", "On", "Over", "Through", "To", "Under", "Until", "With", "Within", "Without"),
)
DANGLING = (
    "After",
    "Before",
    "How",
    "Like",
    "Likewise",
    "Than",
    "Those",
    "What",
    "Whatever",
    "When",
    "Where",
)
UNCLEAR = ("Whether", "Which", "While", "Who", "Whoever")
BANNED = frozenset({*PREPOSITIONS, *DANGLING, *UNCLEAR})
"""First words of docstrings that a reader has to read twice (a colleague would not begin a sentence so)."""
ROOMS = ("framework", "plugins", "hydra_plugins", "tests", "benchmarks", "reproduction")
VAGUE = frozenset(
    (
        *(
            "found",
            "told",
            "said",
            "given",
            "one",
            "drawn",
            "apart",
            "there",
            "here",
            "asked",
            "kept",
            "held",
            "taken",
        ),
        *("seen", "came", "made", "done", "each", "such", "thing", "what"),
    )
)
"""Names that do not say what a variable, function or class holds or does."""
MOST_VAGUE = 40
"""Largest number of vague names in the code; a few are keys of stored states, which must not change."""


def docstrings(tree: ast.AST) -> Iterator[str]:
    """Yield the docstrings of a module, its classes and functions, and of attributes and constants."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if not isinstance(body, list):
            continue
        documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        for number, statement in enumerate(body):
            text = statement.value if isinstance(statement, ast.Expr) else None
            follows = number > 0 and isinstance(body[number - 1], ast.Assign | ast.AnnAssign)
            if (
                isinstance(text, ast.Constant)
                and isinstance(text.value, str)
                and (follows or (documented and number == 0))
            ):
                yield text.value


@pytest.mark.parametrize("room", ROOMS)
def test_docstrings_begin_with_a_verb_or_a_noun(room: str) -> None:
    unclear = [
        f"{path.relative_to(ROOT)}: {text.strip().partition(chr(10))[0]}"
        for path in sorted((ROOT / room).rglob("*.py"))
        if room == "tests" or not path.name.startswith("test_")
        for text in docstrings(ast.parse(path.read_text(encoding="utf-8")))
        if text.split(None, 1)[0].rstrip(",:") in BANNED
    ]
    assert not unclear, "\n".join(unclear)


def vague_names(tree: ast.AST) -> Iterator[str]:
    """Yield the vague names that a module assigns or defines: variables, attributes, parameters, functions, classes."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                name = name.lower()
            case (
                ast.Name(id=name, ctx=ast.Store())
                | ast.Attribute(attr=name, ctx=ast.Store())
                | ast.arg(arg=name)
            ):
                pass  # constants in capitals, such as HERE for the folder of a script, do not count
            case _:
                continue
        if name.strip("_") in VAGUE:
            yield f"line {getattr(node, 'lineno', '?')}: {name}"


def test_names_say_what_they_hold() -> None:
    folders = ("framework", "plugins", "hydra_plugins", "benchmarks", "reproduction")
    vague = [
        f"{path.relative_to(ROOT)}, {name}"
        for folder in folders
        for path in sorted((ROOT / folder).rglob("*.py"))
        if not path.name.startswith("test_")
        for name in vague_names(ast.parse(path.read_text(encoding="utf-8")))
    ]
    assert len(vague) <= MOST_VAGUE, "\n".join(vague)


def test_a_vague_name_of_each_kind_is_found() -> None:
    source = "one = 1\nself.kept = one\ndef told(given, *, made=one): pass\nclass Seen: pass\nfor each in one: pass"
    names = [name.rpartition(" ")[2] for name in vague_names(ast.parse(source))]
    assert sorted(names) == ["each", "given", "kept", "made", "one", "seen", "told"]


def test_a_docstring_of_each_kind_is_read() -> None:
    source = '"""Module."""\nLIMIT = 1\n"""Limit."""\nclass A:\n    """Class."""\n\n    def f(self):\n        """Do."""'
    assert [*docstrings(ast.parse(source))] == ["Module.", "Limit.", "Class.", "Do."]
