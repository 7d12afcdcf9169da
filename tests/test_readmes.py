"""Commands in all READMEs, the pages of docs/ and the page of claims, which must compose with settings that their
plugins accept; files are not read."""

import re
import shlex
from collections import Counter
from functools import cache
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

from framework.configuration import composition
from framework.configuration.command_line import command_line
from framework.configuration.composition import folder, plain, register
from framework.configuration.config import Config
from framework.modes import MODES
from tests.conftest import first_of_each
from tests.test_composition import EXPERIMENTS

ROOT = Path(__file__).parent.parent
CLAIMS = ROOT / "reproduction" / "claims.md"
READMES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted(ROOT.glob("docs/**/*.md")),
    CLAIMS,
    *sorted(ROOT.glob("plugins/*/*/README.md")),
]
FOLDERS = cache(composition.config_folders)
"""Found once for all commands."""
MODULES = ("benchmarks.", "reproduction.")
NOT_OURS = ("=mine", "=[my_metric]", "=my_laplace", "=theirs", "X=", "resume=", "--")
"""Parts of commands that stand for a reader's own plugin, take their config from a run folder, or compose nothing."""


def commands(readme: Path) -> list[str]:
    """Return the arguments of each `python -m framework` in code blocks and between backticks, with continued lines
    joined."""
    text = re.sub("<[^>\n]*>", "X", readme.read_text(encoding="utf-8").replace("\\\n", " "))
    found = re.findall(r"python -m framework((?: [^`\n]*)?)", text)
    return list(dict.fromkeys(line.partition("   #")[0].partition(" # ")[0].strip() for line in found))


ALL = [
    (readme, command)
    for readme in READMES
    for command in commands(readme)
    if command and not any(part in command for part in NOT_OURS)
]


def jobs(command: str) -> list[str]:
    """Return the arguments without the flag of a sweep, with only the first value of each swept key."""
    words = shlex.split(command.replace("checkpoint=last", "checkpoint=X"))  # there may be no run here
    arguments, swept = [word for word in words if word not in ("-m", "...", "…")], "-m" in words
    first = re.compile(r"^([^=]+=)(\[[^\]]*\]|[^\[{'\"(]*?),.*$")
    arguments = [first.sub(r"\1\2", word) if swept else word for word in arguments]
    return [
        word
        for word in arguments
        if not word.startswith("hydra") and not re.search(r"=(tag|range|interval)\(", word)
    ]


def distinct() -> list[tuple[Path, str]]:
    """Return each command once, without those that test_composition.py composes: those with an experiment alone."""
    first: dict[tuple[str, ...], tuple[Path, str]] = {}
    for readme, command in ALL:
        arguments = tuple(jobs(command))
        if len(arguments) > 1 or arguments[0].removeprefix("experiment=") not in EXPERIMENTS:
            first.setdefault(arguments, (readme, command))
    return list(first.values())


def keys(case: tuple[Path, str]) -> frozenset[str]:
    """Return the keys that a command sets."""
    return frozenset(word.partition("=")[0] for word in jobs(case[1]))


@pytest.mark.parametrize(
    "readme, command",
    first_of_each(distinct(), keys, lambda case: f"{case[0].parent.name}: {case[1][:60]}"),
)
def test_a_command_of_a_readme_composes(
    readme: Path, command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = jobs(command)
    monkeypatch.setattr(composition, "config_folders", FOLDERS)
    register()
    try:
        with initialize_config_dir(str(folder()), version_base="1.3"):
            composed = compose("config", overrides=["experiment_name=test", *command_line(arguments)])
    finally:
        GlobalHydra.instance().clear()
    config = Config.of(plain(composed), tmp_path, arguments)
    assert config.mode in MODES
    if config.mode == "train":
        assert config.assembly.parts["data"]


def test_the_pages_have_more_than_70_commands() -> None:
    assert len(ALL) > 70


def test_a_number_of_the_readmes_table_stands_on_the_page_it_links_to() -> None:
    number = re.compile(r"(?<![\w.])\d+(?:\.\d+)?")
    table = READMES[0].read_text(encoding="utf-8").partition("\n## Results\n")[2].partition("\n## ")[0]
    rows = [line.split("|")[1:-1] for line in table.splitlines() if line.startswith("|")][2:]
    assert len(rows) >= 4
    page: re.Match[str] | None = None
    for first, _, *told in rows:
        page = re.search(r"\((\w+/\w+/\w+\.md)\)", first) or page  # a row without a link is of the page above
        assert page
        there = [float(found) for found in number.findall((ROOT / page[1]).read_text(encoding="utf-8"))]
        for said in number.findall(" ".join(told)):
            # as it stands there, or rounded
            half = 0.5 * 10.0 ** -len(said.partition(".")[2])
            assert any(abs(float(said) - value) <= half + 1e-12 for value in there), f"{page[1]}: {said}"


def test_every_claim_has_evidence_a_verdict_and_a_command() -> None:
    text = CLAIMS.read_text(encoding="utf-8")
    rows = [re.split(r"(?<!\\)\|", line)[1:-1] for line in text.splitlines() if re.match(r"\| \d-\d", line)]
    verdicts: dict[str, Counter[str]] = {}
    for number, *filled, data, verdict, command in (map(str.strip, row) for row in rows):
        assert len(filled) == 3 and all(filled), number
        assert data in ("synthetic", "real", "none"), number
        said = re.fullmatch(r"holds|contradicted: .*\d SE.*|contradicted: a count|open(: .+)?", verdict)
        assert said, number
        verdicts.setdefault(number[0], Counter())[verdict.partition(":")[0]] += 1
        words = shlex.split(command.strip("`"))
        assert command == f"`{command.strip('`')}`" and words[0] in ("python", "pytest"), number
        files = [ROOT / word for word in words if word.startswith(("plugins/", "tests/"))]
        files += [ROOT / f"{word.replace('.', '/')}.py" for word in words if word.startswith(MODULES)]
        assert all(file.exists() for file in files), number
        if "-k" in words:  # a test of that name is there
            sources = [one for file in files for one in (file, *file.glob("test_*.py")) if one.is_file()]
            name = re.compile(rf"def test_\w*{words[-1]}")
            assert any(name.search(one.read_text(encoding="utf-8")) for one in sources), number
        named = re.findall(r"(?<=[=,])\w+/\w+(?=[,\s]|$)", command.strip("`"))
        assert all((ROOT / "conf/experiment" / f"{name}.yaml").exists() for name in named), number
    assert [row[0].strip() for row in rows] == [
        f"{chapter}-{index}" for chapter, found in verdicts.items() for index in range(1, found.total() + 1)
    ]
    kinds = ("holds", "contradicted", "open")
    total = [sum(found[kind] for found in verdicts.values()) for kind in kinds]
    apart = "; ".join(
        f"Chapter {key}: {', '.join(str(found[kind]) for kind in kinds)}" for key, found in verdicts.items()
    )
    counts = f"{total[0]} hold, {total[1]} are contradicted and {total[2]} are open (in this order, {apart})."
    assert f"Of {len(rows)} claims, {counts}" in " ".join(text.split())
    linked = re.findall(r"\]\(([^)]*)\)", text)
    assert linked and not [path for path in linked if not (CLAIMS.parent / path).exists()]


def test_each_contradicted_claim_is_explained_once() -> None:
    text = CLAIMS.read_text(encoding="utf-8")
    contradicted = re.findall(r"(?m)^\| (\d-\d+) \|.*\| contradicted: [^|]*\| `[^`]*` \|$", text)
    why = text.partition("\n## Contradicted claims and their causes\n")[2].partition("\n## ")[0]
    heads = re.findall(r"(?m)^- \*\*([^*]*)\*\*", why)
    assert sorted(re.findall(r"\d-\d+", " ".join(heads))) == sorted(contradicted)
