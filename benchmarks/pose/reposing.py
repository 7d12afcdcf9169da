"""Measure how exactly registered people can be put into new poses and shapes.

    python -m benchmarks.pose.reposing

The reference is the same dressed person, registered in the new pose or shape. The script writes reposing.md beside this
file and takes a few minutes.
"""

import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from numpy.random import Generator
from torch import Tensor

from benchmarks.pages import machine, publish
from framework.bodies import poses
from framework.bodies.body import BodyModel
from framework.bodies.people import load_body, sample_adults
from framework.bodies.shape_space import reduce_shapes
from framework.bodies.topologies import Name, body_in_topology, topology
from framework.bodies.unposing import unpose
from framework.datasets.scan_layout import RegisteredMesh
from plugins.data.human_scans.dressed import Wardrobe
from plugins.data.human_scans.repose import Subject, subject
from plugins.data.human_scans.scan_generator import a_pose

PEOPLE, POSES = 4, 2
SHAPES = ((0, -2.0), (0, 2.0), (1, -2.0), (1, 2.0), (2, -2.0), (2, 2.0))
"""Changes of the shape: index of the direction, as in Figure 7.5, and number of standard deviations."""
TOPOLOGIES: tuple[Name, ...] = ("7k", "27k")


class Truth:
    """Generator of the true people: each person keeps the same clothes in all poses and shapes.

    Attributes:
        body: Body model.
        traits: Distribution of shapes over people.
        few: Body model with a few directions of shape, in which shapes are changed.
        own: Body model with all shape coefficients, followed by the few.
        model: `own` as a module.
        wardrobe: Clothes.
        skeleton: Skeleton of the body, for random poses.
    """

    def __init__(self) -> None:
        self.body, self.traits = load_body(None)
        self.few = reduce_shapes(self.body, self.traits)
        both = {
            name: np.concatenate([getattr(self.body, name), getattr(self.few, name)], 2)
            for name in ("shapes", "joint_shapes")
        }
        self.own = replace(self.body, **both)
        self.model = BodyModel(self.own)
        self.wardrobe = Wardrobe(self.body)
        self.skeleton = poses.skeleton(self.body)

    def shape(self, random: Generator) -> Tensor:
        """Return shape coefficients of a random adult, (1, coefficient)."""
        assert self.traits is not None
        coefficients = self.traits.coefficients(
            torch.from_numpy(sample_adults(self.traits.labels, 1, random))
        )
        return torch.cat([coefficients, torch.zeros(1, self.few.shapes.shape[2])], 1).float()

    def pose(self, movements: np.ndarray) -> np.ndarray:
        """Return the rotations of the joints from their movements."""
        return poses.rotations(self.body, self.skeleton, movements)

    @torch.no_grad()
    def register(self, person: int, shape: Tensor, pose: np.ndarray, name: Name) -> RegisteredMesh:
        """Return the registered mesh of a dressed person in a pose.

        Args:
            person: Number of the person, the random seed of the clothes.
            shape: Shape coefficients, (1, coefficient).
            pose: Rotations of the joints.
            name: Name of the topology.
        """
        posed = self.model(shape, torch.from_numpy(pose).float())[0]
        _, scan = self.wardrobe.dress(posed.numpy(), None, np.random.default_rng(person))
        mesh = topology(self.body, self.wardrobe.sheet, name)
        return RegisteredMesh(
            torch.from_numpy(scan.vertices[mesh.rows]).float(),
            torch.from_numpy(scan.colors[mesh.rows]),
            torch.from_numpy(mesh.faces),
        )


def vertex_distances(first: Tensor, second: Tensor) -> Tensor:
    """Return median and 95 % quantile of the distances of vertices, mm, after the centres have been moved together."""
    gaps = 1000 * ((first - first.mean(0)) - (second - second.mean(0))).double().norm(dim=1)
    return torch.stack([gaps.median(), gaps.quantile(0.95)])


@torch.no_grad()
def pose_with_truth(
    truth: Truth,
    registered: RegisteredMesh,
    shape: Tensor,
    rest_pose: np.ndarray,
    pose: np.ndarray,
    name: Name,
) -> Tensor:
    """Return the vertices of a registered person in a new pose, computed with the true old pose and the true shape."""
    surface = truth.wardrobe.sheet
    model = BodyModel(body_in_topology(truth.own, surface, topology(truth.body, surface, name))).double()
    before = shape.double(), torch.from_numpy(rest_pose), torch.zeros(1, 3, dtype=torch.float64)
    unposed = unpose(model, registered.vertices.double()[None], *before)
    return model(shape.double(), torch.from_numpy(pose), None, unposed.offsets)[0]


@torch.no_grad()
def pose_without_offsets(person: Subject, pose: np.ndarray, change: Tensor | float = 0.0) -> Tensor:
    """Return the vertices of the fitted body model in a pose, without the person's offsets."""
    return person.model(person.fit.shape + change, torch.from_numpy(pose))[0]


@torch.no_grad()
def measure(truth: Truth, name: Name) -> dict[str, Tensor]:
    """Return each quantity of the table for a topology, over people, poses and shapes.

    "back" and "folded" are the largest of all; the others are means.
    """
    values: dict[str, list[Tensor]] = {}

    def note(quantity: str, *numbers: Tensor | float) -> None:
        values.setdefault(quantity, []).append(
            torch.stack([torch.as_tensor(number) for number in numbers]).double()
        )

    for person in range(PEOPLE):
        random = np.random.default_rng([1, person])
        shape, first_pose = truth.shape(random), truth.pose(a_pose(random))
        random_poses = truth.pose(poses.draw(POSES, random))
        registered = truth.register(person, shape, first_pose, name)
        start = time.process_time()
        fitted = subject(truth.body, truth.few, registered, f"person {person}")
        note("seconds", time.process_time() - start)
        note("fit", 1000 * fitted.fit.error)
        joints = truth.model.posed_joints(shape, torch.from_numpy(first_pose).float())[0]
        fitted_joints = (
            fitted.model.posed_joints(fitted.fit.shape, fitted.fit.pose)[0] + fitted.fit.translation
        )
        note("joints", 1000 * (fitted_joints - joints).norm(dim=1).mean())
        reproduced = fitted.model(*fitted.fit[:3], fitted.offsets)[0]
        note("back", (reproduced - registered.vertices.double()).abs().max())
        note("folded", float(fitted.folded))
        for number, pose in enumerate(random_poses):
            reference = truth.register(person, shape, pose[None], name)
            note("posed", *vertex_distances(fitted.posed(pose).vertices, reference.vertices))
            if number == 0:
                note(
                    "posed with truth",
                    *vertex_distances(
                        pose_with_truth(truth, registered, shape, first_pose, pose[None], name),
                        reference.vertices,
                    ),
                )
            note(
                "posed bare", *vertex_distances(pose_without_offsets(fitted, pose[None]), reference.vertices)
            )
            from_random_pose = subject(truth.body, truth.few, reference, f"person {person}")
            note(
                "from any pose",
                *vertex_distances(from_random_pose.posed(first_pose[0]).vertices, registered.vertices),
            )
            note("folded", float(from_random_pose.folded))
        for direction, deviations in SHAPES:
            change = torch.zeros(truth.few.shapes.shape[2], dtype=torch.float64)
            change[direction] = deviations
            changed = shape.clone()
            changed[0, -len(change) :] += change
            reference = truth.register(person, changed, first_pose, name)
            note(
                "shaped", *vertex_distances(fitted.posed(first_pose[0], change).vertices, reference.vertices)
            )
            note(
                "shaped bare",
                *vertex_distances(pose_without_offsets(fitted, first_pose, change), reference.vertices),
            )
            note(
                "shape unchanged", *vertex_distances(fitted.posed(first_pose[0]).vertices, reference.vertices)
            )
    return {
        quantity: torch.stack(numbers_of_all).max(0).values
        if quantity in ("back", "folded")
        else torch.stack(numbers_of_all).mean(0)
        for quantity, numbers_of_all in values.items()
    }


def report(tables: Mapping[Name, dict[str, Tensor]]) -> str:
    """Return the table in Markdown."""

    def row(label: str, *keys: str, form: str = "{:.1f}") -> str:
        cells = [
            " / ".join(form.format(float(number)) for key in keys for number in table[key])
            for table in tables.values()
        ]
        return f"| {label} | {' | '.join(cells)} |"

    lines = [
        f"| quantity | {' | '.join(f'{name} vertices' for name in tables)} |",
        "|---" * (len(tables) + 1) + "|",
        row("root mean square distance of the vertices from the fitted body model, mm", "fit"),
        row("mean distance of the fitted joints from the true ones, mm", "joints"),
        row(
            "largest change of a vertex if the person is put into the registered pose again, m",
            "back",
            form="{:.0e}",
        ),
        row("largest number of vertices whose rest position cannot be computed", "folded", form="{:.0f}"),
        row("**new pose**, mm", "posed"),
        row("new pose, without the person's offsets from the body model, mm", "posed bare"),
        row("new pose, with the true pose and shape (first pose of each person), mm", "posed with truth"),
        row("from a random pose to the A-pose, mm", "from any pose"),
        row("**new shape**, mm", "shaped"),
        row("new shape, without the person's offsets from the body model, mm", "shaped bare"),
        row("new shape, if the shape is left unchanged, mm", "shape unchanged"),
        row("processor time a person, s", "seconds"),
    ]
    return "\n".join(lines)


def main() -> None:
    truth = Truth()
    tables: dict[Name, dict[str, Tensor]] = {name: measure(truth, name) for name in TOPOLOGIES}
    text = f"""# Registered people in new poses and shapes

This page shows how exactly registered people can be posed and shaped anew. A registered person is a mesh of known
topology that was fitted to a scan. The benchmark changes the pose or the shape of such a mesh and compares the result
with the true mesh in that pose or shape.

The benchmark uses {PEOPLE} synthetic people of random shape, registered in an A-pose as `human_scans` does it. Their
pose and shape are found from the vertices alone. Each person is then put into {POSES} random poses. Each person is
also reshaped by plus and minus two standard deviations along each of the first three directions of the shape space
(thesis Figures 7.4 and 7.5). The reference is the same dressed person, registered in the new pose or shape.

The columns of the table stand for two topologies of the mesh, with about 7,000 and about 27,000 vertices. If a cell
holds two numbers, these are the median and the 95 % quantile of the distances between corresponding vertices, in mm.
Rows in bold hold the method of this project. The rows below a bold row leave out one part of the method, replace one
part by the truth, or change the pose in the opposite direction.

{report(tables)}

{machine("torch", "numpy")} Command: `python -m benchmarks.pose.reposing`.
"""
    publish(__file__, text)


if __name__ == "__main__":
    main()
