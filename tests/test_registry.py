"""Discovery of plugins by entry points: plugins are imported late, equal names are reported, and a broken package
affects no other."""

import os
import re
import subprocess
import sys
from importlib.metadata import EntryPoint, PathDistribution
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

import framework.configuration.registry as registry
from framework.configuration.citations import bibtex_of, entries, look_up
from framework.configuration.composition import PluginConfigs, register
from framework.configuration.composition import folder as folder_of_configs
from framework.configuration.registry import GROUPS, config_folders, find, installed, load, unusable_names
from framework.errors import ConfigError
from framework.modes.plugins import OWN_PACKAGE, describe, paper, print_plugins
from framework.runs.provenance import package_versions

ROOT = Path(__file__).resolve().parent.parent


class Distribution:
    def __init__(self, name: str, requires: list[str] | None = None) -> None:
        self.name, self.version, self.requires = name, "1.0", requires


def entry(name: str, value: str, group: str, package: str, requires: list[str] | None = None) -> EntryPoint:
    made = EntryPoint(name=name, value=value, group=group)
    vars(made)["dist"] = Distribution(package, requires=requires)
    return made


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch):
    """Pretend that packages are installed; gives the list to fill."""
    entries: list[EntryPoint] = []
    installed.cache_clear()
    unusable_names.cache_clear()
    select = lambda group: [item for item in entries if item.group == group]  # noqa: E731
    monkeypatch.setattr(registry, "_entry_points", lambda: SimpleNamespace(select=select))
    yield entries
    installed.cache_clear()
    unusable_names.cache_clear()


def test_one_name_from_several_packages_is_refused_naming_all_and_breaks_only_itself(
    fake: list[EntryPoint], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fake += [
        entry("twin", "a.b:C", "framework.encoder", "first-package"),
        entry("twin", "d.e:F", "framework.encoder", "second-package"),
        entry("twin", "a.b:C", "framework.encoder", "first-package"),
        entry("triple", "a.b:C", "framework.metric", "first-package"),
        entry("triple", "d.e:F", "framework.metric", "second-package"),
        entry("triple", "g.h:I", "framework.metric", "third-package"),
        entry("twin", "j.k:L", "framework.metric", "third-package"),
        entry("other", "plugins.encoder.mlp.encoder:MLP", "framework.encoder", "third-package"),
    ]
    assert (list(installed("encoder")), list(installed("metric"))) == (["other"], ["twin"])
    assert load("encoder", "other").group == "encoder"
    for ask in (find, load):
        with pytest.raises(
            ConfigError, match=r"'twin': a\.b:C of first-package 1\.0 and d\.e:F of second-package"
        ):
            ask("encoder", "twin")
        with pytest.raises(
            ConfigError, match=r"'triple'.*first-package.*second-package.*third-package.*Uninstall"
        ):
            ask("metric", "triple")
    with pytest.raises(ConfigError, match=r"called 'twim'\. Did you mean 'twin'\? Installed: other\."):
        find("encoder", "twim")
    monkeypatch.setenv("COLUMNS", "400")
    print_plugins()
    listed = capsys.readouterr().out
    for told in ("twin  (refused) Several", "triple  (refused) Several", "other  ", "second-package 1.0"):
        assert told in listed
    assert listed.count("(none installed)") == len(GROUPS) - 2


@pytest.mark.parametrize("columns", [40, 80])
def test_the_list_of_plugins_shows_names_apart_from_descriptions(
    columns: int, fake: list[EntryPoint], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A name stands further to the left than its description, and only the package of a third-party plugin is named."""
    fake += [
        entry("own", "plugins.encoder.mlp.encoder:MLP", "framework.encoder", "robust-visual-learning"),
        entry("own_again", "plugins.encoder.mlp.encoder:MLP", "framework.encoder", "robust-visual-learning"),
        entry("theirs", "plugins.encoder.bps.encoder:BPS", "framework.encoder", "third-package"),
    ]
    for own in fake[:2]:
        vars(own.dist)["version"] = OWN_PACKAGE.rpartition(" ")[2]
    monkeypatch.setenv("COLUMNS", str(columns))
    print_plugins()
    lines = capsys.readouterr().out.splitlines()
    assert all(len(line) <= columns for line in lines)
    names = [line.split()[0] for line in lines if line.startswith("  ") and not line.startswith("   ")]
    assert sorted(names) == ["(none"] * (len(GROUPS) - 1) + ["own", "own_again", "theirs"]
    text = " ".join(" ".join(lines).split())
    assert "own_again The same plugin as own." in text
    assert text.count("robust-visual-learning") == 1 and text.count("third-package 1.0") == 1


def test_what_is_left_of_a_package_disturbs_nobody(
    fake: list[EntryPoint], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rest of a package has files and entry points, but no METADATA with its name."""
    (tmp_path / "half-1.0.dist-info").mkdir()
    (tmp_path / "half-1.0.dist-info" / "entry_points.txt").write_text(
        "[framework.encoder]\nhalf = half:Encoder\n"
    )
    (left,) = PathDistribution(tmp_path / "half-1.0.dist-info").entry_points
    vars(left)["dist"] = PathDistribution(tmp_path / "half-1.0.dist-info")
    fake += [left, entry("whole", "plugins.encoder.mlp.encoder:MLP", "framework.encoder", "torch")]
    assert list(installed("encoder")) == ["whole"]
    assert "torch" in package_versions()
    with pytest.raises(
        ConfigError, match=r"'half' \(half:Encoder\) belongs to a package whose METADATA file is missing"
    ):
        load("encoder", "half")
    print_plugins()


def test_the_same_entry_seen_twice_is_no_clash(fake: list[EntryPoint]) -> None:
    fake += [entry("one", "a.b:C", "framework.encoder", "package")] * 2
    assert list(installed("encoder")) == ["one"]


def test_an_unknown_name_gets_the_nearest_known(fake: list[EntryPoint]) -> None:
    fake.append(entry("gaussian", "a.b:C", "framework.density_head", "package"))
    with pytest.raises(ConfigError, match=r"Did you mean 'gaussian'\?"):
        find("density_head", "gausian")


def test_a_plugin_that_raises_on_import_is_named_and_breaks_only_itself(
    fake: list[EntryPoint], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken_for_test.py").write_text("raise RuntimeError('boom')")
    monkeypatch.syspath_prepend(tmp_path)
    fake += [
        entry("broken", "broken_for_test:X", "framework.encoder", "broken-package"),
        entry("away", "module_that_is_not_there:X", "framework.encoder", "half-package"),
        entry("alien", "pathlib:Path", "framework.encoder", "alien-package"),
    ]
    assert set(installed("encoder")) == {"alien", "away", "broken"}
    with pytest.raises(ConfigError, match=r"broken-package 1\.0.*RuntimeError: boom"):
        load("encoder", "broken")
    with pytest.raises(ConfigError, match=r"needs the module 'module_that_is_not_there'.*pip install"):
        load("encoder", "away")
    with pytest.raises(ConfigError, match="does not derive from"):
        load("encoder", "alien")


@pytest.mark.parametrize(
    "requires, remedy",
    [
        (
            ["gone-cpu>=3; (sys_platform == 'linux') and extra == 'trees'"],
            r"extra of the plugin's package, e\.g\. `pip install -e '\.\[trees\]'`",
        ),
        (['Gone>=3; extra == "trees"'], r"`pip install -e '\.\[trees\]'`"),
        (
            ["gone>=3; extra == 'dev'", "other; extra == 'trees'"],
            r"dependencies of the plugin's package, e\.g\. `pip install gone`",
        ),
        (["gone>=3"], r"dependencies of the plugin's package, e\.g\. `pip install gone`"),
        (None, r"dependencies of the plugin's package, e\.g\. `pip install gone`"),
    ],
)
def test_a_missing_module_is_had_by_the_extra_that_asks_for_it(
    fake: list[EntryPoint], requires: list[str] | None, remedy: str
) -> None:
    fake.append(entry("trees", "gone.head:X", "framework.density_head", "forest", requires))
    with pytest.raises(ConfigError, match=rf"needs the module 'gone', which is not installed\. .*{remedy}"):
        load("density_head", "trees")


@pytest.mark.parametrize("names", [("one", "two"), ("same", "same")], ids=["two names", "one name"])
def test_of_two_plugins_with_one_config_that_config_is_refused(
    names: tuple[str, str], fake: list[EntryPoint], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, package in zip(names, ("package_one", "package_two"), strict=True):
        folder = tmp_path / package / "conf" / "encoder"
        folder.mkdir(parents=True)
        (tmp_path / package / "__init__.py").write_text("raise RuntimeError('must not be imported')")
        for config in ("same", f"of_{package}"):
            text = f"# @package encoder.{config}\nname: {config}\n"
            (folder / f"{config}.yaml").write_text(text)
        fake += [entry(name, f"{package}.conf", "framework.conf", package)] * 2
    monkeypatch.syspath_prepend(tmp_path)
    assert len(config_folders()) == 2
    monkeypatch.setattr(PluginConfigs, "folders", {})  # given back at the end
    register()

    def composed(chosen: str) -> set[str]:
        with initialize_config_dir(str(folder_of_configs()), version_base="1.3"):
            return set(compose("config", [f"encoder={chosen}", "experiment_name=x"]).encoder)

    try:
        assert composed("[of_package_one,of_package_two]") == {"of_package_one", "of_package_two"}
        for chosen in ("same", "[of_package_one,same]"):
            with pytest.raises(
                ConfigError, match=r"encoder/same\.yaml.*package_one.*package_two.*Uninstall all but one"
            ):
                composed(chosen)
    finally:
        GlobalHydra.instance().clear()


@pytest.mark.parametrize(
    "value", ["", ".conf", "no_such_package.conf", "not a name.conf", "module_without_spec.conf"]
)
def test_a_config_folder_that_is_not_there_disturbs_nobody(
    value: str, fake: list[EntryPoint], monkeypatch: pytest.MonkeyPatch
) -> None:
    module = ModuleType("module_without_spec")
    module.__spec__ = None
    monkeypatch.setitem(sys.modules, "module_without_spec", module)
    fake.append(entry("half", value, "framework.conf", "half-package"))
    assert config_folders() == {}


SOURCES = {
    "latin-1": (
        "# -*- coding: latin-1 -*-\nclass C:\n    'Müller et al.'\n".encode("latin-1"),
        "Müller et al.",
    ),
    "utf-8 with a mark": (b"\xef\xbb\xbfclass C:\n    'Plain.'\n", "Plain."),
    "latin-1 that does not say so": (
        "class C:\n    'Müller'\n".encode("latin-1"),
        r"\(broken: __init__\.py.*\)",
    ),
    "an encoding that is none": (b"# -*- coding: nothing -*-\nclass C:\n    'Text.'\n", r"\(broken: .*\)"),
    "a null byte": (b"class C:\n    'a\x00'\n", r"\(broken: .*\)"),
    "no Python": (b"class C\n", r"\(broken: __init__\.py line 1 does not parse\)"),
    "far too deep": (b"x = " + b"(" * 5000 + b")" * 5000, r"\(broken: .*\)"),
    "nothing": (b"", r"\(class not found\)"),
}


@pytest.mark.parametrize("source", SOURCES)
def test_any_source_is_described_or_called_broken(
    source: str, fake: list[EntryPoint], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content, wanted = SOURCES[source]
    (tmp_path / "package_odd").mkdir()
    (tmp_path / "package_odd" / "__init__.py").write_bytes(content)
    monkeypatch.syspath_prepend(tmp_path)
    fake.append(entry("odd", "package_odd:C", "framework.encoder", "odd-package"))
    told = describe("encoder", installed("encoder")["odd"])
    assert re.fullmatch(wanted, told.summary), told.summary
    print_plugins()


def test_a_class_that_is_not_whole_is_refused(
    fake: list[EntryPoint], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "from framework.density_head import DensityHead\nclass Half(DensityHead):\n    size = 1\n"
    (tmp_path / "half_for_test.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    fake.append(entry("half", "half_for_test:Half", "framework.density_head", "half-package"))
    with pytest.raises(
        ConfigError, match=r"'half'.*half-package 1\.0\) lacks forward, .*framework\.density_head"
    ):
        load("density_head", "half")


def test_a_plugin_may_not_configure_hydra(
    fake: list[EntryPoint], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "package_evil" / "conf" / "hydra" / "job_logging"
    folder.mkdir(parents=True)
    (folder / "evil.yaml").write_text("version: 1")
    fake.append(entry("evil", "package_evil.conf", "framework.conf", "evil"))
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match="may not configure Hydra"):
        config_folders()


@pytest.mark.parametrize("group", GROUPS)
def test_every_installed_plugin_describes_itself_without_import(group: str) -> None:
    for item in installed(group).values():
        told = describe(group, item)
        assert told.summary.endswith("."), f"{told.group} {told.name}: {told.summary!r}"
        assert not told.summary.startswith("("), f"{told.group} {told.name}: {told.summary}"


@pytest.mark.parametrize("group", GROUPS)
def test_every_installed_plugin_loads_as_its_base(group: str) -> None:
    for name in installed(group):
        assert registry.group_of(load(group, name)) == group


def test_a_key_cites_one_thing_and_once() -> None:
    """All plugins give the same text for a BibTeX key, and the list that a run records has each key once."""
    texts = [bibtex_of(load(group, name)) for group in GROUPS for name in installed(group)]
    found = entries(text for text in texts if text.strip())
    for text in texts:
        for key, entry in entries([text]).items():
            assert entry.split() == found[key].split(), f"{key} is written in two ways"
    together = "\n\n".join(found.values())
    assert len(found) > 20 and all(together.count("{" + key + ",") == 1 for key in found)
    several = entries(
        ["@book{one,\n  title = {A, @ B}\n}\n@misc{two,\n}", " @book{one,\n}", "@misc{three, year = 1}"]
    )
    assert list(several) == ["one", "two", "three"] and several["one"] == "@book{one,\n  title = {A, @ B}\n}"


def test_keys_are_looked_up_in_the_references_of_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "cited_package"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "references.bib").write_text("@book{a,\n}\n\n@misc{b,\n}\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    assert look_up("b, a", "cited_package") == "@misc{b,\n}\n\n@book{a,\n}"
    assert look_up("@misc{c,\n}", "cited_package") == "@misc{c,\n}"
    with pytest.raises(ConfigError, match=r"cites the key 'aa'.*Did you mean 'a'\?"):
        look_up("aa", "cited_package")
    with pytest.raises(ConfigError, match="does not contain it"):
        look_up("a", "no_such_package")


def test_each_reference_is_cited() -> None:
    """`plugins/references.bib` holds each entry once, by key in alphabetical order, and none that nobody cites."""
    keys = list(entries([(ROOT / "plugins/references.bib").read_text(encoding="utf-8")]))
    cited = entries(bibtex_of(load(group, name)) for group in GROUPS for name in installed(group))
    assert keys == sorted(cited)


@pytest.mark.parametrize("hiding", ["plugins/__init__.py", "plugins/mine.py", "plugins.py"])
def test_a_package_that_hides_ours_is_named(tmp_path: Path, hiding: str) -> None:
    (tmp_path / hiding).parent.mkdir(exist_ok=True)
    (tmp_path / hiding).touch()
    code = "from framework.configuration.registry import load\nload('metric', 'log_likelihood')"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    told = f"the package 'plugins' at {tmp_path / hiding} does not contain. If that package is not the plugin's own"
    if hiding == "plugins/mine.py":  # a folder without __init__.py hides nothing
        told = ""
    assert told in done.stderr
    assert done.returncode == bool(told), done.stderr


def test_the_paper_of_a_plugin_is_its_first_entry() -> None:
    own = "@misc{own,\n  title = {Own files}\n}"
    first = "@article{first,\n  author = {Doe, Ann and Roe, Jo},\n  title = {A method},\n  year = {2015}\n}"
    assert paper(f"{first}\n{own}\n") == "Doe et al. 2015, A method"
    assert paper(f"{own}\n{first}\n") == ""
