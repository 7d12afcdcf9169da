"""Generator of the images: `images.npy` and `rotations.npy` of every solid and split, and `synthetic.json`.

The same settings give the same bytes. The images of a solid do not depend on which other solids are chosen.
"""

import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from framework.data import Splits
from framework.geometry import quaternions
from framework.geometry.camera import look_from
from framework.geometry.rotation import viewpoint_rotation
from framework.geometry.srgb import bytes_from_linear
from framework.renderer import Renderer, Scene
from framework.storage.generated import ensure_generated
from framework.storage.progress import track_progress
from plugins.data.symmetric_solids.solids import SOLIDS, solid

VERSION = 1
"""Version of the generator; increase it if the output changes, so that a new folder is written."""
DISTANCE = 4.0
"""Distance of the camera from the centre of the solid, in radii of the ball around the solid."""
FIELD_OF_VIEW = 2 * math.asin(1.05 / DISTANCE)
"""Field of view, radians, in which the ball around the solid appears with a margin of 5 % of its radius."""
LAMP = (0.4, 0.6, 0.69)
"""Direction to the lamp in the frame of the camera (x right, y up, z to the viewer)."""
BATCH = 100
"""Number of images that are drawn at a time."""


def stream(seed: int, name: str, split: int, purpose: int) -> torch.Generator:
    """Return the random generator of a solid and split; `purpose` is 0 for the rotations, 1 for the labels."""
    key = np.random.SeedSequence([seed, list(SOLIDS).index(name), split, purpose]).generate_state(1)[0]
    return torch.Generator().manual_seed(int(key))


def random_rotations(count: int, generator: torch.Generator) -> Float[Tensor, "count 4"]:
    """Return uniformly random rotations as unit quaternions, float64."""
    turn = torch.randn(count, 4, dtype=torch.float64, generator=generator)
    return turn / torch.linalg.vector_norm(turn, dim=-1, keepdim=True)


def draw_images(
    name: str, turns: Float[Tensor, "sample 4"], size: int, renderer: Renderer
) -> UInt8[Tensor, "sample 1 size size"]:
    """Return images of a solid in the rotations `turns`, unit quaternions of the rotations from object to camera.

    The brightness of a surface is (1 + cos α)/2 for the angle α between its normal and the direction to the lamp. The
    lamp moves with the camera, so that a rotation that leaves the solid unchanged leaves its image unchanged.
    """
    shape = solid(name)
    vertices, faces = torch.from_numpy(shape.vertices).float(), torch.from_numpy(shape.faces)
    normals, lamp = torch.from_numpy(shape.normals), torch.tensor(LAMP, dtype=torch.float64)
    lamp = lamp / torch.linalg.vector_norm(lamp)
    images = []
    for part in turns.split(BATCH):
        angles = quaternions.to_viewpoint(part)
        toward_lamp = viewpoint_rotation(angles).mT @ lamp  # in the frame of the object
        brightness = ((1 + normals @ toward_lamp.mT) / 2).mT
        scenes = [
            Scene(
                vertices,
                faces,
                light.float()[:, None],
                look_from(*viewpoint, distance=DISTANCE, field_of_view=FIELD_OF_VIEW, size=(size, size)),
            )
            for viewpoint, light in zip(angles.tolist(), brightness, strict=True)
        ]
        drawn = torch.stack([channels["color"] for channels in renderer.batch(scenes)])
        images.append(bytes_from_linear(drawn.clamp(0, 1)).movedim(-1, 1))
    return torch.cat(images)


def ensure_solid(
    parent: Path, name: str, counts: dict[str, int], size: int, seed: int, renderer: Renderer
) -> Path:
    """Return the folder of the images of a solid, after generating them if it does not exist.

    Args:
        parent: folder of the folders of all solids.
        name: name of the solid.
        counts: number of images of each split, by its name.
        size: side of the images, pixels.
        seed: seed of the rotations.
        renderer: renderer that draws the images.

    Raises:
        DataError: the cache cannot be written, or holds other data under the same name.
    """
    renderer_name = f"{type(renderer).__module__}.{type(renderer).__qualname__}"
    samples = max(getattr(renderer, "supersampling", 1), 1)
    mark = {
        "generator_version": VERSION,
        "solid": name,
        "seed": seed,
        "image_size": size,
        "renderer": renderer_name,
        "supersampling": samples,
        **counts,
    }
    key = "-".join(str(count) for count in counts.values())
    folder = f"v{VERSION}-{name}-{size}-{key}-seed{seed}-{renderer_name}-{samples}"

    def write(root: Path) -> None:
        for number, split in track_progress(
            list(enumerate(Splits._fields)), f"drawing the {name}", 3, "splits"
        ):
            turns = random_rotations(counts[split], stream(seed, name, number, 0))
            with torch.no_grad():
                images = draw_images(name, turns, size, renderer)
            np.save(root / f"{split}_images.npy", images.numpy())
            np.save(root / f"{split}_rotations.npy", turns.numpy())

    return ensure_generated(parent / folder, mark, write)
