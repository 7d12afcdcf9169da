"""Draw contact sheets of people who are not in the training data, as in the thesis's Figures 7.2 to 7.5.

    python -m reproduction.chapter7.smplpix_figures <run of smplpix/quick> <run of smplpix/hybrid>

Other people than in training, other views, other poses, other shapes: projected points, mesh, what each run paints,
photograph, and where each is off. Writes smplpix_figures.md and each figure beside this file.
"""

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.pages import machine, write_page
from benchmarks.rendering.smplpix_flicker import rendered, training
from framework.bodies import poses
from framework.bodies.shape_space import reduce_shapes
from framework.configuration.loading import read_stored
from framework.configuration.schema import build, resolve
from framework.figures.style import titled_figure
from framework.geometry.camera import Camera
from framework.geometry.srgb import srgb_from_linear
from framework.renderer import Renderer, Scene
from plugins.data.human_scans.animate import data_of, generated_person
from plugins.data.human_scans.animation import Generated, Moment, actor, on_white, orbit, photograph
from plugins.data.human_scans.data import HumanScans
from plugins.data.human_scans.repose import shape_change, subject

HERE = Path(__file__).resolve()
TRUTH = "photograph"
SUBJECTS = ("test_0000", "test_0003", "test_0005", "test_0009")
VIEWS = tuple(math.radians(degrees) for degrees in (0, 60, 120, 180, 240, 300))
FRONT = math.radians(25)
POSES = 5
SHAPES = ("0=-2", "0=2", "1=-2", "1=2", "2=-2", "2=2")
"""Directions and standard deviations, as plugins.data.human_scans.repose has them."""
DARKER = 3
"""Errors are drawn so many times as large."""


NAMES = {"quick": "SMPLpix", "hybrid": "network over the mesh"}
"""Of runs, by their experiments; others are called as these."""
ABOUT = (
    "Generated people who are not in the training data: {height} × {width} pixels, {vertices:,} vertices. The mesh "
    "has its vertices' colours and 4 × 4 samples a pixel. For other poses, the registration to the first scan is "
    "posed and the clothed person is photographed in that pose; other shapes have no photograph, since clothes would "
    f"fall otherwise. Errors are drawn {DARKER} times as large as they are."
)


class Shot(NamedTuple):
    """What is drawn, and how; the photograph is known where the moment has a scan."""

    name: str
    scene: Scene
    moment: Moment


class Ways(NamedTuple):
    """How a scene is drawn, by what a sheet calls it; and what draws the data's photographs."""

    renderers: Mapping[str, Renderer]
    camera: Renderer
    size: tuple[int, int]


Pictures = dict[str, np.ndarray]
"""(height, width, 3), 0 to 255, by way."""


def main(runs: Sequence[str]) -> None:
    if not runs:
        sys.exit(__doc__)
    torch.set_num_threads(1)
    description, _ = read_stored(runs[0])
    data = data_of(description)
    height, width = description.target.size or (256, 192)
    renderers = {"mesh": rendered("rasterizer", supersampling=4)}
    for run in runs:
        method = read_stored(run)[0].method
        renderers[NAMES.get(method, method)] = rendered("smplpix", checkpoint=run)
    ways = Ways(renderers, data.renderer, (height, width))
    people = [generated_person(data, name) for name in SUBJECTS]
    figures = {
        "7_2": ("Figure 7.2: people of the test split", list(seen_from(people, FRONT, ways.size))),
        "7_3": ("Figure 7.3: views all around one of them", list(around(people[1], ways.size))),
        "7_4": ("Figure 7.4: one of them in other poses", list(posed(people[1], ways.size))),
        "7_5": ("Figure 7.5: one of them in other shapes", list(shaped(data, people[1], ways.size))),
    }
    lines = []
    for number, (title, shots) in figures.items():
        drawn = {shot.name: pictures(shot, ways) for shot in shots}
        place = HERE.with_name(f"{HERE.stem}_{number}.png")
        sheet(drawn, title).savefig(place)
        lines += [f"## {title}", "", f"![{title}]({place.name})", "", decibels(drawn), ""]
    about = ABOUT.format(height=height, width=width, vertices=len(people[0].registration.vertices))
    trained = "; ".join(
        f"{name}: {training(run).removesuffix('.')}"
        for name, run in zip(list(renderers)[1:], runs, strict=True)
    )
    told = f"{machine('torch', 'numpy')} Command: `python -m reproduction.chapter7.smplpix_figures <runs>`."
    text = [
        "# Qualitative results of SMPLpix, as in Figures 7.2 to 7.5 (synthetic people)",
        "",
        f"{about} Runs: {trained}.",
        "",
        *lines,
        told,
        "",
    ]
    write_page(HERE, text)


def seen_from(people: Sequence[Generated], azimuth: float, size: tuple[int, int]) -> Iterator[Shot]:
    for name, one in zip(SUBJECTS, people, strict=True):
        moment = one.first()
        (camera,) = orbit([moment], [azimuth], size)
        yield shot(name.replace("_", " "), one, moment, camera)


def around(one: Generated, size: tuple[int, int]) -> Iterator[Shot]:
    moment = one.first()
    for azimuth, camera in zip(VIEWS, orbit([moment] * len(VIEWS), VIEWS, size), strict=True):
        yield shot(f"{math.degrees(azimuth):.0f}°", one, moment, camera)


def posed(one: Generated, size: tuple[int, int]) -> Iterator[Shot]:
    body = one.crowd.body
    drawn = poses.rotations(body, poses.skeleton(body), poses.draw(POSES, np.random.default_rng(4)))
    moments = [one.first(), *(one.at(pose) for pose in drawn)]
    cameras = orbit(moments, [FRONT] * len(moments), size)
    for number, (moment, camera) in enumerate(zip(moments, cameras, strict=True)):
        yield shot(f"pose {number}" if number else "as scanned", one, moment, camera)


def shaped(data: HumanScans, one: Generated, size: tuple[int, int]) -> Iterator[Shot]:
    """Pose and shape are found from the registration alone; the photograph is known of the first alone."""
    few = reduce_shapes(one.crowd.body, one.crowd.traits)
    found = subject(one.crowd.body, few, one.registration, SUBJECTS[1])
    count = few.shapes.shape[-1]
    meshes = {
        f"direction {int(text[0]) + 1}, {float(text[2:]):+g} SD": found.posed(
            change=shape_change(text, count)
        )
        for text in SHAPES
    }
    moments = [one.first(), *(Moment(mesh.vertices, None) for mesh in meshes.values())]
    cameras = orbit(moments, [FRONT] * len(moments), size)
    for name, moment, camera in zip(["as scanned", *meshes], moments, cameras, strict=True):
        yield shot(name, one, moment, camera)


def shot(name: str, one: Generated, moment: Moment, camera: Camera) -> Shot:
    return Shot(name, actor(one.registration).scene(moment, camera), moment)


@torch.no_grad()
def pictures(given: Shot, ways: Ways) -> Pictures:
    found = {"points": projected(given.scene, ways.size)}
    found |= {name: on_white(renderer, given.scene) for name, renderer in ways.renderers.items()}
    if given.moment.scan is not None:
        found[TRUTH] = photograph(ways.camera, given.moment.scan, given.scene.camera)
    return found


def projected(scene: Scene, size: tuple[int, int]) -> np.ndarray:
    config = {"name": "projection", "height": size[0], "width": size[1]}
    encoder = build("encoder", resolve("encoder", config), input_shape=(1, 6), input_columns=())
    assert scene.colors is not None
    points = torch.cat([scene.camera.to_canonical(scene.vertices), srgb_from_linear(scene.colors)], 1)[None]
    image: Tensor = encoder(points)[0, :3]
    return (255 * image.permute(1, 2, 0)).round().byte().numpy()


def sheet(drawn: Mapping[str, Pictures], title: str) -> Figure:
    """A column for each shot; below the ways their errors, where there is a photograph."""
    first = next(iter(drawn.values()))
    ways = list(first)
    judged = [name for name in ways if name not in ("points", TRUTH)]
    rows = [
        *ways,
        *(f"{name}, error" for name in judged if any(TRUTH in one for one in list(drawn.values())[1:])),
    ]
    rows_of, columns_of = shown(drawn)
    height, width = rows_of.stop - rows_of.start, columns_of.stop - columns_of.start
    figure = titled_figure((1.3 * len(drawn) + 0.5, 1.3 * height / width * len(rows) + 0.6), title, True)
    axes = figure.subplots(len(rows), len(drawn), squeeze=False)
    for column, (name, some) in enumerate(drawn.items()):
        axes[0, column].set_title(name, fontsize=9)
        for row, way in enumerate(rows):
            place = axes[row, column]
            place.set(xticks=[], yticks=[])
            place.spines[:].set_visible(False)
            if column == 0:
                place.set_ylabel(way.replace(" over ", "\nover ").replace(", ", ",\n"), fontsize=9)
            pixels = some.get(way)
            if way.endswith(", error") and TRUTH in some:
                off = np.abs(some[way.removesuffix(", error")].astype(int) - some[TRUTH])
                pixels = (255 - DARKER * off).clip(0, 255).astype(np.uint8)
            if pixels is not None:
                place.imshow(pixels[rows_of, columns_of])
    return figure


def shown(drawn: Mapping[str, Pictures]) -> tuple[slice, slice]:
    """Rows and columns that hold all people, and a few pixels about them."""
    some = [
        pixels
        for one in drawn.values()
        for pixels in (one["points"], one["mesh"], one.get(TRUTH, one["mesh"]))
    ]
    dark = (np.stack(some) < 250).any(-1).any(0)

    def span(axis: int) -> slice:
        places = np.nonzero(dark)[axis]
        return slice(max(int(places.min()) - 4, 0), int(places.max()) + 5)

    return span(0), span(1)


def decibels(drawn: Mapping[str, Pictures]) -> str:
    """PSNR of the frame, mean over the shots whose photograph is known."""
    known = [some for some in drawn.values() if TRUTH in some]
    ways = [name for name in known[0] if name not in ("points", TRUTH)]
    means = []
    for name in ways:
        errors = [np.square((some[name].astype(float) - some[TRUTH]) / 255).mean() for some in known]
        means.append(f"{name} {np.mean(-10 * np.log10(errors)):.1f} dB")
    count = f"{len(known)} images" if len(known) > 1 else "one image"
    return f"PSNR of the frame, mean of {count}: {', '.join(means)}."


if __name__ == "__main__":
    main(sys.argv[1:])
