"""Draw contact sheets of people who are not in the training data, as in the thesis's Figures 7.2 to 7.5.

    python -m reproduction.chapter7.smplpix_figures <run of smplpix/quick> <run of smplpix/hybrid>

The figures show other people, views, poses and shapes than the training data. Each figure compares projected points,
the mesh, the image of each run and the photograph, and shows the errors. The script writes smplpix_figures.md and the
figures beside this file.
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
from benchmarks.rendering.builders import build_renderer
from benchmarks.rendering.smplpix_flicker import describe_training
from framework.bodies import poses
from framework.bodies.shape_space import reduce_shapes
from framework.configuration.loading import read_stored, training_data
from framework.configuration.schema import build, resolve
from framework.figures.style import titled_figure
from framework.geometry.camera import Camera
from framework.geometry.srgb import srgb_from_linear
from framework.renderer import Renderer, Scene
from plugins.data.human_scans.animate import generated_person
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
"""Changes of shape: "0=-2" changes shape coefficient 0 by -2 standard deviations (plugins.data.human_scans.repose)."""
ERROR_FACTOR = 3
"""Factor by which errors are enlarged in the figures."""


NAMES = {"quick": "SMPLpix", "hybrid": "network over the mesh"}
"""Names of runs by experiment; other runs keep the name of their experiment."""
ABOUT = (
    "The people in the figures are generated. An image has {height} × {width} pixels, and the mesh has {vertices:,} "
    "coloured vertices and is drawn with 4 × 4 samples per pixel. For other poses, the mesh that is registered to the "
    "first scan is posed, and the clothed person is photographed in that pose. Other shapes have no photograph, "
    "because clothes would fall differently on them. The last rows of a figure show the errors, enlarged "
    f"{ERROR_FACTOR} times. PSNR is the peak signal-to-noise ratio over the whole frame."
)


class Shot(NamedTuple):
    """A scene with its name; the photograph is known if the moment has a scan."""

    name: str
    scene: Scene
    moment: Moment


class DrawingMethods(NamedTuple):
    """Renderers of a scene by name, the renderer of the photographs, and the image size."""

    renderers: Mapping[str, Renderer]
    camera: Renderer
    size: tuple[int, int]


Images = dict[str, np.ndarray]
"""Images by method, (height, width, 3), 0 to 255."""


def main(runs: Sequence[str]) -> None:
    if not runs:
        sys.exit(__doc__)
    torch.set_num_threads(1)
    description, _ = read_stored(runs[0])
    data = training_data(description, "human_scans")
    height, width = description.target.size or (256, 192)
    renderers = {"mesh": build_renderer("rasterizer", supersampling=4)}
    for run in runs:
        method = read_stored(run)[0].method
        renderers[NAMES.get(method, method)] = build_renderer("smplpix", checkpoint=run)
    methods = DrawingMethods(renderers, data.renderer, (height, width))
    people = [generated_person(data, name) for name in SUBJECTS]
    figures = {
        "7_2": ("Figure 7.2: people of the test split", list(shots_of_people(people, FRONT, methods.size))),
        "7_3": ("Figure 7.3: views all around one of them", list(shots_of_views(people[1], methods.size))),
        "7_4": ("Figure 7.4: one of them in other poses", list(shots_of_poses(people[1], methods.size))),
        "7_5": (
            "Figure 7.5: one of them in other shapes",
            list(shots_of_shapes(data, people[1], methods.size)),
        ),
    }
    lines = []
    for number, (title, shots) in figures.items():
        images_by_shot = {shot.name: draw_shot(shot, methods) for shot in shots}
        path = HERE.with_name(f"{HERE.stem}_{number}.png")
        draw_sheet(images_by_shot, title).savefig(path)
        lines += [f"## {title}", "", f"![{title}]({path.name})", "", psnr_sentence(images_by_shot), ""]
    about = ABOUT.format(height=height, width=width, vertices=len(people[0].registration.vertices))
    trained = [
        f"- {name}: {describe_training(run)}" for name, run in zip(list(renderers)[1:], runs, strict=True)
    ]
    footer = f"{machine('torch', 'numpy')} Command: `python -m reproduction.chapter7.smplpix_figures <runs>`."
    text = [
        "# Qualitative results of SMPLpix, as in Figures 7.2 to 7.5 (synthetic people)",
        "",
        "This page shows qualitative results as in Figures 7.2 to 7.5 of the thesis: images of people who are not in "
        "the training data. Each figure compares the projected vertices of a mesh, the drawn mesh, the networks and "
        "the photograph.",
        "",
        about,
        "",
        '"Network over the mesh" means a network that reads the drawn mesh and improves its image. The networks in the '
        "figures were trained as follows:",
        *trained,
        "",
        *lines,
        footer,
        "",
    ]
    write_page(HERE, text)


def shots_of_people(people: Sequence[Generated], azimuth: float, size: tuple[int, int]) -> Iterator[Shot]:
    for name, person in zip(SUBJECTS, people, strict=True):
        moment = person.first()
        (camera,) = orbit([moment], [azimuth], size)
        yield make_shot(name.replace("_", " "), person, moment, camera)


def shots_of_views(person: Generated, size: tuple[int, int]) -> Iterator[Shot]:
    moment = person.first()
    for azimuth, camera in zip(VIEWS, orbit([moment] * len(VIEWS), VIEWS, size), strict=True):
        yield make_shot(f"{math.degrees(azimuth):.0f}°", person, moment, camera)


def shots_of_poses(person: Generated, size: tuple[int, int]) -> Iterator[Shot]:
    body = person.crowd.body
    rotations = poses.rotations(body, poses.skeleton(body), poses.draw(POSES, np.random.default_rng(4)))
    moments = [person.first(), *(person.at(pose) for pose in rotations)]
    cameras = orbit(moments, [FRONT] * len(moments), size)
    for number, (moment, camera) in enumerate(zip(moments, cameras, strict=True)):
        yield make_shot(f"pose {number}" if number else "as scanned", person, moment, camera)


def shots_of_shapes(data: HumanScans, person: Generated, size: tuple[int, int]) -> Iterator[Shot]:
    """Yield shots of a person in other shapes; only the first has a photograph."""
    shape_space = reduce_shapes(person.crowd.body, person.crowd.traits)
    reposed = subject(person.crowd.body, shape_space, person.registration, SUBJECTS[1])
    count = shape_space.shapes.shape[-1]
    meshes = {
        f"direction {int(text[0]) + 1}, {float(text[2:]):+g} SD": reposed.posed(
            change=shape_change(text, count)
        )
        for text in SHAPES
    }
    moments = [person.first(), *(Moment(mesh.vertices, None) for mesh in meshes.values())]
    cameras = orbit(moments, [FRONT] * len(moments), size)
    for name, moment, camera in zip(["as scanned", *meshes], moments, cameras, strict=True):
        yield make_shot(name, person, moment, camera)


def make_shot(name: str, person: Generated, moment: Moment, camera: Camera) -> Shot:
    return Shot(name, actor(person.registration).scene(moment, camera), moment)


@torch.no_grad()
def draw_shot(shot: Shot, methods: DrawingMethods) -> Images:
    images = {"points": project_points(shot.scene, methods.size)}
    images |= {name: on_white(renderer, shot.scene) for name, renderer in methods.renderers.items()}
    if shot.moment.scan is not None:
        images[TRUTH] = photograph(methods.camera, shot.moment.scan, shot.scene.camera)
    return images


def project_points(scene: Scene, size: tuple[int, int]) -> np.ndarray:
    config = {"name": "projection", "height": size[0], "width": size[1]}
    encoder = build("encoder", resolve("encoder", config), input_shape=(1, 6), input_columns=())
    assert scene.colors is not None
    points = torch.cat([scene.camera.to_canonical(scene.vertices), srgb_from_linear(scene.colors)], 1)[None]
    image: Tensor = encoder(points)[0, :3]
    return (255 * image.permute(1, 2, 0)).round().byte().numpy()


def draw_sheet(images_by_shot: Mapping[str, Images], title: str) -> Figure:
    """Draw a column for each shot: its images, and below them their errors if there is a photograph."""
    first = next(iter(images_by_shot.values()))
    methods = list(first)
    judged = [name for name in methods if name not in ("points", TRUTH)]
    rows = [
        *methods,
        *(
            f"{name}, error"
            for name in judged
            if any(TRUTH in images for images in list(images_by_shot.values())[1:])
        ),
    ]
    rows_of, columns_of = crop_to_people(images_by_shot)
    height, width = rows_of.stop - rows_of.start, columns_of.stop - columns_of.start
    figure = titled_figure(
        (1.3 * len(images_by_shot) + 0.5, 1.3 * height / width * len(rows) + 0.6), title, True
    )
    axes = figure.subplots(len(rows), len(images_by_shot), squeeze=False)
    for column, (name, some) in enumerate(images_by_shot.items()):
        axes[0, column].set_title(name, fontsize=9)
        for row, method in enumerate(rows):
            panel = axes[row, column]
            panel.set(xticks=[], yticks=[])
            panel.spines[:].set_visible(False)
            if column == 0:
                panel.set_ylabel(method.replace(" over ", "\nover ").replace(", ", ",\n"), fontsize=9)
            pixels = some.get(method)
            if method.endswith(", error") and TRUTH in some:
                error = np.abs(some[method.removesuffix(", error")].astype(int) - some[TRUTH])
                pixels = (255 - ERROR_FACTOR * error).clip(0, 255).astype(np.uint8)
            if pixels is not None:
                panel.imshow(pixels[rows_of, columns_of])
    return figure


def crop_to_people(images_by_shot: Mapping[str, Images]) -> tuple[slice, slice]:
    """Return the slices of rows and columns that hold all people, with a margin of a few pixels."""
    frames = [
        pixels
        for images in images_by_shot.values()
        for pixels in (images["points"], images["mesh"], images.get(TRUTH, images["mesh"]))
    ]
    dark = (np.stack(frames) < 250).any(-1).any(0)

    def span(axis: int) -> slice:
        places = np.nonzero(dark)[axis]
        return slice(max(int(places.min()) - 4, 0), int(places.max()) + 5)

    return span(0), span(1)


def psnr_sentence(images_by_shot: Mapping[str, Images]) -> str:
    """Return a sentence with the mean PSNR over the shots that have a photograph."""
    known = [images for images in images_by_shot.values() if TRUTH in images]
    methods = [name for name in known[0] if name not in ("points", TRUTH)]
    means = []
    for name in methods:
        errors = [np.square((images[name].astype(float) - images[TRUTH]) / 255).mean() for images in known]
        means.append(f"{name} {np.mean(-10 * np.log10(errors)):.1f} dB")
    count = f"{len(known)} images" if len(known) > 1 else "one image"
    return f"Mean PSNR of {count}: {', '.join(means)}."


if __name__ == "__main__":
    main(sys.argv[1:])
