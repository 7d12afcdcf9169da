"""A dressed person's scan, and the smooth body registered to it.

The scan has what photographs show: cloth with thickness and wrinkles, hair, shading. The registration is the body,
moved smoothly towards the scan, with the colours of the scan's nearest points. A renderer gets the registration (thesis
§7.3.1).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy.random import Generator
from scipy.sparse import csr_matrix
from scipy.spatial import KDTree

from framework.bodies.body import Body, BodyModel
from framework.bodies.topologies import Sheet, edges, sheet
from framework.geometry.srgb import bytes_from_linear
from plugins.data.human_scans import skins
from plugins.data.human_scans.anatomy import Anatomy, anatomy
from plugins.data.human_scans.fabrics import noise
from plugins.data.human_scans.garments import Skirt, outfit
from plugins.data.human_scans.hair import Hair, Piece, hair, tie_hair
from plugins.data.human_scans.hanging import hang_skirt

FURTHEST = 0.05
"""Largest distance of a registration from the bare body, metres."""
STEPS, BLUR = 4, 3
"""Number of steps of a registration, and number of means over neighbours after each step."""
ERROR = 0.0015
"""Standard deviation of the remaining error of a registration, metres."""


@dataclass(frozen=True)
class Scan:
    """Mesh of a dressed person, which the photographs show.

    The mesh consists of the body's sheet with clothes and short hair, and of separate surfaces for a skirt and long
    hair. The sheet is the mesh of the body whose edges are split in the middle (`framework.bodies.topologies.Sheet`).

    Attributes:
        vertices: positions, metres.
        faces: triangles.
        colors: linear RGB of each vertex, including the shading by the scanner's light.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    colors: Float[np.ndarray, "vertices 3"]


@dataclass(frozen=True)
class RegisteredBody:
    """The smooth body registered to a scan, with a position and a colour for every vertex of the body's sheet.

    The mesh of a topology uses some of these vertices.

    Attributes:
        vertices: positions, metres.
        colors: 8-bit sRGB.
    """

    vertices: Float[np.ndarray, "sheet 3"]
    colors: UInt8[np.ndarray, "sheet 3"]


class Clothes(NamedTuple):
    """A person's clothes and hair, independent of the pose.

    The arrays have one entry for each vertex of the sheet, which is the body's mesh with its edges split in the middle.

    Attributes:
        colors: linear RGB of the person's surface: skin, cloth or hair.
        raised: height of cloth or hair above the skin, metres; 0 on bare skin.
        cover: share by which cloth smooths the details of the body, from 0 (bare skin) to 1.
        skirt: skirt, a surface of its own around the body; or None.
        hair: hair of the person.
    """

    colors: Float[np.ndarray, "sheet 3"]
    raised: Float[np.ndarray, "sheet"]
    cover: Float[np.ndarray, "sheet"]
    skirt: Skirt | None
    hair: Hair


class Wardrobe:
    """Functions that dress posed people of one body model, and the data that all these people share.

    Args:
        body: the body model.
        stages: number of times that the body's edges are split to obtain its sheet, the surface of the scan.
    """

    def __init__(self, body: Body, stages: int = 2) -> None:
        self.body = body
        self.model = BodyModel(body)
        self.sheet: Sheet = sheet(body, stages)
        self.anatomy: Anatomy = anatomy(body, self.sheet.interpolate)
        self.faces = self.sheet.faces
        self._spread = _spread(self.faces, len(self.anatomy.place))
        self._own_spread = _spread(body.faces, len(body.template))
        self._neighbours = _neighbours(body.faces, len(body.template))
        self.vertices = len(body.template)
        self.uv = None if body.uv is None else self.sheet.interpolate_uv(body.uv)
        places = self.sheet.corners[-1].uv_faces
        self._place_of = np.zeros(len(self.anatomy.place), np.int64)
        self._place_of[self.faces.ravel()] = places.ravel()
        self.vertex_of_place = np.zeros(places.max() + 1 if self.uv is None else len(self.uv), np.int64)
        self.vertex_of_place[places.ravel()] = self.faces.ravel()

    def dress(
        self,
        posed: Float[np.ndarray, "vertices 3"],
        skin: UInt8[np.ndarray, "height width 3"] | None,
        random: Generator,
    ) -> tuple[Scan, RegisteredBody]:
        """Return the scan of a posed body with random clothes, hair and skin, and the registration to this scan.

        `skin` is an image of a skin in the body's texture layout; if it is None, the skin is painted procedurally.
        """
        scan, visible = self.scan(posed, self.clothes(skin, random), random)
        return scan, self.register(posed, scan, visible, random)

    def clothes(self, skin: UInt8[np.ndarray, "height width 3"] | None, random: Generator) -> Clothes:
        """Return random clothes, hair and skin, which do not depend on the pose."""
        where = self.anatomy
        worn = outfit(where, random)
        grown = hair(where, random)
        if skin is None or self.uv is None:
            colors = skins.paint_skin(where, random)
        else:
            colors = skins.colors_at(skin, self.uv)[self._place_of]
            colors = skins.fill_blanks(
                colors, where, self.vertices, self._neighbours.dot, self.sheet.interpolate
            )
            colors = skins.paint_eyes(where, colors, random)
        raised = np.zeros(len(where.place))
        cover = np.zeros(len(where.place))
        for garment in worn.garments:
            colors = np.where((garment.inside > 0)[:, None], garment.colors, colors)
            raised = raised + garment.raised()
            cover = np.maximum(cover, (garment.inside / 0.03).clip(0, 1))
        colors = colors + grown.share[:, None] * (grown.colors - colors)
        return Clothes(colors, raised + grown.raised, cover, worn.skirt, grown)

    def scan(
        self, posed: Float[np.ndarray, "vertices 3"], worn: Clothes, random: Generator
    ) -> tuple[Scan, Bool[np.ndarray, "points"]]:
        """Return the scan of a dressed person in a pose, and which of its points a scanner sees.

        Args:
            posed: vertices of the bare body in the pose, metres.
            worn: clothes and hair of the person.
            random: source of the folds of a skirt, of loose hair and of the light.
        """
        where = self.anatomy
        draped = self.sheet.interpolate(self._smoothed(posed, worn.cover[: self.vertices]))
        vertices = draped + worn.raised[:, None] * self.normals(draped)
        pieces = [Piece(vertices, self.faces, worn.colors)]
        hidden = np.zeros(len(vertices), bool)
        if worn.skirt is not None:
            trunk_and_legs = np.flatnonzero(where.arms[: self.vertices] < 0.3)
            piece = hang_skirt(
                worn.skirt,
                vertices[trunk_and_legs],
                np.abs(where.place[trunk_and_legs, 1] - where.waist) < 0.03,
                random,
            )
            pieces.append(piece)
            low, high = piece.vertices[:, 1].min() + 0.01, piece.vertices[:, 1].max() - 0.01
            hidden = (where.arms < 0.3) & (vertices[:, 1] > low) & (vertices[:, 1] < high)
        locks = tie_hair(worn.hair.style, worn.hair.color, *self._head(posed), random)
        if locks is not None:
            pieces.append(locks)
        light = Light(random)
        lit = [
            light.on(piece, self.normals(piece.vertices) if piece is pieces[0] else _normals(piece))
            for piece in pieces
        ]
        starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
        scan = Scan(
            np.concatenate([piece.vertices for piece in pieces]),
            np.concatenate([piece.faces + start for piece, start in zip(pieces, starts, strict=False)]),
            np.concatenate(lit).clip(0, 1),
        )
        visible = np.concatenate([~hidden, *(np.ones(len(piece.vertices), bool) for piece in pieces[1:])])
        return scan, visible

    def normals(self, vertices: Float[np.ndarray, "sheet 3"]) -> Float[np.ndarray, "sheet 3"]:
        """Return outward unit normals of the sheet's vertices: area-weighted means over the faces at each vertex."""
        return _unit(self._spread @ _cross(vertices, self.faces))

    def register(
        self, posed: np.ndarray, scan: Scan, visible: np.ndarray, random: Generator
    ) -> RegisteredBody:
        """Return the registration of the body to a scan.

        The vertices of the body move along their normals towards the nearest points of the scan, at most FURTHEST, and
        take the colours of these points. The distances are averaged over neighbouring vertices. The registration
        therefore lacks details of the scan that are only a few edges wide (wrinkles, hems) or too far from the body (a
        wide skirt, a tail of hair).

        Args:
            posed: vertices of the bare body in the pose of the scan, metres.
            scan: the scan.
            visible: whether a scanner sees each point of the scan.
            random: source of the random error that is added to the distances.
        """
        points = scan.vertices[visible]
        tree = KDTree(points, balanced_tree=False, compact_nodes=False)
        outwards = self._outwards(posed)
        moved = np.zeros(len(posed))
        for _ in range(STEPS):
            now = posed + moved[:, None] * outwards
            moved = moved + ((points[tree.query(now)[1]] - now) * outwards).sum(1)
            for _ in range(BLUR):
                moved = self._neighbours @ moved.clip(-0.01, FURTHEST)
        off = moved + ERROR * noise(self.body.template, 0.25, random)
        vertices = self.sheet.interpolate(posed + off[:, None] * outwards)
        nearest = np.flatnonzero(visible)[tree.query(vertices)[1]]
        return RegisteredBody(vertices, bytes_from_linear(torch.from_numpy(scan.colors[nearest])).numpy())

    def repose(
        self,
        registration: Float[np.ndarray, "sheet 3"],
        stood: Float[np.ndarray, "vertices 3"],
        posed: Float[np.ndarray, "vertices 3"],
    ) -> Float[np.ndarray, "sheet 3"]:
        """Return a registration in another pose, at the same distances from the bare body along its normals.

        Args:
            registration: vertices of the registration in the first pose, metres.
            stood: vertices of the bare body in the first pose, metres.
            posed: vertices of the bare body in the other pose, metres.
        """
        off = ((registration[: self.vertices] - stood) * self._outwards(stood)).sum(1)
        return self.sheet.interpolate(posed + off[:, None] * self._outwards(posed))

    def _outwards(self, posed: np.ndarray) -> Float[np.ndarray, "vertices 3"]:
        return _unit(self._own_spread @ _cross(posed, self.body.faces))

    def _smoothed(self, posed: np.ndarray, cover: np.ndarray) -> np.ndarray:
        """Return the vertices of a posed body, each smoothed by the share `cover` of its details that cloth hides.

        Each step averages over neighbours, and then undoes the shrinking that averaging causes (Taubin 1995).
        """
        smooth = posed.astype(np.float64)
        for _ in range(12):
            for weight in (0.5, -0.53):
                smooth = smooth + weight * cover[:, None] * (self._neighbours @ smooth - smooth)
        return smooth

    def _head(self, posed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the affine transform from the template's head to the posed head, and the box of the template's head.

        The transform is (4, 3) and applies to rows (x, y, z, 1). The box is (3, 2): smallest and largest x, y, z.
        """
        head = self.anatomy.head[: self.vertices] > 0.9
        if head.sum() < 4:
            head = np.ones(self.vertices, bool)
        template = self.body.template[head].astype(np.float64)
        homogeneous = np.concatenate([template, np.ones((len(template), 1))], 1)
        transform = np.linalg.lstsq(homogeneous, posed[head].astype(np.float64), rcond=None)[0]
        return transform, np.stack([template.min(0), template.max(0)], 1)


class Light:
    """Light of a scanner: ambient light, stronger from above, and light from one side."""

    def __init__(self, random: Generator) -> None:
        turn, lift = random.uniform(0, 2 * np.pi), random.uniform(0.3, 0.9)
        self.towards = np.array([np.cos(lift) * np.sin(turn), np.sin(lift), np.cos(lift) * np.cos(turn)])
        self.key = random.uniform(0.35, 0.6)

    def on(self, piece: Piece, normals: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "vertices 3"]:
        """Return the linear RGB that the matt surface `piece` reflects under this light at each of its vertices.

        `normals` are the outward unit normals at the vertices.
        """
        around = 0.62 + 0.22 * normals[:, 1]
        side = ((normals @ self.towards + 0.3) / 1.3).clip(0, 1)
        return piece.colors * (around + self.key * side)[:, None]


def _cross(vertices: np.ndarray, faces: np.ndarray) -> Float[np.ndarray, "faces 3"]:
    x, y, z = vertices.T[:, faces.T]  # shape of each: (corner, face)
    p, q, r = (along[1:] - along[:1] for along in (x, y, z))  # from the first corner to the others
    return np.stack([q[0] * r[1] - r[0] * q[1], r[0] * p[1] - p[0] * r[1], p[0] * q[1] - q[0] * p[1]], 1)


def _normals(piece: Piece) -> Float[np.ndarray, "vertices 3"]:
    spread = _spread(piece.faces, len(piece.vertices))
    return _unit(spread @ _cross(piece.vertices, piece.faces))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def _spread(faces: np.ndarray, vertices: int) -> csr_matrix:
    """Return the matrix, (vertices, faces), that sums values of faces over the faces at each vertex."""
    columns = np.repeat(np.arange(len(faces)), 3)
    return csr_matrix((np.ones(len(columns)), (faces.ravel(), columns)), (vertices, len(faces)))


def _neighbours(faces: np.ndarray, vertices: int) -> csr_matrix:
    """Return the matrix that averages values over every vertex and its neighbours."""
    (start, end), own = edges(faces)[0].T, np.arange(vertices)
    rows = np.concatenate([start, end, own])
    share = 1 / np.bincount(rows, minlength=vertices)
    return csr_matrix((share[rows], (rows, np.concatenate([end, start, own]))), (vertices, vertices))
