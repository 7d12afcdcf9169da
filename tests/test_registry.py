"""Discovery by entry points: lazy, clash-proof, and one broken package disturbs nobody else."""

from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

import framework.configuration.registry as registry
from framework.configuration.assembly import entries
from framework.configuration.registry import GROUPS, config_folders, find, installed, load
from framework.errors import ConfigError
from framework.modes.plugins import describe


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
    monkeypatch.setattr(
        registry, "entry_points", lambda group: [item for item in entries if item.group == group]
    )
    yield entries
    installed.cache_clear()


def test_one_name_from_two_packages_is_refused_naming_both(fake: list[EntryPoint]) -> None:
    fake += [
        entry("twin", "a.b:C", "framework.encoder", "first-package"),
        entry("twin", "d.e:F", "framework.encoder", "second-package"),
    ]
    with pytest.raises(ConfigError, match=r"'twin'.*first-package.*second-package"):
        installed("encoder")


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
            r"package's extra, e\.g\. `pip install -e '\.\[trees\]'`",
        ),
        (['Gone>=3; extra == "trees"'], r"`pip install -e '\.\[trees\]'`"),
        (["gone>=3; extra == 'dev'", "other; extra == 'trees'"], r"dependencies, e\.g\. `pip install gone`"),
        (["gone>=3"], r"dependencies, e\.g\. `pip install gone`"),
        (None, r"dependencies, e\.g\. `pip install gone`"),
    ],
)
def test_a_missing_module_is_had_by_the_extra_that_asks_for_it(
    fake: list[EntryPoint], requires: list[str] | None, remedy: str
) -> None:
    fake.append(entry("trees", "gone.head:X", "framework.density_head", "forest", requires))
    with pytest.raises(ConfigError, match=rf"needs the module 'gone', which is not installed\. .*{remedy}"):
        load("density_head", "trees")


def test_two_plugins_with_one_config_are_refused(
    fake: list[EntryPoint], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("package_one", "package_two"):
        folder = tmp_path / name / "conf" / "encoder"
        folder.mkdir(parents=True)
        (tmp_path / name / "__init__.py").write_text("raise RuntimeError('must not be imported')")
        (folder / "same.yaml").write_text("name: same")
        fake.append(entry(name, f"{name}.conf", "framework.conf", name))
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match=r"'package_one' and 'package_two'.*both ship encoder/same\.yaml"):
        config_folders()


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
    """Over every installed plugin: two entries of one key say the same, and what a run records has each key once."""
    texts = [load(group, name).bibtex for group in GROUPS for name in installed(group)]
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
