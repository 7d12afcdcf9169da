"""Millimetres by which registered people posed and shaped anew are off the same people dressed and registered in that
pose and shape; written beside this file: `python -m benchmarks.pose.reposing`, a few minutes."""

import sys
import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from numpy.random import Generator
from torch import Tensor

from benchmarks.pages import machine, write_page
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
"""The first three directions, as in Figure 7.5, and standard deviations."""
TOPOLOGIES: tuple[Name, ...] = ("7k", "27k")


class Truth:
    """People of random shape whose clothes stay the same, whatever they do: drawn from the same numbers again."""

    def __init__(self) -> None:
        self.body, self.traits = load_body(None)
        self.few = reduce_shapes(self.body, self.traits)
        # beside all of the body's coefficients the few, in which shapes are changed
        both = {
            name: np.concatenate([getattr(self.body, name), getattr(self.few, name)], 2)
            for name in ("shapes", "joint_shapes")
        }
        self.own = replace(self.body, **both)
        self.model = BodyModel(self.own)
        self.wardrobe = Wardrobe(self.body)
        self.where = poses.skeleton(self.body)

    def shape(self, random: Generator) -> Tensor:
        assert self.traits is not None
        found = self.traits.coefficients(torch.from_numpy(sample_adults(self.traits.labels, 1, random)))
        return torch.cat([found, torch.zeros(1, self.few.shapes.shape[2])], 1).float()

    def pose(self, movements: np.ndarray) -> np.ndarray:
        return poses.rotations(self.body, self.where, movements)

    @torch.no_grad()
    def registered(self, person: int, shape: Tensor, pose: np.ndarray, name: Name) -> RegisteredMesh:
        posed = self.model(shape, torch.from_numpy(pose).float())[0]
        _, found = self.wardrobe.dress(posed.numpy(), None, np.random.default_rng(person))
        mesh = topology(self.body, self.wardrobe.sheet, name)
        return RegisteredMesh(
            torch.from_numpy(found.vertices[mesh.rows]).float(),
            torch.from_numpy(found.colors[mesh.rows]),
            torch.from_numpy(mesh.faces),
        )


def apart(one: Tensor, other: Tensor) -> Tensor:
    """Median and 95 % quantile of distances of vertices, millimetres, about their middles."""
    gaps = 1000 * ((one - one.mean(0)) - (other - other.mean(0))).double().norm(dim=1)
    return torch.stack([gaps.median(), gaps.quantile(0.95)])


@torch.no_grad()
def told(
    truth: Truth, given: RegisteredMesh, shape: Tensor, stood: np.ndarray, other: np.ndarray, name: Name
) -> Tensor:
    """In another pose, where nothing has to be found: with the true pose and shape."""
    surface = truth.wardrobe.sheet
    model = BodyModel(body_in_topology(truth.own, surface, topology(truth.body, surface, name))).double()
    before = shape.double(), torch.from_numpy(stood), torch.zeros(1, 3, dtype=torch.float64)
    back = unpose(model, given.vertices.double()[None], *before)
    return model(shape.double(), torch.from_numpy(other), None, back.offsets)[0]


@torch.no_grad()
def bare(one: Subject, pose: np.ndarray, change: Tensor | float = 0.0) -> Tensor:
    """The model without the person's offsets."""
    return one.model(one.fit.shape + change, torch.from_numpy(pose))[0]


@torch.no_grad()
def measured(truth: Truth, name: Name) -> dict[str, Tensor]:
    """Mean over people, poses and shapes of each number."""
    found: dict[str, list[Tensor]] = {}

    def note(what: str, *numbers: Tensor | float) -> None:
        found.setdefault(what, []).append(
            torch.stack([torch.as_tensor(number) for number in numbers]).double()
        )

    for person in range(PEOPLE):
        random = np.random.default_rng([1, person])
        shape, stood = truth.shape(random), truth.pose(a_pose(random))
        others = truth.pose(poses.draw(POSES, random))
        given = truth.registered(person, shape, stood, name)
        start = time.process_time()
        one = subject(truth.body, truth.few, given, f"person {person}")
        note("seconds", time.process_time() - start)
        note("fit", 1000 * one.fit.error)
        joints = truth.model.posed_joints(shape, torch.from_numpy(stood).float())[0]
        ours = one.model.posed_joints(one.fit.shape, one.fit.pose)[0] + one.fit.translation
        note("joints", 1000 * (ours - joints).norm(dim=1).mean())
        back = one.model(*one.fit[:3], one.offsets)[0]
        note("back", (back - given.vertices.double()).abs().max())
        note("folded", float(one.folded))
        for number, other in enumerate(others):
            there = truth.registered(person, shape, other[None], name)
            note("posed", *apart(one.posed(other).vertices, there.vertices))
            if number == 0:
                note(
                    "posed told", *apart(told(truth, given, shape, stood, other[None], name), there.vertices)
                )
            note("posed bare", *apart(bare(one, other[None]), there.vertices))
            again = subject(truth.body, truth.few, there, f"person {person}")
            note("from any pose", *apart(again.posed(stood[0]).vertices, given.vertices))
            note("folded", float(again.folded))
        for direction, deviations in SHAPES:
            change = torch.zeros(truth.few.shapes.shape[2], dtype=torch.float64)
            change[direction] = deviations
            changed = shape.clone()
            changed[0, -len(change) :] += change
            there = truth.registered(person, changed, stood, name)
            note("shaped", *apart(one.posed(stood[0], change).vertices, there.vertices))
            note("shaped bare", *apart(bare(one, stood, change), there.vertices))
            note("shape unchanged", *apart(one.posed(stood[0]).vertices, there.vertices))
    return {
        what: torch.stack(some).max(0).values if what in ("back", "folded") else torch.stack(some).mean(0)
        for what, some in found.items()
    }


def report(tables: Mapping[Name, dict[str, Tensor]]) -> str:
    def row(what: str, *keys: str, form: str = "{:.1f}") -> str:
        cells = [
            " / ".join(form.format(float(number)) for key in keys for number in table[key])
            for table in tables.values()
        ]
        return f"| {what} | {' | '.join(cells)} |"

    lines = [
        f"| | {' | '.join(tables)} |",
        "|---" * (len(tables) + 1) + "|",
        row("vertices from the body found, root mean square, mm", "fit"),
        row("joints found from the true ones, mm", "joints"),
        row("posed as registered, the largest difference, m", "back", form="{:.0e}"),
        row("vertices folded too far to be unposed, at most", "folded", form="{:.0f}"),
        row("**another pose**, mm", "posed"),
        row("without the person's offsets", "posed bare"),
        row("with the true pose and shape (first pose of each)", "posed told"),
        row("from any pose to an A-pose", "from any pose"),
        row("**another shape**, mm", "shaped"),
        row("without the person's offsets", "shaped bare"),
        row("with the shape left as it was", "shape unchanged"),
        row("seconds a person, processor time", "seconds"),
    ]
    return "\n".join(lines)


def main() -> None:
    truth = Truth()
    tables: dict[Name, dict[str, Tensor]] = {name: measured(truth, name) for name in TOPOLOGIES}
    text = f"""# Registered people in new poses and shapes

{PEOPLE} synthetic people of random shape in an A-pose, registered as `human_scans` has them; pose and shape are found
from the vertices alone. Each is then posed in {POSES} random poses, and shaped by two standard deviations along the
first three directions, both ways (thesis Figures 7.4, 7.5). The reference is the same person dressed and registered in
that pose or shape. Two numbers are the median and the 95 % quantile of distances of vertices.

{report(tables)}

{machine("torch", "numpy")} Command: `python -m benchmarks.pose.reposing`.
"""
    write_page(__file__, text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
