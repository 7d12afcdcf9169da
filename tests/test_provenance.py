"""Where a result comes from."""

import subprocess
from importlib.metadata import version
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.runs.provenance import flatten, git_commit, package_versions


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for role in ("AUTHOR", "COMMITTER"):
        monkeypatch.setenv(f"GIT_{role}_NAME", "nobody")
        monkeypatch.setenv(f"GIT_{role}_EMAIL", "nobody@localhost")
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", "/dev/null")
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    folder = tmp_path / "repository"
    folder.mkdir()
    git(folder, "init", "-q")
    return folder


def git(folder: Path, *arguments: str) -> str:
    return subprocess.run(
        ["git", "-C", folder, *arguments], check=True, capture_output=True, text=True
    ).stdout


def test_commit_and_whether_files_differ(repository: Path) -> None:
    assert git_commit(repository) == {}  # no commit yet
    (repository / "a.py").write_text("1")
    git(repository, "add", "a.py")
    git(repository, "commit", "-q", "-m", "first")
    commit = git(repository, "rev-parse", "HEAD").strip()
    assert git_commit(repository) == {"commit": commit, "dirty": "false"}
    (repository / "outputs").write_text("not tracked")
    assert git_commit(repository) == {"commit": commit, "dirty": "false"}
    (repository / "a.py").write_text("2")
    (repository / "inside").mkdir()
    assert git_commit(repository / "inside") == {"commit": commit, "dirty": "true"}


def test_no_repository_no_folder_no_git(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    assert git_commit(tmp_path) == {}
    assert git_commit(tmp_path / "missing") == {}
    monkeypatch.setenv("PATH", str(tmp_path))
    assert git_commit(tmp_path) == {}


def test_a_git_that_hangs_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def hangs(*arguments: object, **options: float) -> None:
        raise subprocess.TimeoutExpired("git", options["timeout"])

    monkeypatch.setattr(subprocess, "run", hangs)
    assert git_commit(tmp_path) == {}


def test_versions_name_what_a_result_rests_on() -> None:
    found = package_versions()
    assert found["torch"] == version("torch")
    assert found["hydra-core"] == version("hydra-core")
    assert found["robust-visual-learning"] == version("robust-visual-learning")  # it provides plugins
    assert found["python"].startswith("3.")


def test_flatten() -> None:
    config = {
        "seed": 0,
        "head": {"name": "mixture", "parts": [{"n": 1}, {"n": 2}]},
        "sizes": [1, 2],
        "e": {},
        "l": [],
    }
    assert flatten(config) == {
        "seed": 0,
        "head.name": "mixture",
        "head.parts.0.n": 1,
        "head.parts.1.n": 2,
        "sizes": [1, 2],
        "e": {},
        "l": [],
    }
    assert flatten({}) == {}
    assert flatten({"text": "abc", "bytes": None}) == {"text": "abc", "bytes": None}


plain = st.none() | st.booleans() | st.integers() | st.text(max_size=3)
trees = st.recursive(
    plain,
    lambda child: (
        st.lists(child, max_size=3) | st.dictionaries(st.text("abc", min_size=1, max_size=2), child)
    ),
)


@settings(deadline=None, max_examples=100)
@given(st.dictionaries(st.text("abc", min_size=1, max_size=2), trees, max_size=4))
def test_flatten_loses_nothing(config: dict[str, object]) -> None:
    for key, leaf in flatten(config).items():
        node: object = config
        for part in key.split("."):
            node = node[int(part)] if isinstance(node, list) else node[part]  # type: ignore[index]
        assert node == leaf

    def count(node: object) -> int:
        if isinstance(node, dict) and node:
            return sum(map(count, node.values()))
        if isinstance(node, list) and any(isinstance(item, dict | list) for item in node):
            return sum(map(count, node))
        return 1

    assert len(flatten(config)) == (count(config) if config else 0)
