"""Run times of other renderers for the scenes of `rasterizer.py`, if they are installed.

None of them is a dependency of the project. They are installed with `pip install moderngl trimesh embreex mitsuba`;
moderngl also needs Mesa's EGL (Debian: libegl1, libgl1-mesa-dri).
"""

import os
import time
from collections.abc import Callable

import numpy as np

from benchmarks.timing import milliseconds
from framework.renderer import Scene

ELSEWHERE = {
    "moderngl 5.13, EGL llvmpipe (culled)": "1.77 / 4.98",
    "vtk 9.7, EGL llvmpipe": "3.6 / 9.4",
    "trimesh + embreex 4.4, rays alone": "10.1 / 10.4",
    "open3d 0.20 RaycastingScene": "6.9 / 7.6",
    "pyrender 0.1.45, EGL llvmpipe": "8.4 / 18.5",
    "mitsuba 3.9, llvm_ad_rgb, 1 sample": "5.1 / 6.6; with prb gradients 72 / 84",
    "pytorch3d 0.7.9": "8,770 / not run; with gradients 9,790",
}
"""Milliseconds at 6,890 / 27,554 vertices, measured on another machine."""

Draw = Callable[[], np.ndarray]


def moderngl_egl(scene: Scene) -> tuple[str, Draw]:
    """Return the name and the call of moderngl.

    The call sends the vertices, draws an 8-bit image with culling and perspective-correct colours, and reads it back.
    """
    os.environ.setdefault("LP_NUM_THREADS", "0")
    import moderngl  # pyright: ignore[reportMissingImports]

    context = moderngl.create_context(standalone=True, backend="egl")
    camera, height, width = scene.camera, scene.camera.height, scene.camera.width
    (fx, fy), (cx, cy), near, far = camera.focal, camera.principal, 0.1, 100.0
    # pixel centres are at whole numbers, and y points upwards: the first row is at the bottom
    projection = np.array(
        [
            [2 * fx / width, 0, (2 * cx + 1) / width - 1, 0],
            [0, -2 * fy / height, 1 - (2 * cy + 1) / height, 0],
            [0, 0, (far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, 1, 0],
        ]
    )
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = camera.rotation.numpy(), camera.translation.numpy()
    program = context.program(
        vertex_shader="""#version 330
            uniform mat4 view; in vec3 place; in vec3 color; out vec3 light;
            void main() { gl_Position = view * vec4(place, 1); light = color; }""",
        fragment_shader="""#version 330
            in vec3 light; out vec4 shown; void main() { shown = vec4(light, 1); }""",
    )
    program["view"].write((projection @ world).T.astype("f4").tobytes())
    assert scene.colors is not None
    places, colors = scene.vertices.numpy().astype("f4"), scene.colors.numpy().astype("f4")
    buffer = context.buffer(places.tobytes())
    mesh = context.vertex_array(
        program,
        [(buffer, "3f", "place"), (context.buffer(colors.tobytes()), "3f", "color")],
        context.buffer(scene.faces.numpy().astype("i4").tobytes()),
    )
    target = context.framebuffer(
        [context.renderbuffer((width, height), 3)], context.depth_renderbuffer((width, height))
    )
    context.enable(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
    target.use()

    def draw() -> np.ndarray:
        buffer.write(places)
        target.clear()
        mesh.render()
        return np.frombuffer(target.read(components=3), np.uint8).reshape(height, width, 3)[::-1]

    return f"moderngl {moderngl.__version__}, EGL {context.info['GL_RENDERER'].split(' (')[0]} (culled)", draw


def embree(scene: Scene) -> tuple[str, Draw]:
    """Return the name and the call of Embree, which finds the first face on the ray of each pixel.

    The tree over the faces is built before the call.
    """
    import embreex  # pyright: ignore[reportMissingImports]
    import trimesh
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    camera = scene.camera
    mesh = trimesh.Trimesh(scene.vertices.numpy(), scene.faces.numpy(), process=False)
    rays = RayMeshIntersector(mesh)
    row, column = np.mgrid[: camera.height, : camera.width].astype(float)
    way = np.stack(
        [
            (column - camera.principal[0]) / camera.focal[0],
            (row - camera.principal[1]) / camera.focal[1],
            np.ones_like(row),
        ],
        -1,
    )
    rotation = camera.rotation.double().numpy()
    ways = way.reshape(-1, 3) @ rotation
    eye = np.broadcast_to(-rotation.T @ camera.translation.double().numpy(), ways.shape)
    return f"trimesh + embreex {embreex.__version__}, faces alone", lambda: rays.intersects_first(eye, ways)


def mitsuba_llvm(scene: Scene) -> tuple[str, Draw]:
    """Return the name and the call of Mitsuba, which draws colours without lighting, with one sample a pixel."""
    import mitsuba  # pyright: ignore[reportMissingImports]

    mitsuba.set_variant("llvm_ad_rgb")
    camera, height, width = scene.camera, scene.camera.height, scene.camera.width
    mesh = mitsuba.Mesh("body", len(scene.vertices), len(scene.faces), has_vertex_texcoords=False)
    mesh.add_attribute("vertex_color", 3, scene.colors.numpy().ravel())  # type: ignore[union-attr]
    parameters = mitsuba.traverse(mesh)
    parameters["vertex_positions"] = scene.vertices.numpy().ravel()
    parameters["faces"] = scene.faces.numpy().ravel().astype(np.uint32)
    parameters.update()
    rotation, translation = camera.rotation.double().numpy(), camera.translation.double().numpy()
    eye, ahead, up = -rotation.T @ translation, rotation[2], -rotation[1]
    look = mitsuba.ScalarTransform4f().look_at(origin=eye, target=eye + ahead, up=up)
    shown = mitsuba.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "aov", "aovs": "light:albedo"},
            "sensor": {
                "type": "perspective",
                "fov_axis": "y",
                "fov": float(np.degrees(2 * np.arctan(height / 2 / camera.focal[1]))),
                "to_world": look,
                "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
                "sampler": {"type": "independent", "sample_count": 1},
            },
            "body": mesh,
        }
    )
    return f"mitsuba {mitsuba.__version__}, llvm_ad_rgb, albedo", lambda: np.array(
        mitsuba.render(shown, spp=1)
    )


PEERS = (moderngl_egl, embree, mitsuba_llvm)


def rows(scenes: list[Scene]) -> list[str]:
    """Return a table row for each renderer, with its times or the reason why it did not run."""
    lines = []
    for peer in PEERS:
        cells, name = [], peer.__name__
        try:
            for scene in scenes:
                name, draw = peer(scene)
                cells.append(f"{milliseconds(draw, 100, time.process_time):.2f}")
        except Exception as error:  # the renderer is not installed, or it does not run on this machine
            cells = [f"not available ({type(error).__name__})"]
        lines.append(f"| {name} | {' / '.join(cells)} |")
    return lines
