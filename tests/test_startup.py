"""A command does not import modules that it does not need, as fresh processes show."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import listed

HEAVY = {
    "torch",
    "pytorch_lightning",
    "mlflow",
    "numba",
    "scipy",
    "matplotlib",
    "trimesh",
    "sklearn",
    "kornia",
}


@pytest.mark.parametrize(
    "arguments",
    [("--help",), ("experiment=pascal3d/scvae", "--cfg", "job"), ("mode=plugins",)],
    ids=["help", "cfg", "plugins"],
)
def test_asking_imports_nothing_heavy_and_no_plugin(arguments: tuple[str, ...], tmp_path: Path) -> None:
    done = listed(*arguments, folder=tmp_path)
    assert done.code == 0, done.out
    modules = done.modules
    assert "framework.app" in modules
    assert not HEAVY & {name.partition(".")[0] for name in modules}
    assert not [name for name in modules if name.startswith("plugins.")]
    assert list(tmp_path.iterdir()) == [], "asking leaves nothing behind"


@pytest.mark.parametrize(
    ("experiment", "mistake"),
    [
        ("moons/vanilla_128", "density_head=scvae"),
        ("moons/vanilla_128", "trainer.strategy=dpp"),
        pytest.param("moons/vanilla_128", "encoder.mlp.widths=[0]", marks=pytest.mark.slow),
        pytest.param("pascal3d/scvae", "density_head=categorical", marks=pytest.mark.slow),
    ],
)
def test_a_mistake_is_found_before_what_trains_is_imported(
    experiment: str, mistake: str, tmp_path: Path
) -> None:
    done = listed(f"experiment={experiment}", mistake, folder=tmp_path)
    assert done.code == 2, done.out
    assert not {"pytorch_lightning", "torchmetrics", "matplotlib", "mlflow"} & done.modules


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_a_terminal_without_our_letters_is_told_all_the_same(encoding: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", "from framework.app import main; main()", "mode=plugins"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONIOENCODING": encoding, "PYTHONUTF8": "0"},
        capture_output=True,
        timeout=300,
    )
    said = done.stdout.decode(encoding)
    assert done.returncode == 0, done.stderr
    assert "von_mises" in said
    assert ("·" in said) == (encoding != "ascii")
