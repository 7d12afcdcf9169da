"""Tests that savings change no bit of an image, and comparison of the report with brute force."""

import copy
import gc
import itertools
import pickle
import tracemalloc
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.geometry.camera import Camera, look_from
from framework.renderer import Scene, Texture, join_scenes
from plugins.renderer.rasterizer import canvas
from plugins.renderer.rasterizer.drawing import Gradient, Saving
from plugins.renderer.rasterizer.renderer import Rasterizer
from plugins.renderer.rasterizer.test_gradient import blob

SAVINGS = get_args(Saving)
EVERY = ("color", "depth", "face", "mask", "normal", "barycentric", "uv")


def distant_camera(distance: float = 4.0, size: tuple[int, int] = (60, 70), azimuth: float = 0.4) -> Camera:
    return look_from(azimuth, 0.2, 0.1, distance, 0.6, size)


def random_bodies(camera: Camera, random: np.random.Generator, count: int = 3) -> Scene:
    """Return a scene of bodies that occlude one another, some out of view or cut by the near plane, one textured."""
    vertices, faces, colors = blob(8)
    subjects = []
    for number in range(count):
        place = torch.tensor(random.uniform(-1.5, 1.5, 3) * random.choice([0.5, 1, 3]))
        subject = Scene((vertices + place).float(), faces, colors.float(), camera)
        if number == 1:
            image = torch.tensor(random.uniform(0, 1, (4, 5, 3)), dtype=torch.float32)
            uv = torch.tensor(random.uniform(0, 1, (len(vertices), 2)), dtype=torch.float32)
            subject = replace(subject, texture=Texture((image,), uv, faces))
        subjects.append(subject)
    return join_scenes(subjects)


def are_equal(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> bool:
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


@settings(deadline=None, max_examples=15, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_savings_change_no_bit(seed: int, cull: bool) -> None:
    random = np.random.default_rng(seed)
    scene = random_bodies(distant_camera(float(random.uniform(0.3, 6))), random)
    plain = Rasterizer(cull=cull, savings=())(scene, EVERY)
    for count in range(1, len(SAVINGS) + 1):
        for chosen in itertools.combinations(SAVINGS, count):
            renderer = Rasterizer(cull=cull, savings=chosen)
            assert are_equal(plain, renderer(scene, EVERY)), chosen
            assert are_equal(plain, renderer(scene, EVERY)), (chosen, "again")
            mask = renderer(scene, ("mask",))["mask"]
            assert torch.equal(mask, plain["mask"]), chosen


@settings(deadline=None, max_examples=15, derandomize=True)
@given(st.integers(0, 2**32 - 1))
def test_a_reused_renderer_draws_the_same_as_a_new_one(seed: int) -> None:
    """Draw scenes that change in one part at a time, also in place and without torch's version counter noticing."""
    random = np.random.default_rng(seed)
    renderer = Rasterizer(savings=SAVINGS)
    scene = random_bodies(distant_camera(), random)
    for _ in range(12):
        change = random.integers(8)
        if change == 0:
            scene = random_bodies(distant_camera(), random, int(random.integers(1, 4)))
        elif change == 1:
            scene.vertices.numpy()[random.integers(len(scene.vertices))] += 0.3
        elif change == 2:
            scene.faces.numpy()[random.integers(len(scene.faces))] = 0
        elif change == 3:
            scene.colors.data.mul_(0.9)  # type: ignore[union-attr]
        elif change == 4:
            scene = replace(scene, camera=distant_camera(azimuth=float(random.uniform(0, 6))))
        elif change == 5:
            scene = replace(scene, camera=replace(scene.camera, height=int(random.integers(1, 90))))
        elif change == 6:
            scene = replace(scene, camera=replace(scene.camera, near=float(random.uniform(0.1, 4))))
        else:
            renderer.cull = not renderer.cull
        channels = [name for name in EVERY if random.random() < 0.4]
        new = Rasterizer(cull=renderer.cull, savings=())
        got = renderer(scene, channels)
        assert are_equal(got, new(scene, channels)), (change, channels)
        for picture in got.values():
            picture.numpy()[...] = 7  # the caller may change the results


def test_unchanged_results_are_not_computed_again() -> None:
    scene = random_bodies(distant_camera(), np.random.default_rng(0))
    renderer = Rasterizer()
    renderer(scene, ("color",))
    assert renderer.report is not None and renderer.report.reused == frozenset()
    first = renderer.report
    renderer(scene, ("depth",))
    assert renderer.report is not None and renderer.report.reused == {"places", "faces"}
    assert (renderer.report.left_out, renderer.report.drawn_faces) == (first.left_out, first.drawn_faces)
    renderer(replace(scene, faces=scene.faces.flip(0)), ("depth",))
    assert renderer.report.reused == {"places"}
    renderer(replace(scene, vertices=scene.vertices + 1e-6), ("depth",))
    assert renderer.report.reused == frozenset()
    again = Rasterizer(savings=("view", "box", "hidden"))
    for _ in range(2):
        again(scene, ("color",))
        assert again.report is not None and again.report.reused == frozenset()


def count_outcomes(scene: Scene, cull: bool) -> dict[str, int]:
    """Count the faces of a scene in front of the near plane by their outcome, one by one."""
    camera = scene.camera
    pixels, depth = camera.project(scene.vertices.double())
    assert (depth >= camera.near).all()
    corner = (pixels * 256).round().numpy()[scene.faces.numpy()]
    counts = {"flat": 0, "back": 0, "outside": 0, "drawn": 0}
    for a, b, c in corner:
        area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
        low = np.maximum(np.ceil(np.min([a, b, c], 0) / 256), 0)
        high = np.minimum(np.floor(np.max([a, b, c], 0) / 256), [camera.width - 1, camera.height - 1])
        if area == 0:
            counts["flat"] += 1
        elif cull and area > 0:
            counts["back"] += 1
        elif (low > high).any():
            counts["outside"] += 1
        else:
            counts["drawn"] += 1
    return counts


@pytest.mark.parametrize("cull", [False, True])
@pytest.mark.parametrize("shift", [0.0, 0.8, 3.0])
def test_the_report_equals_brute_force_counts(cull: bool, shift: float) -> None:
    vertices, faces, colors = blob(12)
    degenerate = torch.cat([faces, faces[:5, [0, 0, 1]]])
    camera = replace(
        distant_camera(),
        rotation=distant_camera().rotation.double(),
        translation=distant_camera().translation.double(),
    )
    scene = Scene(vertices + torch.tensor([shift, 0, 0]), degenerate, colors, camera)
    renderer = Rasterizer(cull=cull, savings=("box",))
    for channels in (("color",), ("mask",), ("color", "depth", "face")):
        picture = renderer(scene, channels)
        report = renderer.report
        assert report is not None
        wanted = count_outcomes(scene, cull)
        assert report.faces == len(degenerate) == sum(wanted.values())
        assert report.drawn_faces == wanted.pop("drawn")
        assert dict(report.left_out) == {name: count for name, count in wanted.items() if count}
        assert report.channels == set(channels) and report.visited <= 60 * 70
        rows, columns = np.nonzero(picture[channels[0]].reshape(60, 70, -1).numpy().any(-1))
        if channels != ("color", "depth", "face") and len(rows):
            assert report.visited >= (np.ptp(rows) + 1) * (np.ptp(columns) + 1)


def test_faces_out_of_view_behind_and_hidden_are_counted() -> None:
    vertices, faces, colors = blob(12)
    scene = Scene(vertices, faces, colors, distant_camera())
    renderer = Rasterizer(savings=SAVINGS)
    renderer(replace(scene, vertices=vertices + 50))
    report = renderer.report
    assert report is not None and dict(report.left_out) == {"outside": len(faces)} and report.visited == 0
    renderer(replace(scene, camera=replace(scene.camera, near=8.0)), ("mask",))
    assert renderer.report is not None and dict(renderer.report.left_out) == {"outside": len(faces)}
    no_view = Rasterizer(savings=())
    no_view(replace(scene, camera=replace(scene.camera, near=8.0)), ("mask",))
    assert no_view.report is not None and dict(no_view.report.left_out) == {"behind": len(faces)}
    half = Rasterizer()
    half(replace(scene, camera=replace(scene.camera, near=4.0)), ("mask",))
    assert half.report is not None and 0 < half.report.left_out["behind"] < len(faces)
    corners = torch.tensor([[-4.0, -4, 2], [4, -4, 2], [4, 4, 2], [-4, 4, 2]]).double()
    wall = (corners - scene.camera.translation) @ scene.camera.rotation.double()
    before = Scene(wall, torch.tensor([[0, 1, 2], [0, 2, 3]]), torch.rand(4, 3).double(), scene.camera)
    both = join_scenes([scene, before])
    close = Rasterizer(savings=SAVINGS)
    picture = close(both, ("color", "face"))
    assert are_equal(picture, Rasterizer(savings=())(both, ("color", "face")))
    assert (picture["face"] >= len(faces)).all()
    assert close.report is not None and close.report.left_out["hidden"] > 0.8 * len(faces)
    floor = torch.tensor([[-90.0, -90, -1.5], [90, -90, -1.5], [90, 90, -1.5], [-90, 90, -1.5]]).double()
    under = join_scenes([scene, replace(before, vertices=floor), replace(before, vertices=floor + 0.01)])
    # these faces are cut by the near plane
    assert are_equal(close(under, ("face",)), Rasterizer(savings=())(under, ("face",)))


def test_soft_images_report_the_outcome_of_every_face() -> None:
    vertices, faces, colors = blob(12)
    scene = Scene(vertices, torch.cat([faces, faces[:5, [0, 0, 1]]]), colors, distant_camera())
    for cull in (False, True):
        renderer, hard = Rasterizer(gradient="soft", sigma=1e-8, cull=cull), Rasterizer(cull=cull)
        renderer(scene)
        hard(scene)
        soft, hard_report = renderer.report, hard.report
        assert soft is not None and hard_report is not None
        assert soft.drawn_faces + sum(soft.left_out.values()) == soft.faces == hard_report.faces
        assert soft.left_out.get("back", 0) == pytest.approx(hard_report.left_out.get("back", 0), abs=20)
        assert soft.left_out["flat"] >= 5 and soft.drawn_faces > 100
    renderer(replace(scene, camera=replace(scene.camera, near=4.0)))
    assert renderer.report is not None and 0 < renderer.report.left_out["behind"] < len(scene.faces)


@pytest.mark.parametrize("name", ["vertices", "colors"])
def test_a_gradient_of_inputs_changed_in_place_raises_an_error(name: str) -> None:
    """Check that torch raises an error for such a gradient, as for its own functions.

    Torch also raises an error for a second backward pass after the first has freed its data.
    """
    vertices, faces, colors = blob(6)
    learned = {"vertices": vertices.clone().requires_grad_(), "colors": colors.clone().requires_grad_()}
    loss = Rasterizer()(Scene(learned["vertices"], faces, learned["colors"], distant_camera()))["color"].sum()
    with torch.no_grad():
        learned[name] += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()
    again = Rasterizer()(Scene(learned["vertices"], faces, learned["colors"], distant_camera()))[
        "color"
    ].sum()
    again.backward()
    with pytest.raises(RuntimeError, match="second time"):
        again.backward()


def test_images_in_one_graph_keep_the_data_of_their_gradients() -> None:
    """Check that one backward pass over several views gives the sum of their gradients."""
    vertices, faces, colors = blob(8)
    views = [distant_camera(azimuth=azimuth) for azimuth in (0.1, 1.7, 3.1, 4.4)]

    def slope(renderer: Rasterizer, cameras: list[Camera]) -> torch.Tensor:
        learned = vertices.clone().requires_grad_()
        pictures = [renderer(Scene(learned, faces, colors, camera))["color"] for camera in cameras]
        renderer(Scene(vertices + 1, faces, colors, views[0]))
        loss = torch.stack([picture.square().sum() for picture in pictures]).sum()
        return torch.autograd.grad(loss, learned)[0]

    renderer = Rasterizer()
    together = slope(renderer, views)
    separate_sum = torch.stack([slope(Rasterizer(), [camera]) for camera in views]).sum(0)
    assert torch.allclose(together, separate_sum, rtol=1e-12)
    sides = renderer.batch([Scene(vertices, faces, colors, camera) for camera in views], ("color",))
    assert all(
        are_equal(side, renderer(Scene(vertices, faces, colors, camera)))
        for side, camera in zip(sides, views, strict=True)
    )


@pytest.mark.parametrize(
    "threads", [pytest.param(1, marks=pytest.mark.slow), 2, pytest.param(3, marks=pytest.mark.slow)]
)
def test_a_batch_equals_its_scenes_one_by_one(threads: int) -> None:
    """Check scenes of different sizes and meshes, with and without gradients."""
    random = np.random.default_rng(1)
    scenes = [
        random_bodies(
            distant_camera(size=(int(random.integers(1, 80)), int(random.integers(1, 80)))), random, 2
        )
        for _ in range(9)
    ]
    learned = [scene.vertices.clone().requires_grad_() for scene in scenes]
    differentiable = [
        replace(scene, vertices=vertices) for scene, vertices in zip(scenes, learned, strict=True)
    ]
    renderer, before = Rasterizer(), torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        batch = renderer.batch(differentiable, ("color", "depth"))
        with torch.no_grad():
            assert not any(picture["color"].requires_grad for picture in renderer.batch(differentiable))
        assert renderer.batch([]) == []
    finally:
        torch.set_num_threads(before)
    for picture, scene, vertices in zip(batch, differentiable, learned, strict=True):
        alone = Rasterizer()(scene, ("color", "depth"))
        assert are_equal(picture, alone)
        batch_gradient, single_gradient = (
            torch.autograd.grad(channels["color"].square().sum(), vertices)[0]
            for channels in (picture, alone)
        )
        assert torch.equal(batch_gradient, single_gradient)


def test_after_the_first_image_only_images_are_allocated() -> None:
    """Check this with and without gradients, and that deleted images leave no memory behind."""
    vertices, faces, colors = blob(40)
    scene = Scene(vertices, faces, colors, distant_camera(size=(300, 300)))
    renderer = Rasterizer(cull=True)
    own = 300 * 300 * 3 * 4
    for number in range(3):
        renderer(replace(scene, vertices=vertices + 0.01 * number))
    tracemalloc.start()
    for number in range(3, 8):
        moved = replace(scene, vertices=vertices + 0.01 * number)
        tracemalloc.reset_peak()
        start = tracemalloc.get_traced_memory()[0]
        renderer(moved)
        assert tracemalloc.get_traced_memory()[1] - start < own + 50_000
    tracemalloc.stop()
    learned = vertices.clone().requires_grad_()
    for _ in range(20):
        renderer(replace(scene, vertices=learned))["color"].sum().backward()
    gc.collect()
    assert len(renderer._pool) <= 2
    assert not [
        candidate for candidate in gc.get_objects() if type(candidate).__name__ == "DrawImageBackward"
    ]


@pytest.mark.parametrize("gradient", get_args(Gradient))
def test_an_image_of_27_thousand_vertices_and_its_gradient_take_less_than_64_mib(gradient: Gradient) -> None:
    """Measure the memory of NumPy arrays; benchmarks/rendering/rasterizer_memory.md measures that of a process."""
    vertices, faces, colors = blob(117)
    assert len(vertices) > 27_554
    learned, painted = vertices.float().requires_grad_(), colors.float().requires_grad_()
    scene = Scene(learned, faces, painted, distant_camera(size=(410, 308)))
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    Rasterizer(gradient=gradient)(scene)["color"].sum().backward()
    peak = tracemalloc.get_traced_memory()[1] - before
    tracemalloc.stop()
    assert peak < 64 * 2**20


def test_memory_kept_between_images_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces, colors = blob(8)
    scene = Scene(vertices, faces, colors, distant_camera(size=(200, 200)))
    renderer = Rasterizer()
    pictures = [
        renderer(replace(scene, vertices=vertices.clone().requires_grad_()))["color"] for _ in range(12)
    ]
    assert len(renderer._pool) == 0
    monkeypatch.setattr(canvas, "MOST_BYTES", 10**6)
    del pictures
    assert 1 <= len(renderer._pool) < 12 and sum(unused.bytes for unused in renderer._pool) <= 10**6
    renderer(replace(scene, camera=distant_camera(size=(2000, 2000))))
    assert sum(unused.bytes for unused in renderer._pool) <= 10**6
    assert are_equal(renderer(scene, EVERY), Rasterizer()(scene, EVERY))


def test_a_renderer_can_be_copied_and_sent_to_another_process() -> None:
    scene = random_bodies(distant_camera(), np.random.default_rng(0))
    renderer = Rasterizer()
    picture = renderer(scene, EVERY)
    for other in (copy.deepcopy(renderer), pickle.loads(pickle.dumps(renderer))):
        assert are_equal(other(scene, EVERY), picture)
