"""The twelve object families by their PASCAL3D+ class names, with the symmetry of their objects."""

from collections.abc import Callable
from typing import NamedTuple

from numpy.random import Generator

from plugins.data.pascal3d import craft, cycles, furniture, vehicles
from plugins.data.pascal3d.shapes import Body


class Family(NamedTuple):
    """Builder of an object of a class, and the symmetry of the object.

    `symmetry` about the vertical axis is 1 for none, 2 for invariance under 180°, 4 under 90°, 0 under any rotation.
    """

    build: Callable[[Generator], Body]
    symmetry: int


FAMILIES: dict[str, Family] = {
    "aeroplane": Family(craft.aeroplane, 1),
    "bicycle": Family(cycles.bicycle, 1),
    "boat": Family(craft.boat, 1),
    "bottle": Family(furniture.bottle, 0),
    "bus": Family(vehicles.bus, 1),
    "car": Family(vehicles.car, 1),
    "chair": Family(furniture.chair, 1),
    "diningtable": Family(furniture.diningtable, 2),
    "motorbike": Family(cycles.motorbike, 1),
    "sofa": Family(furniture.sofa, 1),
    "train": Family(vehicles.train, 1),
    "tvmonitor": Family(furniture.tvmonitor, 1),
}
