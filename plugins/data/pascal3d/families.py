"""The twelve object families by their PASCAL3D+ class names, with the symmetry of their objects."""

from collections.abc import Callable
from typing import NamedTuple

from numpy.random import Generator

from plugins.data.pascal3d import craft, cycles, furniture, vehicles
from plugins.data.pascal3d.shapes import Body


class Family(NamedTuple):
    """Builder of random objects of a class, and the symmetry of these objects about the vertical axis.

    `symmetry` is n if the objects look the same after a rotation by 360°/n; 1 means no symmetry. `symmetry` is 0 if the
    objects look the same after any rotation.
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
