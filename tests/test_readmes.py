"""Every command of every README composes, and its plugins accept it; a user's files are not looked at."""

import re
import shlex
from functools import cache
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

from framework.configuration import composition
from framework.configuration.assembly import resolve_all
from framework.configuration.composition import command_line, folder, plain, register
from framework.configuration.config import Config
from framework.modes import MODES

ROOT = Path(__file__).parent.parent
READMES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("plugins/*/*/README.md"))]
FOLDERS = cache(composition.config_folders)
"""Found once for all commands."""
NOT_OURS = ("=mine", "=theirs", "X=", "resume=", "--")
"""Parts of commands that stand for a reader's own plugin, take their config from a run folder, or compose nothing."""


def commands(readme: Path) -> list[str]:
    """What follows `python -m framework`, in code blocks and between backticks, lines that go on joined."""
    text = re.sub("<[^>\n]*>", "X", readme.read_text(encoding="utf-8").replace("\\\n", " "))
    found = re.findall(r"python -m framework((?: [^`\n]*)?)", text)
    return [line.partition("   #")[0].partition(" # ")[0].strip() for line in found]


ALL = [
    (readme, command)
    for readme in READMES
    for command in commands(readme)
    if command and not any(part in command for part in NOT_OURS)
]


def jobs(command: str) -> list[str]:
    """Arguments without the flag of a sweep, and the first value of each key that is swept over."""
    words = shlex.split(command)
    arguments, swept = [word for word in words if word not in ("-m", "...", "…")], "-m" in words
    first = re.compile(r"^([^=]+=)([^\[{'\"(]*?),.*$")
    arguments = [first.sub(r"\1\2", word) if swept else word for word in arguments]
    return [word for word in arguments if not word.startswith("hydra") and "=tag(" not in word]


@pytest.mark.parametrize("readme, command", ALL, ids=[f"{one.parent.name}: {said[:60]}" for one, said in ALL])
def test_a_command_of_a_readme_composes(
    readme: Path, command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(composition, "config_folders", FOLDERS)
    arguments = jobs(command)
    register()
    try:
        with initialize_config_dir(str(folder()), version_base="1.3"):
            composed = compose("config", overrides=["experiment_name=test", *command_line(arguments)])
    finally:
        GlobalHydra.instance().clear()
    config = Config.of(plain(composed), tmp_path, arguments)
    assert config.mode in MODES
    if config.mode == "train":
        assert resolve_all(config.values)["data"]


def test_there_are_many() -> None:
    assert len(ALL) > 70


def test_the_readme_leads_to_every_plugin_and_every_benchmark() -> None:
    text = READMES[0].read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 120
    wanted = [*ROOT.glob("plugins/*/*/README.md"), *ROOT.glob("benchmarks/*.md")]
    assert not [str(page) for page in wanted if f"({page.relative_to(ROOT)})" not in text]
    linked = re.findall(r"\]\(((?!https)[^)]*)\)", text)
    assert not [path for path in linked if not (ROOT / path).exists()]
