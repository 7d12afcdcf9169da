"""Registered mesh and its scan as one PLY file, and as a figure."""

from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from scipy.spatial import KDTree

from framework.figures.style import titled_figure

SKIN, SCAN = (0.86, 0.68, 0.58), (0.16, 0.36, 0.75)
"""Colours of the mesh and of the scan's points (thesis Figure 6.6)."""
AMBIENT = 0.3
"""Share of ambient light; the rest comes from the viewer."""
DISTANCES = "viridis"
"""Colour map of the distance of points from the mesh."""
NEAR = 3
"""Number of nearest vertices whose faces are searched for the nearest point of the mesh."""


def write_ply(
    file: Path,
    vertices: Float[np.ndarray, "vertex 3"],
    faces: Int[np.ndarray, "face 3"],
    cloud: Float[np.ndarray, "points 3"],
) -> None:
    """Write the mesh in skin colour and the points of the cloud in blue to one binary PLY file, metres.

    The points are vertices that belong to no face.
    """
    colours = np.repeat([_bytes(SKIN), _bytes(SCAN)], (len(vertices), len(cloud)), 0)
    points = np.concatenate([vertices, cloud])
    trimesh.Trimesh(points, faces, vertex_colors=colours, process=False).export(file, "ply")


def distances(
    vertices: Float[np.ndarray, "vertex 3"],
    faces: Int[np.ndarray, "face 3"],
    cloud: Float[np.ndarray, "points 3"],
) -> Float[np.ndarray, "points"]:
    """Return the distance of each point of the cloud to the mesh, metres.

    Only the faces at the NEAR vertices nearest to a point are searched.
    """
    around = trimesh.Trimesh(vertices, faces, process=False).vertex_faces  # padded with -1
    used = np.flatnonzero((around >= 0).any(1))
    _, nearest = KDTree(vertices[used]).query(cloud, k=min(NEAR, len(used)))
    candidates = around[used[nearest]].reshape(len(cloud), -1)
    point, column = np.nonzero(candidates >= 0)
    triangles = vertices[faces[candidates[point, column]]]
    closest = trimesh.triangles.closest_point(triangles, cloud[point])
    shortest = np.full(len(cloud), np.inf)
    np.minimum.at(shortest, point, np.linalg.norm(closest - cloud[point], axis=1))
    return shortest


def figure(
    vertices: Float[np.ndarray, "vertex 3"],
    faces: Int[np.ndarray, "face 3"],
    cloud: Float[np.ndarray, "points 3"],
    title: str,
) -> Figure:
    """Return a figure of scan and mesh, seen from the front and from the left, with axes in metres.

    The columns show the scan, the mesh, both, and the scan coloured by its distance from the mesh, millimetres. The
    title is followed by the mean and the 95 % quantile of the distances.
    """
    millimetres = 1e3 * distances(vertices, faces, cloud)
    far = np.quantile(millimetres, 0.95)
    summary = f"its points lie {millimetres.mean():.1f} mm off on average, 95 % within {far:.1f} mm"
    scale = Normalize(0, max(far, 1e-3))
    colours = colormaps[DISTANCES](scale(millimetres))[:, :3]
    middle, reach = _frame(vertices, cloud)
    figure_drawn = titled_figure((11.5, 6.2), f"{title}; {summary}", False)
    grid = figure_drawn.subplots(2, 4, sharey=True)
    heads = ("scan", "registered mesh", "both", "distance from the mesh")
    for axes, head in zip(grid[0], heads, strict=True):
        axes.set_title(head, fontsize=10)
    side, height, depth = (middle[axis] + reach * np.array([-0.5, 0.5]) for axis in range(3))
    # in the view from the left, the front is at the left
    across = (("front: x (m)", side), ("left side: z (m)", depth[::-1]))
    for row, (label, ends), images in zip(
        grid, across, render_panels(vertices, faces, cloud, colours), strict=True
    ):
        for axes, image in zip(row, images, strict=True):
            axes.imshow(image, extent=(*ends, *height))
            axes.set_xlabel(label)
        row[0].set_ylabel("y (m)")
    bar = figure_drawn.colorbar(ScalarMappable(scale, DISTANCES), ax=grid[:, 3], extend="max", shrink=0.7)
    bar.set_label("distance of a scan's point from the mesh (mm)")
    return figure_drawn


def render_panels(
    vertices: Float[np.ndarray, "vertex 3"],
    faces: Int[np.ndarray, "face 3"],
    cloud: Float[np.ndarray, "points 3"],
    colours: Float[np.ndarray, "points 3"],
    height: int = 280,
) -> UInt8[np.ndarray, "2 4 height width 3"]:
    """Return orthographic views on white, y up, from the front and from the left.

    The columns show the cloud alone, the mesh, both, and the cloud in the colours `colours`. The first index of the
    result is the view, the second the column.
    """
    middle, reach = _frame(vertices, cloud)
    views = []
    for right, towards in ((0, 2), (2, 0)):
        flip = 1 if right == 0 else -1  # in the view from the left, the front is to the viewer's left
        frame = np.zeros((3, 3))
        frame[0, right], frame[1, 1], frame[2, towards] = flip, 1, 1
        mesh_points = (vertices - middle) @ frame.T / reach
        points = (cloud - middle) @ frame.T / reach
        blue = np.broadcast_to(SCAN, points.shape)
        parts = (
            (None, points, blue),
            (mesh_points, None, blue),
            (mesh_points, points, blue),
            (None, points, colours),
        )
        views.append([_render(*part, faces, height) for part in parts])
    return np.array(views)


def _frame(vertices: np.ndarray, cloud: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the middle and the edge length of the cube around mesh and cloud that the images show."""
    everything = np.concatenate([vertices, cloud])
    low, high = everything.min(0), everything.max(0)
    return (low + high) / 2, 1.06 * max(float((high - low).max()), 1e-9)


def _render(
    vertices: np.ndarray | None, points: np.ndarray | None, colours: np.ndarray, faces: np.ndarray, side: int
) -> UInt8[np.ndarray, "side side 3"]:
    """Return an image of mesh and points: x right, y up, z to the viewer, all coordinates within ±0.5.

    Nearer surfaces hide others; points on a surface are drawn in front of it.
    """
    image = np.ones((side, side, 3))
    depth = np.full((side, side), -np.inf)
    if vertices is not None:
        _draw_mesh(vertices, faces, image, depth)
    if points is not None:
        place = _pixels(points[:, :2], side)
        order = np.argsort(points[:, 2], kind="stable")  # the nearest last
        row, column, near = *place[order].T, points[order, 2]
        visible = near >= depth[row, column] - 0.01  # a scan's noise moves points a little under the surface
        image[row[visible], column[visible]] = colours[order[visible]]
    return _bytes(image)


def _draw_mesh(vertices: np.ndarray, faces: np.ndarray, image: np.ndarray, depth: np.ndarray) -> None:
    """Draw dense points on every face that looks at the viewer, with a depth test.

    Faces that look more directly at the viewer are brighter.
    """
    side = len(image)
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    facing_viewer = (length > 0) & (normal[:, 2] > 0)
    corners, facing = corners[facing_viewer], normal[facing_viewer, 2] / length[facing_viewer]
    size = np.abs(corners - np.roll(corners, 1, 1))[..., :2].max((1, 2)) * side
    for steps in np.unique(np.ceil(size).astype(int) + 1):
        some = np.ceil(size).astype(int) + 1 == steps
        i, j = (index.ravel() for index in np.meshgrid(*[np.arange(steps + 1)] * 2))
        weights = np.stack([i, j, steps - i - j], 1)[i + j <= steps] / steps
        dots = np.einsum("wc,fcx->fwx", weights, corners[some])
        shade = AMBIENT + (1 - AMBIENT) * np.repeat(facing[some], len(weights))
        dots = dots.reshape(-1, 3)
        order = np.argsort(dots[:, 2], kind="stable")
        row, column = _pixels(dots[order, :2], side).T
        near = dots[order, 2] > depth[row, column]
        row, column, order = row[near], column[near], order[near]
        depth[row, column] = dots[order, 2]
        image[row, column] = shade[order, None] * np.array(SKIN)


def _pixels(points: np.ndarray, side: int) -> Int[np.ndarray, "points 2"]:
    """Return row and column of points (x right, y up, within ±0.5) in an image of `side` × `side` pixels."""
    column = np.floor((points[:, 0] + 0.5) * side)
    row = np.floor((0.5 - points[:, 1]) * side)
    return np.stack([row, column], 1).clip(0, side - 1).astype(np.int64)


def _bytes(color: object) -> UInt8[np.ndarray, "*shape"]:
    return (255 * np.asarray(color)).round().astype(np.uint8)
