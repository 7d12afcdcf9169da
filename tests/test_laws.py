"""Rules of the design that the import linter (pyproject.toml) does not check, read from the source."""

import ast
import re
import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).resolve().parent.parent
CORE = sorted((ROOT / "framework").rglob("*.py"))
PLUGINS = sorted(path for path in (ROOT / "plugins").rglob("*.py") if path.parent != ROOT / "plugins")


MATHEMATICS = {
    "points",
    "projection",
    "temperature",
    "mixture",
    "categorical",
    "bernoulli",
    "quantiles",
    "laplace",
}
"""Entry points whose names are mathematical terms, which the framework may use."""


def faults(paths: list[Path], find: Callable[[Path], Iterable[object]]) -> dict[str, list[object]]:
    """Return the findings of `find` by file, for the files with at least one finding."""
    found = {str(path.relative_to(ROOT)): list(find(path)) for path in paths}
    return {name: lines for name, lines in found.items() if lines}


def test_the_house_has_its_rooms() -> None:
    contracts = {
        "target",
        "data",
        "encoder",
        "density_head",
        "uncertainty",
        "objective",
        "renderer",
        "metric",
    }
    face = {"__init__", "__main__", "app"}
    assert {path.stem for path in (ROOT / "framework").glob("*.py")} == {
        *contracts,
        *face,
        "prediction",
        "model",
        "errors",
    }


def entry_points() -> dict[str, dict[str, str]]:
    """Return the project's own entry points by registry and name."""
    groups = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]
    return {group.removeprefix("framework."): entries for group, entries in groups.items()}


def names_of_methods() -> set[str]:
    return {name for group, entries in entry_points().items() if group != "conf" for name in entries}


def test_a_plugin_stands_in_the_folder_of_its_registry() -> None:
    elsewhere = {
        f"{group} {name}": value.rpartition(".")[0]
        for group, entries in entry_points().items()
        for name, value in entries.items()
        if group != "conf" and not value.startswith(f"plugins.{group}.")
    }
    assert not elsewhere


def test_the_core_names_no_method() -> None:
    methods = names_of_methods() - MATHEMATICS
    assert len(methods) > 50

    def named(path: Path) -> Iterator[str]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            match node:
                case ast.Constant(value=str(word)) | ast.Name(id=word) | ast.Attribute(attr=word):
                    pass
                case (
                    ast.FunctionDef(name=word)
                    | ast.ClassDef(name=word)
                    | ast.arg(arg=word)
                    | ast.keyword(arg=str(word))
                ):
                    pass
                case _:
                    continue
            if word.lower() in methods:
                yield f"line {getattr(node, 'lineno', '?')}: {word}"

    assert not faults(CORE, named)


def modules_of(folder: Path) -> dict[str, Path]:
    """Return the files below `folder` by the names of their modules."""
    files: dict[str, Path] = {}
    for top in ("framework", "plugins", "hydra_plugins"):
        for path in sorted((folder / top).rglob("*.py")):
            parts = path.relative_to(folder).with_suffix("").parts
            files[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return files


def imported(path: Path, modules: Collection[str]) -> Iterator[str]:
    """Yield the modules that a file imports, also within functions; not what only type checkers import."""
    waiting: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            waiting += node.orelse
            continue
        waiting += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)
        elif isinstance(node, ast.ImportFrom):
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                if full in modules or node.module in modules:
                    yield full if full in modules else str(node.module)


def circles(folder: Path) -> set[frozenset[str]]:
    """Return the largest groups of modules each of which leads to each other by imports."""
    modules = modules_of(folder)
    number = {name: index for index, name in enumerate(modules)}
    pairs = [
        (number[name], number[other]) for name, path in modules.items() for other in imported(path, modules)
    ]
    start, end = np.array(pairs, int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(pairs)), (start, end)), shape=(len(number),) * 2)
    groups = connected_components(graph, connection="strong")[1]
    found = (
        frozenset(name for name, index in number.items() if groups[index] == group) for group in set(groups)
    )
    return {names for names in found if len(names) > 1}


def test_modules_import_each_other_in_no_circle() -> None:
    assert not circles(ROOT)


def test_a_circle_is_found_wherever_the_import_stands(tmp_path: Path) -> None:
    room = tmp_path / "framework" / "room"
    room.mkdir(parents=True)
    (tmp_path / "framework/__init__.py").touch()
    (room / "__init__.py").write_text("def late():\n    from framework.room import first\n")
    (room / "first.py").write_text("from framework.room.second import some\n")
    (room / "second.py").write_text("import framework.room.first\nfrom framework.room.third import some\n")
    (room / "third.py").write_text(
        "from typing import TYPE_CHECKING\n\nif TYPE_CHECKING:\n    from framework.room.first import some\n"
    )
    assert circles(tmp_path) == {frozenset({"framework.room.first", "framework.room.second"})}
    (room / "third.py").write_text("def late():\n    from framework.room import some\n")
    assert circles(tmp_path) == {
        frozenset({"framework.room", *(f"framework.room.{name}" for name in ("first", "second", "third"))})
    }


def test_the_contracts_checks_are_for_rows_and_tests() -> None:
    code = [path for path in PLUGINS if path.name != "rows.py" and not path.name.startswith("test_")]
    assert not faults(code, lambda path: re.findall("framework.testing", path.read_text(encoding="utf-8")))


def test_nothing_instantiates_from_a_config_or_loads_pickles() -> None:
    bad = "hydra.utils import|weights_only=False|allow_pickle=True"
    assert not faults(CORE + PLUGINS, lambda path: re.findall(bad, path.read_text(encoding="utf-8")))


NOT_IN_THE_THESIS = {
    "data/coil20",
    "data/image_folder",
    "data/images_with_angles",
    "data/pose_from_image",
    "data/tabular",
    "density_head/bernoulli_image",
    "density_head/fit_pose",
    "density_head/laplace_image",
    "density_head/quantiles",
    "density_head/student_t",
    "encoder/normal_scores",
    "encoder/resnet",
    "metric/coverage",
    "metric/crps",
    "metric/decision_cost",
    "metric/errors",
    "metric/mutual_information",
    "metric/pit",
    "metric/pixel_uncertainty",
    "metric/pose_error",
    "metric/prediction_set",
    "metric/risk_coverage",
    "uncertainty/batch_ensemble",
    "uncertainty/conformal",
    "uncertainty/feature_score",
    "uncertainty/folds",
    "uncertainty/laplace",
    "uncertainty/swag",
}
"""Plugin folders whose methods and data the thesis does not have; their pages do not compare with it."""


def test_plugin_folders_explain_themselves() -> None:
    folders = sorted(
        path for path in (ROOT / "plugins").glob("*/*") if path.is_dir() and path.name != "__pycache__"
    )
    assert len(folders) > 40

    def wanting(folder: Path) -> Iterator[str]:
        readme = folder / "README.md"
        if not readme.is_file():
            yield "README.md"
        else:
            text = readme.read_text(encoding="utf-8")
            paragraphs = re.findall(r"^\*\*Differs from the thesis\*\*: (?=\S)", text, re.MULTILINE)
            if str(folder.relative_to(ROOT / "plugins")) in NOT_IN_THE_THESIS:
                if paragraphs:
                    yield "no paragraph '**Differs from the thesis**', since the thesis does not have this method"
            elif len(paragraphs) != 1:
                yield "one paragraph '**Differs from the thesis**: …' in README.md, be it 'in nothing.'"
            if not re.search(r"python -m (framework|plugins)", text):
                yield "a command to run in README.md"
        if not list(folder.rglob("test_*.py")):
            yield "test_*.py"
        if not list(folder.rglob("conf/**/*.yaml")):
            yield "conf/**/*.yaml"

    assert not faults(folders, wanting)


def test_tests_import_mlflow_without_a_change_to_others() -> None:
    """An import at the top of a test file changes the process in which all other tests run."""
    files = [
        *sorted((ROOT / "tests").rglob("*.py")),
        *(path for path in PLUGINS if path.name.startswith("test_")),
    ]

    def unguarded(path: Path) -> Iterator[str]:
        for statement in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(statement, ast.With) and "importing_mlflow" in ast.unparse(statement.items[0]):
                continue
            if isinstance(statement, ast.Import | ast.ImportFrom | ast.With | ast.Try | ast.If):
                names = [
                    alias.name if isinstance(node, ast.Import) else str(node.module)
                    for node in ast.walk(statement)
                    if isinstance(node, ast.Import | ast.ImportFrom)
                    for alias in node.names
                ]
                yield from (
                    name for name in names if name.split(".")[0] == "mlflow" or name.endswith("mlflow_store")
                )

    assert faults(files, unguarded) == {}


def test_a_long_constructor_says_why() -> None:
    """A comment stands above each constructor of more than eight parameters."""

    def unexplained(path: Path) -> Iterator[str]:
        text = path.read_text(encoding="utf-8")
        if "def __init__" not in text:
            return
        lines = text.splitlines()
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef) and node.name == "__init__":
                parameters = len([*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]) - 1
                if parameters > 8 and not lines[node.lineno - 2].strip().startswith("#"):
                    yield f"line {node.lineno}: {parameters} parameters"

    files = [
        path
        for room in ("framework", "plugins", "hydra_plugins", "benchmarks", "reproduction")
        for path in sorted((ROOT / room).rglob("*.py"))
    ]
    assert faults(files, unexplained) == {}
