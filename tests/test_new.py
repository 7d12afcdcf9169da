"""mode=new: the package of every registry passes its own tests, and the commands of its README compose."""

import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from framework.configuration.registry import GROUPS
from tests.conftest import Framework

README_COMMAND = re.compile(r"(?m)^    python -m framework (.*)$")


def install(package: Path) -> None:
    """Write the metadata of an editable installation into the folder of a package."""
    project = tomllib.loads((package / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    metadata = package / f"{project['name']}-{project['version']}.dist-info"
    metadata.mkdir()
    named = {"Metadata-Version": "2.1", "Name": project["name"], "Version": project["version"]}
    (metadata / "METADATA").write_text("".join(f"{key}: {value}\n" for key, value in named.items()))
    lines = [
        line
        for group, entries in project["entry-points"].items()
        for line in (f"[{group}]", *(f"{name} = {value}" for name, value in entries.items()))
    ]
    (metadata / "entry_points.txt").write_text("\n".join(lines) + "\n")


def arguments_of(command: str) -> list[str]:
    """Return the arguments of a command of a README, for a sweep those of a job with the new plugin."""
    words = shlex.split(command)
    if words[0] != "-m":
        return words
    arguments = []
    for key, _, values in (word.partition("=") for word in words[1:]):
        choices = re.findall(r"\[[^]]*\]|[^,\[\]]+", values)
        arguments.append(f"{key}={next((choice for choice in choices if 'my_' in choice), choices[0])}")
    return arguments


@pytest.mark.parametrize(
    "registry",
    [
        pytest.param(group, marks=[pytest.mark.slow] if group == "renderer" else [], id=group)
        for group in GROUPS
    ],
)
def test_a_new_plugin_passes_mode_check_as_written(
    registry: str, framework: Framework, tmp_path: Path
) -> None:
    done = framework("mode=new", f"mode.plugin={registry}/my_{registry}", folder=None)
    assert done.code == 0, done.out
    package = tmp_path / f"my_{registry}"
    files = {path.relative_to(package).as_posix() for path in package.rglob("*") if path.is_file()}
    assert {"pyproject.toml", "README.md", f"tests/test_my_{registry}.py"} < files
    assert not (tmp_path / "outputs").exists()
    assert not any(
        re.search('example|<registry>|^"""my', file.read_text(), re.IGNORECASE)
        for file in map(package.joinpath, files)
    )
    install(package)
    readme = (package / "README.md").read_text(encoding="utf-8")
    check, *others = README_COMMAND.findall(readme)
    assert check in done.out
    done = framework(*shlex.split(check), "threads=1", paths=(package,))
    assert done.code == 0, done.out
    assert others or registry == "renderer"
    for command in others:
        done = framework(*arguments_of(command), "--cfg", "job", folder=None, paths=(package,))
        assert done.code == 0, done.out
        assert f"name: my_{registry}" in done.out


@pytest.mark.slow
def test_the_test_file_of_a_new_plugin_passes_and_finds_a_fault(framework: Framework, tmp_path: Path) -> None:
    assert framework("mode=new", "mode.plugin=metric/my_metric", folder=None).code == 0
    package = tmp_path / "my_metric"
    install(package)
    test = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(package / "tests")]
    environment = {"PYTHONPATH": str(package), "PATH": "", "FRAMEWORK_CACHE": str(tmp_path / "cache")}

    def outcome() -> subprocess.CompletedProcess[str]:
        return subprocess.run(test, cwd=package, env=environment, capture_output=True, text=True, timeout=300)

    assert outcome().returncode == 0, outcome().stdout
    plugin = package / "my_metric" / "plugin.py"
    plugin.write_text(plugin.read_text().replace('_sem": error', '_sem": 2 * error'))
    assert "FAILED" in outcome().stdout


MISTAKES: dict[str, tuple[str, str, str]] = {
    "no call of the base class": (
        "        super().__init__()\n",
        "",
        r"Write `super\(\).__init__\(\)` as its first line",
    ),
    "no size": ("        self.size =", "        self.sizes =", "leaves `size` at None"),
    "a tensor": (
        "return Laplace(location,",
        "return torch.add(location,",
        "returns an object of type Tensor",
    ),
    "a wrong name": (
        "len(target.names)",
        "len(target.labels)",
        r"cannot be built: AttributeError: .* \(raised at \S+plugin.py:\d+\)",
    ),
    "an error of the module": (
        "LARGEST = 1e18",
        "LARGEST = 1 / 0",
        r"ZeroDivisionError: .* \(at \S+plugin.py:\d+\)",
    ),
    "an error of forward": (
        "-1)\n        return",
        "-1)[7]\n        return",
        r"IndexError: .* \(raised at \S+plugin.py:\d+\)",
    ),
    "no entropy": ("def entropy", "def entropies", "NotImplementedError: raised by `entropy` of Laplace"),
    "a shape": (
        "math.log(2)).sum(-1)",
        "math.log(2))",
        r"shape of the loss of a batch of shape \(\): \(2,\)|\(1,\), expected \(\)",
    ),
}
"""Name of a beginner's mistake → text of a new density head, what replaces it, and words that `mode=check` prints."""


def test_mode_check_leads_to_a_beginners_mistake(framework: Framework, tmp_path: Path) -> None:
    assert framework("mode=new", "mode.plugin=density_head/my_head", folder=None).code == 0
    package = tmp_path / "my_head"
    install(package)
    plugin = package / "my_head" / "plugin.py"
    code = plugin.read_text(encoding="utf-8")
    for name, (old, new, words) in MISTAKES.items():
        assert old in code, name
        plugin.write_text(code.replace(old, new, 1), encoding="utf-8")
        done = framework("mode=check", "density_head=my_head", paths=(package,))
        assert done.code in (1, 2), name
        assert re.search(words, " ".join(done.out.split())), (name, done.out)
        assert "Traceback" not in done.out, name


def test_a_package_without_its_configs_affects_its_own_plugins_alone(
    framework: Framework, tmp_path: Path
) -> None:
    assert framework("mode=new", "mode.plugin=metric/my_metric", folder=None).code == 0
    package = tmp_path / "my_metric"
    install(package)
    shutil.rmtree(package / "my_metric" / "conf")
    done = framework("experiment=cest/mlp", "--cfg", "job", folder=None, paths=(package,))
    assert done.code == 0, done.out
    done = framework("mode=check", "metric=[my_metric]", paths=(package,))
    assert done.code == 2
    assert "Write metric/my_metric.yaml with the line `name: my_metric`" in done.out
    assert "`# @package metric.my_metric`" in done.out


@pytest.mark.parametrize(
    ("plugin", "sentence"),
    [
        ("my_head", "names no registry"),
        ("density_heads/mine", "Did you mean 'density_head'"),
        ("density_head/von_mises", "has a plugin of this name already"),
        ("metric/my-metric", "cannot be the name of a plugin"),
        ("metric/lambda", "cannot be the name of a plugin"),
        ("metric/torch", "exists already"),
        ("metric/a/../../b", "cannot be the name of a plugin"),
        ("metric/taken", "Choose another name, or set mode.folder"),
    ],
)
def test_a_name_that_cannot_be_used_is_refused_and_nothing_is_written(
    plugin: str, sentence: str, framework: Framework, tmp_path: Path
) -> None:
    (tmp_path / "taken").mkdir()
    done = framework("mode=new", f"mode.plugin={plugin}", folder=None)
    assert done.code == 2
    assert sentence in done.out
    assert {path.name for path in tmp_path.iterdir()} == {"taken", "output.txt"}
