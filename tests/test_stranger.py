"""Third-party packages, which run by name, and broken packages, which do not disturb other commands."""

from pathlib import Path

import pytest

from tests.conftest import TINY, Done, Framework


def test_a_strangers_head_and_data_run_by_name(framework: Framework, whole: Done) -> None:
    assert "wrapped_cauchy" in (whole.folder / "config.yaml").read_text(encoding="utf-8")
    assert "log-likelihood" in whole.out.lower()
    assert "synthetic" in whole.out
    assert "Mardia" in (whole.folder / "citations.bib").read_text(encoding="utf-8")
    listed = framework("mode=plugins")
    assert "wrapped_cauchy" in listed.out or "One wrapped Cauchy" in listed.out


@pytest.fixture
def broken_site(tmp_path: Path) -> Path:
    """Install a package that raises an error at import, and whose config is not used."""
    site = tmp_path / "broken_site"
    package = site / "broken_package"
    (package / "conf" / "density_head").mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('boom')")
    (package / "conf" / "density_head" / "broken.yaml").write_text("name: broken\n")
    meta = site / "broken_package-1.0.dist-info"
    meta.mkdir()
    (meta / "METADATA").write_text("Metadata-Version: 2.1\nName: broken-package\nVersion: 1.0\n")
    (meta / "entry_points.txt").write_text(
        "[framework.conf]\nbroken = broken_package.conf\n\n[framework.density_head]\nbroken = broken_package:Head\n"
    )
    return site


def test_a_broken_package_breaks_only_itself(framework: Framework, broken_site: Path) -> None:
    done = framework(*TINY, "logger=none", paths=(broken_site,))
    assert done.code == 0, done.out
    chosen = framework(*TINY, "logger=none", "density_head=broken", paths=(broken_site,), folder="second")
    assert chosen.code == 2
    assert "broken-package 1.0" in chosen.out
    assert "RuntimeError: boom" in chosen.out
    assert "Traceback" not in chosen.out


@pytest.fixture
def clashing_site(tmp_path: Path) -> Path:
    """Packages that nobody asked for: one gives a name that is ours to its head, two ship one config, and one has a
    source in latin-1 and a config that is not YAML."""
    site = tmp_path / "clashing_site"
    heads = {"twin": "gaussian", "second": "second", "latin": "latin"}
    for package, head in heads.items():
        configs = site / package / "conf" / "density_head"
        configs.mkdir(parents=True)
        source = (
            f"# -*- coding: latin-1 -*-\nclass Head:\n    'Head of M\xfcller ({package}).'\n    bibtex = ''\n"
        )
        (site / package / "__init__.py").write_text(source, encoding="latin-1")
        (configs / f"{'cut' if package == 'latin' else 'shared'}.yaml").write_text("name: [gaussian, 2\n")
        meta = site / f"{package}-1.0.dist-info"
        meta.mkdir()
        (meta / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        (meta / "entry_points.txt").write_text(
            f"[framework.conf]\n{package} = {package}.conf\n\n[framework.density_head]\n{head} = {package}:Head\n"
        )
    return site


def test_packages_that_clash_or_are_damaged_break_only_what_is_theirs(
    framework: Framework, clashing_site: Path
) -> None:
    here = {"paths": (clashing_site,)}
    done = framework(*TINY, "logger=none", "trainer.max_epochs=1", **here)
    assert done.code == 0, done.out
    listed = framework("mode=plugins", **here)
    assert listed.code == 0, listed.out
    assert "gaussian  (refused) Several installed packages define a density_head 'gaussian'" in listed.out
    assert "latin  Head of M\xfcller (latin)." in listed.out and "wrapped_cauchy" in listed.out
    for chosen, wanted in {
        "gaussian": "twin:Head of twin 1.0 and plugins.density_head.gaussian.head:GaussianHead of ",
        "shared": "Several plugins ship the config density_head/shared.yaml: 'second'",
        "cut": "latin/conf/density_head/cut.yaml, line 2, column 1: while parsing a flow sequence",
    }.items():
        refused = framework(*TINY, "logger=none", f"density_head={chosen}", folder=chosen, **here)
        assert refused.code == 2, refused.out
        assert wanted in refused.out and "Traceback" not in refused.out
        assert refused.out.count("\n") == 2 and "\nhelp:  docs/" in refused.out, refused.out
