"""Output of a run on the user's own data: figures name the data and the model, and long work shows its progress."""

import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

COMMANDS = """
import sys
from hydra.core.global_hydra import GlobalHydra
from framework.app import main
from framework.storage import progress
progress.QUIET_TIME = progress.REPORT_INTERVAL = 0.0
for command in sys.argv[1:]:
    sys.argv = ["framework", *command.split()]
    main()
    GlobalHydra.instance().clear()
"""


def written(figure: Path) -> str:
    """Return the texts of an SVG figure, which are stored beside their outlines."""
    return " ".join(re.findall("<!-- (.*?) -->", figure.read_text(encoding="utf-8"), re.S))


@pytest.mark.slow
def test_own_data_are_named_and_long_work_says_how_far_it_is(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    lines = ["width,height,gaze,group"]
    for number in range(120):
        angle = random.uniform(0, 360)
        tip = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        lines.append(f"{tip[0]:.4f},{tip[1]:.4f},{angle:.2f},{('eyes', 'sunglasses')[number % 2]}")
    (tmp_path / "faces.csv").write_text("\n".join(lines), encoding="utf-8")
    always = "logger=none threads=1"
    commands = [
        "data=tabular data.path=faces.csv data.target=gaze data.kind=degrees encoder=[mlp] density_head=scvae "
        "metric=[log_likelihood,angular_deviation,coverage,risk_coverage] trainer.max_epochs=1 batch_size=16 "
        f"samples=20 pictures=svg hydra.run.dir=one {always}",
        f"mode=predict checkpoint=./one data.path=faces.csv hydra.run.dir=two {always}",
        "mode=report mode.run=./one",
        "mode=work_precision checkpoint=one data.path=faces.csv mode.values=[1,2] mode.repeats=2 mode.reference=4 "
        f"mode.metrics=[error_nats,maad_deg] pictures=svg hydra.run.dir=three {always}",
    ]
    done = subprocess.run(
        [sys.executable, "-c", COMMANDS, *commands], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    for work in ("calibrating: 18 of 18 samples", "testing: 18 of 18", "predicting: 18 of 18"):
        assert work in done.stderr, done.stderr
    assert "measuring errors: 2 of 2 values of samples" in done.stderr
    assert "faces · scvae, 18 test samples" in done.stdout
    assert "mode=predict checkpoint=./one mode.files=<your files>" in done.stdout
    assert "mode=report mode.run=./one\n" in done.stdout
    pictures = {path.name: written(path) for path in (tmp_path / "one" / "figures").iterdir()}
    names = ("training_curve", "predicted_densities", "coverage", "risk_coverage")
    assert set(pictures) == {f"{name}.svg" for name in names}
    assert all("faces · scvae" in words for words in pictures.values()), pictures
    densities = pictures["predicted_densities.svg"]
    assert "density of gaze" in densities and "90°" in densities and "per rad" in densities
    assert not re.search("front|back|left|right|no experiment|synthetic", " ".join(pictures.values()))
    (curve,) = (tmp_path / "three" / "figures").iterdir()
    words = written(curve)
    assert curve.name == "work_precision.svg"
    assert words.count("run time (ms per sample)") == words.count("1 thread, batches of 16") == 2
    assert "faces · scvae: metrics against run time along samples" in words
    assert "not beaten beyond noise (Pareto)" in words
