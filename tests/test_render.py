"""mode=render: its images and numbers agree with the first pipeline, with another command and with formulas."""

import json
import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from framework.errors import ConfigError
from framework.evaluation.rendering import Frame, Painter, frame_cost
from framework.geometry.srgb import srgb_from_linear
from framework.renderer import Renderer, Scene
from framework.testing.bodies import write_subjects
from framework.testing.sample_scenes import glb, quad
from framework.testing.scenes import camera, sphere
from plugins.renderer.rasterizer.__main__ import main as draw_by_command
from plugins.renderer.rasterizer.renderer import Rasterizer
from tests.conftest import Done, Framework, Once

QUIET = ("logger=none", "threads=1", "pictures=false", "~metric.ssim", "~metric.ms_ssim", "~metric.lpips")
"""Settings of runs on people in images of 12 × 9 pixels, which are too small for SSIM."""
SMALL = ("encoder.projection.height=12", "encoder.projection.width=9", "debug=fast")


def numbers(done: Done) -> dict[str, Any]:
    assert done.code == 0, done.out
    return json.loads((done.folder / "results.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def people(tmp_path_factory: pytest.TempPathFactory) -> str:
    return f"data.root={write_subjects(tmp_path_factory.mktemp('people') / 'scans')['root']}"


@pytest.fixture(scope="module")
def scenes(once: Once) -> Path:
    """Return a folder with a coloured ball, and with a textured quad."""

    def write(folder: Path) -> None:
        ball = sphere(8)
        assert ball.colors is not None
        shades = (srgb_from_linear(ball.colors) * 255).round().int().tolist()
        lines = ["ply", "format ascii 1.0", f"element vertex {len(ball.vertices)}"]
        lines += [f"property float {axis}" for axis in "xyz"]
        lines += [f"property uchar {color}" for color in ("red", "green", "blue")]
        lines += [f"element face {len(ball.faces)}", "property list uchar int vertex_indices", "end_header"]
        lines += [
            " ".join(map(str, (*place, *shade[:3])))
            for place, shade in zip(ball.vertices.tolist(), shades, strict=True)
        ]
        lines += [f"3 {' '.join(map(str, face))}" for face in ball.faces.tolist()]
        (folder / "ball.ply").write_text("\n".join(lines) + "\n")
        (folder / "quad.glb").write_bytes(glb(*quad()))

    return once("scenes", write)


@pytest.mark.parametrize(("drawn", "predicted"), [("vertex_colors", "rasterised"), ("textures", "textured")])
def test_a_mesh_has_the_error_of_the_same_mesh_in_the_first_pipeline(
    framework: Framework, people: str, drawn: str, predicted: str
) -> None:
    rendered = numbers(framework(f"experiment=render/{drawn}", people, *QUIET, folder="drawn"))
    size = ("data.height=12", "data.width=9")
    tested = numbers(framework(f"experiment=smplpix/{predicted}", people, *size, *QUIET, folder="predicted"))
    for key in ("psnr_db", "psnr_masked_db", "psnr_db_sem"):
        assert rendered[key] == pytest.approx(tested[key], rel=1e-6)
    assert rendered["parameters"] == 0 and rendered["flops_per_sample"] is None
    assert rendered["milliseconds_per_sample"] > 0 and rendered["test_samples"] == 4
    assert rendered["columns"]["milliseconds_per_sample"] == "ms / frame"


def test_a_network_is_trained_first_or_comes_from_a_checkpoint(framework: Framework, people: str) -> None:
    command = ("experiment=render/smplpix", people, *SMALL, *QUIET, "renderer.precision=trained")
    trained = framework(*command, folder="trained")
    first = numbers(trained)
    assert (trained.folder / "checkpoints/model.ckpt").is_file()
    tested = numbers(
        framework("mode=test", f"checkpoint={trained.folder}", people, *QUIET[:3], folder="tested")
    )
    assert first["psnr_db"] == pytest.approx(tested["psnr_db"], rel=1e-6)
    assert first["parameters"] == tested["parameters"] > 0
    again = framework(
        "experiment=render/vertex_colors",
        people,
        *QUIET,
        "renderer=smplpix",
        "renderer.precision=trained",
        "~renderer.supersampling",
        f"checkpoint={trained.folder}",
        folder="again",
    )
    assert numbers(again)["psnr_db"] == first["psnr_db"]
    assert numbers(again)["method"] == "smplpix"
    assert not (again.folder / "checkpoints/model.ckpt").exists()


def test_files_are_drawn_as_the_command_of_the_renderer_draws_them(
    framework: Framework, scenes: Path, tmp_path: Path
) -> None:
    view = ("mode.azimuth=70", "mode.elevation=20", "mode.width=64", "mode.height=48")
    common = ("mode=render", "renderer=rasterizer", f"mode.files={scenes}", *view, *QUIET[:3])
    done = framework(
        *common, "renderer.supersampling=3", "mode.background='#20a0ff'", "mode.channels=[color,mask]"
    )
    assert numbers(done)["test_samples"] == 2
    assert "faces drawn" in done.out
    for file in scenes.iterdir():
        out = tmp_path / f"{file.stem}.png"
        words = ["--azimuth", "70", "--elevation", "20", "--size", "64x48", "--background", "#20a0ff"]
        draw_by_command([str(file), *words, "--out", str(out)])
        images = [np.asarray(Image.open(path)) for path in (out, done.folder / f"images/{out.name}")]
        assert np.array_equal(*images), file
        mask = np.asarray(Image.open(done.folder / f"images/{file.stem}_mask.png"))
        assert set(np.unique(mask).tolist()) == {0, 255}
    # true images: those of that run, beside which this run has one sample per pixel
    truth = (f"mode.truth={done.folder / 'images'}", "metric=[psnr]", "metric.psnr.masked=false")
    compared = framework(*common, "mode.background='#20a0ff'", *truth, folder="compared")
    errors = []
    for file in scenes.iterdir():
        pair = [
            np.asarray(Image.open(run.folder / f"images/{file.stem}.png"), float) / 255
            for run in (done, compared)
        ]
        errors.append(-10 * math.log10(((pair[0] - pair[1]) ** 2).mean()))
    assert numbers(compared)["psnr_db"] == pytest.approx(np.mean(errors), abs=0.05)  # rounding to 8 bits


def test_several_frames_go_once_around_and_are_an_animation(framework: Framework, scenes: Path) -> None:
    done = framework(
        *("mode=render", "renderer=rasterizer", f"mode.files={scenes / 'ball.ply'}", "mode.frames=4"),
        *("mode.width=32", "mode.height=24", *QUIET[:2]),
    )
    assert numbers(done)["test_samples"] == 4
    frames = [np.asarray(Image.open(done.folder / f"images/ball_{number:04}.png")) for number in range(4)]
    assert all(not np.array_equal(frames[0], other) for other in frames[1:])
    with Image.open(done.folder / "images/ball.gif") as animation:
        assert animation.n_frames == 4  # type: ignore[attr-defined]
    assert (done.folder / "figures/frames.png").is_file()


def with_cover(scene: Scene) -> Scene:
    assert scene.colors is not None
    colors = torch.cat([scene.colors[:, :3], torch.ones(len(scene.colors), 1)], 1)
    return Scene(scene.vertices, scene.faces, colors, scene.camera)


@pytest.mark.parametrize("ground", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.1, 0.4, 0.9)])
def test_a_background_is_what_many_samples_of_a_pixel_see(ground: tuple[float, float, float]) -> None:
    """Compare with single samples of a pixel, each of which shows the surface or the background, averaged here."""
    scene = with_cover(sphere(6))
    truth = {"index": torch.tensor([0]), "group": torch.tensor([0])}
    painter = Painter(Rasterizer(supersampling=4), ground, ("color",))
    (painted,) = painter.paint([Frame("ball", scene, truth)])
    view, times = scene.camera, 4
    fine = type(view)(
        view.rotation,
        view.translation,
        (float(view.focal[0]) * times, float(view.focal[1]) * times),
        tuple((float(part) + 0.5) * times - 0.5 for part in view.principal),  # type: ignore[arg-type]
        view.height * times,
        view.width * times,
        view.near,
    )
    samples = Rasterizer()(Scene(scene.vertices, scene.faces, scene.colors[:, :3], fine), ("color", "mask"))
    seen = torch.where(samples["mask"][..., None], samples["color"], torch.tensor(ground))
    wanted = seen.view(view.height, times, view.width, times, 3).mean((1, 3))
    assert painted["color"].shape[-1] == 3
    torch.testing.assert_close(painted["color"], wanted, rtol=0, atol=2e-6)


class Remembering(Renderer):
    """Renderer that draws nothing, and remembers the cameras of its scenes."""

    channels = frozenset({"color"})
    bibtex = ""
    seen: ClassVar[list[tuple[float, ...]]] = []

    def __call__(self, scene: Scene, channels: Sequence[str] = ("color",)) -> dict[str, Tensor]:  # type: ignore[override]
        self.seen.append((*map(float, scene.camera.principal), float(scene.vertices[0, 0])))
        return {"color": torch.zeros(scene.camera.height, scene.camera.width, 4)}


@pytest.mark.parametrize("count", [1, 2, 3])
def test_no_two_consecutive_images_of_a_measurement_are_the_same(count: int) -> None:
    ball = with_cover(sphere(3))
    truth = {"index": torch.tensor([0]), "group": torch.tensor([0])}
    frames = [
        Frame(str(number), Scene(ball.vertices + number, ball.faces, ball.colors, camera()), truth)
        for number in range(count)
    ]
    Remembering.seen.clear()
    cost = frame_cost(Painter(Remembering(), (1.0, 1.0, 1.0), ("color",)), frames)
    seen = Remembering.seen
    assert len(seen) > 20 and all(one != other for one, other in pairwise(seen))
    assert cost.batch_size == count and cost.parameters == 0 and cost.flops_per_sample is None


def test_a_background_that_a_renderer_cannot_draw_on_is_refused() -> None:
    class White(Remembering):
        background = 1.0

    with pytest.raises(
        ConfigError, match="White draws on a background of 1, linear RGB, and cannot draw on 0, 0, 0"
    ):
        Painter(White(), (0.0, 0.0, 0.0), ("color",))
    with pytest.raises(ConfigError, match="does not draw the channels depth"):
        Painter(White(), (1.0, 1.0, 1.0), ("depth",))
