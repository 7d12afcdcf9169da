"""The path of a newcomer after the installation: the commands of the site, in order, as the pages print them.

The last page of the path, the tutorial about an own method, runs as a notebook (`run_tutorial`).
"""

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).parent.parent


def blocks(page: str, language: str) -> list[str]:
    """Return the code blocks of a page in a language."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.findall(rf"(?ms)^```{language}\n(.*?)^```$", text)


def printed(page: str, part: str) -> str:
    """Return the command of a page that contains `part`, without a comment, with continued lines joined."""
    lines = "\n".join(blocks(page, "bash")).replace("\\\n", " ").splitlines()
    inline = re.findall(r"`(python -m framework [^`\n]+)`", (ROOT / page).read_text(encoding="utf-8"))
    commands = [line.partition("  #")[0].strip() for line in lines] + inline
    matching = list(dict.fromkeys(command for command in commands if part in command))
    assert matching, f"{page} prints no command with {part}"
    return matching[0]


def write_images(folder: Path) -> None:
    """Write two classes of images: bright ones with vertical and with horizontal stripes."""
    random = np.random.default_rng(0)
    for name, axis in (("columns", 1), ("rows", 0)):
        (folder / name).mkdir(parents=True)
        for number in range(40):
            stripes = 127 + 100 * np.sin(np.arange(24) / 2 + random.uniform(0, 6))
            image = np.broadcast_to(stripes[None] if axis else stripes[:, None], (24, 24))
            pixels = (image + random.normal(0, 10, (24, 24))).clip(0, 255).astype(np.uint8)
            Image.fromarray(pixels).save(folder / name / f"{number}.png")


@pytest.mark.slow
def test_the_commands_of_the_site_lead_a_newcomer_to_an_own_method(
    tmp_path: Path, run_tutorial: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    random = np.random.default_rng(0)
    table = random.normal(size=(300, 3))
    table[:, 2] = table[:, 0] - 2 * table[:, 1] + random.normal(0, 0.1, 300)
    np.savetxt(tmp_path / "my.csv", table, delimiter=",", header="a,b,y", comments="")
    write_images(tmp_path / "my_images")
    first_run, own_data = "docs/start/first_run.md", "docs/how_to/own_data.md"
    main = printed("README.md", "experiment=pascal3d/scvae").rpartition("&& ")[2]
    steps = {
        "main job": f"{main} debug=fast",  # the site says so for a short run
        "report": printed(first_run, "mode=report"),
        "export": printed("docs/export.md", "mode=export"),
        # test_site.py trains on an own table for longer
        "own table": f"{printed(own_data, 'experiment=tabular/regression')} debug=fast",
        "own images": printed(own_data, "experiment=images/classification data.root=my_images"),
    }
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "MLFLOW_DISABLE_TELEMETRY": "true",
    }
    environment.pop("MLFLOW_TRACKING_URI", None)
    seconds: dict[str, float] = {}
    folder = ""
    for name, command in steps.items():
        command = command.replace("<folder>", folder)
        start = time.perf_counter()
        done = subprocess.run(
            ["bash", "-c", command],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=1800,
        )
        seconds[name] = time.perf_counter() - start
        assert done.returncode == 0, f"{name}: {command}\n{done.stdout}\n{done.stderr}"
        if named := re.search(r"^run folder: +(\S+)", done.stdout, re.MULTILINE):
            folder = named[1]
        if name == "report":
            assert (tmp_path / folder / "report.html").is_file()
    assert (tmp_path / "my_model/model.onnx").is_file()
    own_method = run_tutorial("own_head")
    seconds["own method"] = float((own_method / "seconds.txt").read_text(encoding="utf-8"))
    assert (own_method / "my_laplace/pyproject.toml").is_file()
    comparison = (own_method / "outputs/heads/comparison.csv").read_text(encoding="utf-8")
    assert "my_laplace" in comparison and "gaussian" in comparison
    lines = [f"{name}: {time_of_step:.0f} s" for name, time_of_step in seconds.items()]
    with capsys.disabled():
        total = sum(seconds.values())
        sys.stdout.write(
            f"\nA newcomer's path takes {total:.0f} s without the installation ({'; '.join(lines)}).\n"
        )
