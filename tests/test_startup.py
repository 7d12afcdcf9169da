"""A command does not import modules that it does not need, as fresh processes show."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import framework
from framework.configuration.composition import groups, help_text, is_part, options
from framework.configuration.modes import MODES
from tests.conftest import Once, listed

ROOT = Path(__file__).parent.parent
HEAVY = {
    "torch",
    "torch._dynamo",
    "torchmetrics",
    "pytorch_lightning",
    "lightning_fabric",
    "mlflow",
    "numba",
    "scipy.linalg",  # every part of SciPy that is slow to import needs it
    "sympy",
    "pandas",
    "matplotlib",
    "trimesh",
    "sklearn",
    "kornia",
}
MODEL = (
    *("data=dial", "density_head=scvae", "density_head.hidden=4", "density_head.samples=8", "encoder=[mlp]"),
    *(
        "encoder.mlp.widths=[4]",
        "metric=[log_likelihood]",
        "batch_size=64",
        "trainer.max_epochs=1",
        "samples=9",
        "pictures=false",
    ),
)
COMMANDS: dict[str, tuple[str, str]] = {
    "train": (" ".join(MODEL), "torchmetrics pytorch_lightning lightning_fabric torch._dynamo sympy"),
    "test": ("checkpoint=train pictures=false", "torchmetrics"),
    "calibrate": ("checkpoint=train uncertainty=[conformal] pictures=false", "torchmetrics"),
    "combine": ("mode.members=[train,train] pictures=false", "torchmetrics"),
    "predict": ("checkpoint=train mode.interval=0.9", ""),
    "encode": (
        "data=point_cloud_folder encoder=[occupancy] mode.files=clouds mode.into=features",
        "numba scipy.linalg",
    ),
    "work_precision": (
        "checkpoint=train mode.values=[1,2] mode.repeats=2",
        "torchmetrics matplotlib numba scipy.linalg",  # its reference takes so many samples that they are compiled
    ),
    "render": ("renderer=rasterizer mode.files=clouds/scene.obj pictures=false", "numba scipy.linalg"),
    "check": ("metric=[accuracy]", "torchmetrics"),
    "plugins": ("", ""),
    "new": ("mode.plugin=density_head/my_head", ""),
    "report": ("mode.run=train", "matplotlib"),
    "sync": ("mode.run=train", ""),
}
"""Settings of a command for each mode, and the slow packages that this command needs besides torch."""
STARTS = """
import json, os, sys
from multiprocessing import get_context
import hydra, torch

def run(mode, arguments):
    os.dup2(os.open(f"{mode}.txt", os.O_WRONLY | os.O_CREAT), 1)
    os.dup2(1, 2)
    sys.argv[1:] = arguments
    code = 0
    try:
        main()
    except SystemExit as end:
        code = end.code
    with open(f"{mode}.json", "w") as file:
        json.dump({"code": code, "modules": [*sys.modules]}, file)

sys.argv[0] = "framework"
from framework.app import main
for line in sys.stdin:
    fork = get_context("fork").Process(target=run, args=json.loads(line))
    fork.start()
    fork.join()
"""
"""Script that runs each command in a fork of a process that has imported torch and Hydra only."""


@pytest.fixture(scope="module")
def started(once: Once, stranger_site: Path) -> Path:
    """Return a folder with the output, the exit code and the imported modules of a command of each mode."""

    def run(folder: Path) -> None:
        (folder / "clouds").mkdir()
        np.save(folder / "clouds" / "a.npy", np.random.default_rng(0).random((50, 3), np.float32))
        (folder / "clouds" / "scene.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
        own = {mode: ["logger=none", "threads=1", f"hydra.run.dir={mode}"] for mode in COMMANDS}
        lines = [
            json.dumps([mode, [f"mode={mode}", *settings.split(), *own[mode]]])
            for mode, (settings, _) in COMMANDS.items()
        ]
        environment = {**os.environ, "PYTHONPATH": str(stranger_site)}
        subprocess.run([sys.executable, "-c", STARTS], cwd=folder, env=environment, check=True, text=True,
                       input="\n".join(lines) + "\n", timeout=900)  # fmt: skip

    return once("started", run)


@pytest.mark.slow
@pytest.mark.parametrize("mode", sorted(MODES.keys() - {"export"}))  # export uses nearly all of torch
def test_a_mode_imports_only_what_it_uses(mode: str, started: Path) -> None:
    done = json.loads((started / f"{mode}.json").read_text())
    # a run without a store cannot be sent
    assert done["code"] == (1 if mode == "sync" else 0), (started / f"{mode}.txt").read_text()
    used = {"torch", *COMMANDS[mode][1].split()}
    assert not HEAVY & set(done["modules"]) - used


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
    assert not HEAVY & modules
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
    assert ("§" in said) == (encoding != "ascii")


def test_a_command_without_arguments_says_how_to_start_within_80_columns(tmp_path: Path) -> None:
    done = listed(folder=tmp_path)
    assert done.code == 2
    assert not HEAVY & done.modules
    lines = [line for line in done.out.splitlines() if not line.startswith("MODULES")]
    assert lines[0].startswith(f"robust-visual-learning {framework.__version__} ")
    assert all(len(line) <= 80 for line in lines)
    pages = re.findall(r"docs/[\w/]+\.md", done.out)
    assert pages and all((ROOT / page).is_file() for page in pages)
    assert not list(tmp_path.glob("outputs"))


def test_the_version_is_that_of_the_framework(tmp_path: Path) -> None:
    done = listed("--version", folder=tmp_path)
    assert done.code == 0
    assert done.out.startswith(f"robust-visual-learning {framework.__version__} ")


def test_the_help_fits_80_columns_and_names_every_option_that_a_command_can_choose(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = help_text()
    assert all(len(line) <= 80 for line in text.splitlines() if "framework" not in line)
    words = set(re.findall(r"[\w]+", text))
    for group in groups():
        chosen = [name for name in options(group) if not is_part(group, name)]
        assert chosen and {name.rpartition("/")[2] for name in chosen} <= words
    assert "base" not in words
    assert "debug=<name>\n  fast\n" in text


EXEMPTED = """
import gc
from framework.storage.imports import without_collection
kept, counts = [], []
for _ in range(2):
    with without_collection():
        kept += [[] for _ in range(1000)]
        collecting = gc.isenabled()
    counts.append(gc.get_freeze_count())
print(collecting, gc.isenabled(), counts[0] >= 1000, abs(counts[1] - counts[0]) < 500)
"""


def test_only_what_the_first_imports_leave_is_exempt_from_collection() -> None:
    """Otherwise a sweep that runs its jobs in one process would keep the unused objects of every job."""
    done = subprocess.run([sys.executable, "-c", EXEMPTED], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True", "True", "True"]
