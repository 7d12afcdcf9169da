"""`python -m plugins.data.human_scans.repose <registration> ... --out <folder>` changes the pose and shape of people.

A registration is a mesh with vertex colours in one of the body's topologies, or a subject's folder of `human_scans`.
The command finds the pose and the shape of a registration, and takes the mesh back to the rest pose. It then writes the
mesh in each requested pose and shape, with cameras, so that a trained renderer can draw it (thesis Figures 7.4 and
7.5):

    python -m framework mode=predict checkpoint=<run> mode.files=<folder>

The written meshes are in metres, with y up, and face z. The root of each is above the origin, and its lowest vertex is
at the height of the registration's lowest vertex.
"""

import argparse
import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from framework.bodies import motion, poses
from framework.bodies.body import Body, BodyModel
from framework.bodies.people import load_body
from framework.bodies.pose_of_mesh import MeshFit, fit_mesh
from framework.bodies.shape_space import reduce_shapes
from framework.bodies.topologies import body_in_topology, recognise_topology
from framework.bodies.unposing import unpose
from framework.datasets import scan_layout
from framework.datasets.scan_layout import RegisteredMesh
from framework.errors import DataError, did_you_mean
from framework.geometry.camera import Camera
from framework.storage.commands import run_command
from plugins.data.human_scans.data import in_front
from plugins.data.human_scans.scan_generator import RAISED

Poses = dict[str, Float[np.ndarray, "joint 3"]]
"""Joint rotations of each pose, by the name of the pose."""


@dataclass(frozen=True)
class Subject:
    """Model of one person: the body model with offsets in the rest pose (the thesis's template of a subject).

    Attributes:
        model: body model, float64, in the registration's topology.
        registration: registered mesh of the person.
        fit: pose, shape and translation of the registration.
        offsets: displacements of the person's vertices from those of the fitted body model in the rest pose, metres.
        folded: number of vertices whose displacement cannot be determined along some direction
            (framework.bodies.unposing); along this direction these vertices stay near those of the body model.
    """

    model: BodyModel
    registration: RegisteredMesh
    fit: MeshFit
    offsets: Float[Tensor, "1 vertex 3"]
    folded: int

    @torch.no_grad()
    def posed(
        self, pose: Float[np.ndarray, "joint 3"] | None = None, change: Float[Tensor, "shape"] | None = None
    ) -> RegisteredMesh:
        """Return the mesh of the person in a pose and with a changed shape.

        Args:
            pose: rotations of the joints; None for the pose of the registration.
            change: numbers that are added to the shape coefficients; None for no change.
        """
        shape = self.fit.shape if change is None else self.fit.shape + change
        turned = self.fit.pose if pose is None else torch.from_numpy(pose)[None]
        vertices = self.model(shape, turned, offsets=self.offsets)[0]
        vertices -= self.model.posed_joints(shape, turned)[
            0, self.model.parents.index(-1)
        ] * vertices.new_tensor([1.0, 0.0, 1.0])
        vertices[:, 1] += self.registration.vertices[:, 1].min() - vertices[:, 1].min()
        return replace(self.registration, vertices=vertices.float())


def subject(body: Body, few: Body, registration: RegisteredMesh, source: str) -> Subject:
    """Return the model of the person that a registered mesh shows.

    Args:
        body: the body model.
        few: the body model with a reduced number of shape coefficients (framework.bodies.shape_space), which is fitted.
        registration: the registered mesh.
        source: name of the mesh in messages.

    Raises:
        DataError: the mesh is of another body.
    """
    surface, mesh = recognise_topology(body, len(registration.vertices), registration.faces.numpy(), source)
    own = body_in_topology(few, surface, mesh)
    fit = fit_mesh(own, registration.vertices)
    model = BodyModel(own).double()
    back = unpose(model, registration.vertices.double()[None], *fit[:3])
    return Subject(model, registration, fit, back.offsets, int(back.folded.sum()))


def a_pose_with(changes: str) -> Float[np.ndarray, "1 movement"]:
    """Return the movements, degrees, of an A-pose with changes such as "left raise=90,left elbow=60".

    Raises:
        DataError: no movement has such a name, or an angle is not a number.
    """
    ranges = [*poses.CENTRAL.values(), *2 * (*poses.SIDED.values(),)]
    movements = dict(zip(poses.MOVEMENTS, (float(limits[0]) for limits in ranges), strict=True))
    movements |= {f"{side} raise": RAISED for side in ("left", "right")}
    for name, degrees in _numbers(changes).items():
        if name not in movements:
            raise DataError(
                f"There is no movement {name!r}.{did_you_mean(name, movements)} The movements are "
                f"{', '.join(movements)}."
            )
        movements[name] = degrees
    return np.array([list(movements.values())])


def _numbers(text: str) -> dict[str, float]:
    numbers = {}
    for part in text.split(","):
        name, _, number = part.partition("=")
        try:
            numbers[name.strip()] = float(number)
        except ValueError:
            raise DataError(
                f"Got {part!r}; expected a name and a number joined by `=`, such as `left elbow=60`."
            ) from None
        if not abs(numbers[name.strip()]) <= 1e4:
            raise DataError(f"Got {part!r}; expected a number from -10000 to 10000 after `=`.")
    return numbers


def requested_poses(body: Body, options: argparse.Namespace) -> Poses:
    """Return the poses that the command's arguments name: changed A-poses, random poses, and frames of a motion."""
    where = poses.skeleton(body)
    poses_by_name: Poses = {}
    for number, changes in enumerate(options.pose):
        rest = changes == "rest"
        turned = None if rest else poses.rotations(body, where, a_pose_with(changes))[0]
        poses_by_name[f"pose_{number}"] = np.zeros((len(body.parents), 3)) if turned is None else turned
    if options.random:
        random_movements = poses.draw(options.random, np.random.default_rng(options.seed))
        turned = poses.rotations(body, where, random_movements)
        poses_by_name |= {f"random_{number:03}": pose for number, pose in enumerate(turned)}
    if options.motion is not None:
        moving = motion.read(options.motion)
        frames = options.frames or list(range(len(moving.rotations)))
        if wrong := [frame for frame in frames if not 0 <= frame < len(moving.rotations)]:
            raise DataError(
                f"{options.motion}: the motion has no frame {wrong[0]}; expected numbers from 0 to "
                f"{len(moving.rotations) - 1}."
            )
        turned = motion.transfer_motion(body, moving, frames)
        poses_by_name |= {f"frame_{frame:05}": pose for frame, pose in zip(frames, turned, strict=True)}
    return poses_by_name


def shape_change(text: str, count: int) -> Float[Tensor, "shape"]:
    """Return the change of each of `count` shape coefficients, as a text such as "0=-2,3=1" states it.

    Coefficients that the text does not name have the change 0.

    Raises:
        DataError: the text has another form, or names a coefficient that does not exist.
    """
    coefficients = torch.zeros(count, dtype=torch.float64)
    for name, number in _numbers(text).items():
        if not name.isdecimal() or int(name) >= count:
            raise DataError(
                f"--shape {text}: {name!r} is not a direction; expected a number from 0 to {count - 1}, as in 0=-2."
            )
        coefficients[int(name)] = number
    return coefficients


def around(vertices: Float[Tensor, "vertex 3"], views: int, size: tuple[int, int]) -> dict[str, Camera]:
    """Return `views` cameras by name, "000", "001" and so on; each of them sees all vertices.

    The cameras lie at equal angles around the vertical axis; the first one is in front.
    """
    cameras = {}
    for view in range(views):
        angle = 2 * math.pi * view / views
        sine, cosine = math.sin(angle), math.cos(angle)
        turn = torch.tensor([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]])
        front_camera = in_front(vertices @ turn.T, *size)
        cameras[f"{view:03}"] = replace(front_camera, rotation=front_camera.rotation @ turn)
    return cameras


def read(file: Path, topology: str) -> tuple[str, RegisteredMesh]:
    """Return name and mesh of a registration.

    Args:
        file: file of the mesh, or a subject's folder of `human_scans`.
        topology: name of the topology whose mesh is read from a subject's folder.
    """
    if file.is_dir():
        return file.resolve().name, scan_layout.read_registration(file / f"registration_{topology}.ply")
    return file.stem, scan_layout.read_registration(file)


def main(arguments: list[str]) -> None:
    """Write `<name>_<pose>.ply` for each pose and shape, and cameras.json.

    Raises:
        UserError: a mesh cannot be read, has no colours or is of another body; or a requested pose or shape does not
            exist.
    """
    parser = argparse.ArgumentParser(
        prog="python -m plugins.data.human_scans.repose",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("registrations", nargs="+", type=Path, help="meshes, or folders of subjects")
    parser.add_argument("--out", type=Path, required=True, help="folder for the meshes and cameras")
    parser.add_argument(
        "--pose", action="append", default=[], help="'rest', or an A-pose with 'left raise=90,right knee=40'"
    )
    parser.add_argument("--random", type=int, default=0, help="number of random poses; default: 0")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random poses; default: 0")
    parser.add_argument("--motion", type=Path, help="BVH file whose poses are used")
    parser.add_argument(
        "--frames", type=int, nargs="+", help="numbers of the motion's frames, from 0; default: all"
    )
    parser.add_argument(
        "--shape",
        action="append",
        default=[],
        help="change of shape, as '0=-2': direction and number of standard deviations",
    )
    parser.add_argument("--body", help="file of the body model; default: the default body")
    parser.add_argument(
        "--topology", default="7k", help="topology that is read from the folder of a subject; default: 7k"
    )
    parser.add_argument(
        "--views", type=int, default=1, help="number of cameras around the person; default: 1"
    )
    parser.add_argument(
        "--size", type=int, nargs=2, default=(256, 192), help="height and width; default: 256 192"
    )
    options = parser.parse_args(arguments)
    body, traits = load_body(options.body)
    few = reduce_shapes(body, traits)
    changes = {f"shape_{text}": shape_change(text, few.shapes.shape[-1]) for text in options.shape}
    wanted = requested_poses(body, options)
    written: dict[str, RegisteredMesh] = {}
    for file in options.registrations:
        name, registration = read(file, options.topology)
        if f"{name}_registration" in written:
            raise DataError(
                f"{file}: the name {name} occurs twice; expected a different name for each person."
            )
        person = subject(body, few, registration, str(file))
        sys.stdout.write(
            f"{name}: {len(registration.vertices)} vertices, {1000 * person.fit.error:.1f} mm from the body in the "
            f"pose found; {person.folded} folded so far that they were not unposed\n"
        )
        written[f"{name}_registration"] = person.posed()
        written |= {f"{name}_{pose}": person.posed(turned) for pose, turned in wanted.items()}
        written |= {f"{name}_{text}": person.posed(change=change) for text, change in changes.items()}
    for name, mesh in written.items():
        scan_layout.write_registration(options.out / f"{name}.ply", mesh)
    every = torch.cat([mesh.vertices for mesh in written.values()])
    scan_layout.write_cameras(options.out / "cameras.json", around(every, options.views, tuple(options.size)))
    sys.stdout.write(f"{options.out}: {len(written)} meshes, {options.views} cameras\n")


if __name__ == "__main__":
    run_command(main)
