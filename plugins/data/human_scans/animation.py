"""Generated people in many poses, cameras on a circle around them, and images of several renderers side by side."""

import copy
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from framework.bodies.topologies import Name
from framework.datasets.scan_layout import RegisteredMesh
from framework.geometry.camera import Camera, canonical_camera
from framework.geometry.srgb import bytes_from_linear, linear_from_bytes
from framework.renderer import Renderer, Scene
from plugins.data.human_scans.dressed import Scan
from plugins.data.human_scans.photographs import take_photographs
from plugins.data.human_scans.scan_generator import Crowd

LOOK_DOWN = math.radians(8)
FREE = 0.92
"""Largest share of an image's height or width that a person fills."""
CAPTION = 16  # pixels
SAYS = "synthetic"


class Moment(NamedTuple):
    """State of a person at one time.

    Attributes:
        vertices: vertices of the registered mesh, metres.
        scan: scan of the person in this state; None if only the registered mesh is known.
    """

    vertices: Float[Tensor, "vertices 3"]
    scan: Scan | None


@dataclass(frozen=True)
class Actor:
    """Person who is drawn repeatedly; the positions of the vertices are those of a `Moment`.

    Attributes:
        faces: triangles, as indices of the vertices.
        colors: linear RGB of each vertex.
    """

    faces: Int[Tensor, "faces 3"]
    colors: Float[Tensor, "vertices 3"]

    def scene(self, moment: Moment, camera: Camera) -> Scene:
        """Return the scene in which the camera sees the person at this moment."""
        return Scene(moment.vertices, self.faces, self.colors, camera)


class Generated:
    """Person of a generated data set, who can take any pose.

    The registered mesh comes from the data set and is brought into each pose; its distances from the bare body and its
    colours do not change. The scan is generated anew in each pose, with the same clothes, hair and light, and with the
    shading of the pose.

    Args:
        crowd: all people of the data set.
        split: split of the person.
        number: number of the person in the split.
        name: name of the topology of the registered mesh.

    Attributes:
        stood: the pose that photographs of the data set show.
        registration: the registered mesh in the topology and the pose of the data set.
    """

    def __init__(self, crowd: Crowd, split: str, number: int, name: Name) -> None:
        self.crowd, self.wardrobe = crowd, crowd.wardrobe
        self.shape, self.stood, skin, self._random = crowd.person(split, number)
        self._bare = crowd.posed(self.shape, self.stood)
        self.worn = self.wardrobe.clothes(skin, self._random)
        random = copy.deepcopy(self._random)
        scan, visible = self.wardrobe.scan(self._bare, self.worn, random)
        self._registered = self.wardrobe.register(self._bare, scan, visible, random)
        mesh = crowd.meshes[name]
        self._rows = mesh.rows
        self.registration = RegisteredMesh(
            torch.from_numpy(self._registered.vertices[mesh.rows]).float(),
            torch.from_numpy(self._registered.colors[mesh.rows]),
            torch.from_numpy(mesh.faces),
        )
        self._first = Moment(self.registration.vertices, scan)
        self._floor = float(self.registration.vertices[:, 1].min())

    def first(self) -> Moment:
        """Return the person in the pose of the data set."""
        return self._first

    def at(self, pose: Float[np.ndarray, "joint 3"]) -> Moment:
        """Return the person in a pose, moved vertically so that the feet are on the floor."""
        bare = self.crowd.posed(self.shape, torch.from_numpy(pose)[None])
        scan, _ = self.wardrobe.scan(bare, self.worn, copy.deepcopy(self._random))
        vertices = self.wardrobe.repose(self._registered.vertices, self._bare, bare)[self._rows]
        up = np.array([0.0, self._floor - vertices[:, 1].min(), 0.0])
        moved = Scan(scan.vertices + up, scan.faces, scan.colors)
        return Moment(torch.from_numpy(vertices + up).float(), moved)


def actor(registration: RegisteredMesh) -> Actor:
    """Return the person that a registered mesh shows; its 8-bit sRGB colours are converted to linear RGB."""
    return Actor(registration.faces, linear_from_bytes(registration.colors))


def orbit(moments: Sequence[Moment], azimuths: Sequence[float], size: tuple[int, int]) -> list[Camera]:
    """Return a camera for each azimuth; all of them look at the middle of the box around the person in all states.

    All cameras have the same distance from the middle: the smallest at which each camera shows the whole person in
    every state.

    Args:
        moments: states of the person.
        azimuths: azimuth of each camera, radians; 0 is in front (z), and larger angles lie towards the subject's left
            (x).
        size: (height, width), pixels.
    """
    every = torch.cat(
        [distinct.vertices for distinct in {id(item.vertices): item for item in moments}.values()]
    ).double()
    middle = (every.amin(0) + every.amax(0)) / 2
    plain = canonical_camera(*size)
    # a point is in view if focal |x| / (z + distance) is at most half the free width
    steep = torch.tensor(plain.focal, dtype=torch.float64) * 2 / FREE / torch.tensor(size[::-1])
    rotations = [_towards(azimuth) for azimuth in azimuths]
    away = 0.0
    for rotation in {tuple(item.flatten().tolist()): item for item in rotations}.values():
        camera_points = (every - middle) @ rotation.T
        away = max(away, float((steep * camera_points[:, :2].abs() - camera_points[:, 2:]).max()))
    ahead = torch.tensor([0.0, 0.0, away], dtype=torch.float64)
    return [
        Camera(turn.float(), (ahead - turn @ middle).float(), plain.focal, plain.principal, *size)
        for turn in rotations
    ]


def _towards(azimuth: float) -> Float[Tensor, "3 3"]:
    """Return the rotation from world to camera (x right, y down, z forward) of a camera at an azimuth, radians.

    The camera looks down by the angle LOOK_DOWN.
    """
    sine, cosine = math.sin(azimuth), math.cos(azimuth)
    level = math.cos(LOOK_DOWN)
    back = torch.tensor([level * sine, math.sin(LOOK_DOWN), level * cosine], dtype=torch.float64)
    right = torch.tensor([cosine, 0.0, -sine], dtype=torch.float64)
    return torch.stack([right, torch.linalg.cross(right, back), -back])


def on_white(renderer: Renderer, scene: Scene) -> UInt8[np.ndarray, "height width 3"]:
    """Return an 8-bit sRGB image of the scene on white, whatever background the renderer draws."""
    if renderer.background == 1:
        return bytes_from_linear(renderer(scene)["color"]).numpy()
    assert scene.colors is not None
    cover = torch.ones(len(scene.vertices), 1)  # a fourth channel: share of a pixel that is covered
    rendered = renderer(
        Scene(scene.vertices, scene.faces, torch.cat([scene.colors, cover], 1), scene.camera)
    )["color"]
    return bytes_from_linear(rendered[..., :3] + 1 - rendered[..., 3:]).numpy()


def photograph(renderer: Renderer, scan: Scan, camera: Camera) -> UInt8[np.ndarray, "height width 3"]:
    """Return a photograph of the scan like those in the data set, 8-bit sRGB, on white."""
    scene = Scene(
        torch.from_numpy(scan.vertices).float(),
        torch.from_numpy(scan.faces),
        torch.from_numpy(scan.colors).float(),
        camera,
    )
    pixels, mask = take_photographs(renderer, scene, [camera])[0]
    cover = torch.from_numpy(mask).float()[..., None] / 255
    return bytes_from_linear(linear_from_bytes(torch.from_numpy(pixels)) * cover + 1 - cover).numpy()


def columns(
    actor: Actor,
    moments: Sequence[Moment],
    cameras: Sequence[Camera],
    renderers: Mapping[str, Renderer],
    camera_of_truth: Renderer,
) -> Iterator[dict[str, UInt8[np.ndarray, "height width 3"]]]:
    """Yield for each frame a dictionary of images: one for each renderer, and "photograph" if the scan is known.

    Args:
        actor: the person.
        moments: state of the person in each frame.
        cameras: camera of each frame.
        renderers: renderers that draw the registered mesh, by the name of their image.
        camera_of_truth: renderer that draws the photograph from the scan.
    """
    for moment, camera in zip(moments, cameras, strict=True):
        scene = actor.scene(moment, camera)
        images = {name: on_white(renderer, scene) for name, renderer in renderers.items()}
        if moment.scan is not None:
            images["photograph"] = photograph(camera_of_truth, moment.scan, camera)
        yield images


def side_by_side(pictures: Mapping[str, UInt8[np.ndarray, "height width 3"]], synthetic: bool) -> Image.Image:
    """Return one image that shows the given images in a row, with their names below.

    If `synthetic` is true, a note in the returned image says that the images are synthetic. The note stands in a line
    of its own if the images are too narrow for it.
    """
    height, width = next(iter(pictures.values())).shape[:2]
    font = ImageFont.load_default(11)
    fits = font.getlength(f"{[*pictures][-1]} {SAYS}") + 10 <= width
    lines = 1 if fits or not synthetic else 2
    sheet = Image.new("RGB", (width * len(pictures), height + lines * CAPTION), "white")
    pen = ImageDraw.Draw(sheet)
    for number, (name, pixels) in enumerate(pictures.items()):
        sheet.paste(Image.fromarray(pixels), (number * width, 0))
        pen.text((number * width + 5, height + 1), name, "black", font)
    if synthetic:
        place = (sheet.width - 5, sheet.height - CAPTION + 1)
        pen.text(place, SAYS, (150, 0, 0), font, anchor="ra")
    return sheet
