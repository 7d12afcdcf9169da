"""A third-party package runs by name, and a broken one disturbs nobody."""

from pathlib import Path

import pytest

from tests.conftest import TINY, Framework


def test_a_strangers_head_and_data_run_by_name(framework: Framework) -> None:
    done = framework(*TINY, "logger=none")
    assert done.code == 0, done.out
    assert "wrapped_cauchy" in (done.folder / "config.yaml").read_text(encoding="utf-8")
    assert "log-likelihood" in done.out.lower()
    assert "synthetic" in done.out
    assert "Mardia" in (done.folder / "citations.bib").read_text(encoding="utf-8")
    listed = framework("mode=plugins")
    assert "wrapped_cauchy" in listed.out or "One wrapped Cauchy" in listed.out


@pytest.fixture
def broken_site(tmp_path: Path) -> Path:
    """A package that is installed and raises at import, with a config nobody asked for."""
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
