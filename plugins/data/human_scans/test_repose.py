import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from framework.bodies import poses
from framework.bodies.body import BodyModel
from framework.bodies.people import load_body, sample_adults
from framework.bodies.pose_of_mesh import fit_mesh
from framework.bodies.shape_space import COUNT, reduce_shapes
from framework.bodies.topologies import COUNTS, body_in_topology, recognise_topology, sheet, topology
from framework.configuration.schema import build, resolve
from framework.datasets import scan_layout
from framework.datasets.scan_layout import RegisteredMesh
from framework.errors import DataError
from framework.geometry import meshes
from framework.testing.bodies import DOLL, colored_mesh
from plugins.data.human_scans import repose
from plugins.data.human_scans.rows import SMALL


@pytest.fixture(scope="module")
def doll():
    return load_body(DOLL["body"])[0]


@pytest.fixture(scope="module")
def default():
    return load_body(None)


@pytest.mark.parametrize("size", [0.1, 0.6, 1.5])
@pytest.mark.parametrize("number", range(3))
def test_any_pose_and_shape_is_found_from_the_vertices_alone(doll, size, number):
    random = np.random.default_rng(number)
    pose = torch.from_numpy(size * random.normal(size=(1, 22, 3)))
    pose[0, 0] = torch.from_numpy(Rotation.random(rng=random).as_rotvec())  # any global rotation
    shape, place = (torch.from_numpy(random.normal(size=(1, count))) for count in (4, 3))
    model = BodyModel(doll).double()
    mesh = model(shape, pose, place)[0]
    fit = fit_mesh(doll, mesh, usual=0.0)
    assert fit.error < 1e-6
    torch.testing.assert_close(model(*fit[:3])[0], mesh, atol=1e-6, rtol=0)
    torch.testing.assert_close(fit.shape, shape, atol=1e-5, rtol=0)
    for true_turn, found_turn in zip(pose[0].numpy(), fit.pose[0].numpy(), strict=True):
        assert (Rotation.from_rotvec(true_turn).inv() * Rotation.from_rotvec(found_turn)).magnitude() < 1e-5


def test_what_is_usual_shares_a_bend_and_counts_less_the_better_the_mesh_fits(doll):
    mesh = BodyModel(doll).double()(torch.full((1, 4), 3.0).double(), torch.zeros(1, 22, 3).double())[0]
    free, usual, strict = (
        float(fit_mesh(doll, mesh, usual=share).shape.abs().max()) for share in (0.0, 1.0, 100.0)
    )
    assert strict < usual < free and free == pytest.approx(3.0, abs=1e-5)
    for wrong in (mesh[:-1], mesh.clone().fill_(torch.nan)):
        with pytest.raises(DataError, match="expected the 132 vertices of"):
            fit_mesh(doll, wrong)


def test_few_shapes_are_the_principal_components_of_adults(default):
    body, traits = default
    few = reduce_shapes(body, traits)
    directions = few.shapes.reshape(-1, COUNT).astype(float)
    sizes = np.linalg.norm(directions, axis=0)
    assert (np.diff(sizes) < 0).all()
    np.testing.assert_allclose(directions.T @ directions, np.diag(sizes**2), atol=1e-4 * sizes[0] ** 2)
    values = traits.coefficients(
        torch.from_numpy(sample_adults(traits.labels, 100, np.random.default_rng(3)))
    ).numpy()
    displacements = np.stack(
        [(body.template + body.shapes @ person - few.template).ravel() for person in values]
    )
    coefficients = np.linalg.lstsq(directions, displacements.T, rcond=None)[0]
    assert np.sqrt(3 * np.square(displacements.T - directions @ coefficients).mean()) < 0.002
    np.testing.assert_allclose(coefficients.std(1), 1, atol=0.3)
    np.testing.assert_allclose(coefficients.mean(1), 0, atol=0.4)
    assert np.ptp((few.template + few.shapes[..., 0])[:, 1]) > np.ptp(few.template[:, 1]) + 0.02


FEWER = {"shapes": np.zeros((13_718, 3, 1), np.float32), "joint_shapes": np.zeros((28, 3, 1), np.float32)}


@pytest.mark.parametrize("name", ["7k", "14k", "27k", "110k"])
def test_vertices_of_a_topology_bend_with_the_body(doll, default, name):
    """Check that the body's own vertices bend exactly alike, and midpoints nearly as the middle of their edges."""
    for body, tolerance in ((doll, 1e-12), (replace(default[0], **FEWER), 1e-6)):
        surface = sheet(body)
        mesh = topology(body, surface, name)
        own = body_in_topology(body, *recognise_topology(body, len(mesh.rows), mesh.faces, "a mesh"))
        assert own.template.shape == (len(mesh.rows), 3) and np.array_equal(own.faces, mesh.faces)
        if body is not doll and name in COUNTS:
            assert len(own.template) == COUNTS[name]
        np.testing.assert_allclose(own.weights.sum(1), 1, atol=1e-6)
        pose = torch.from_numpy(
            poses.rotations(body, poses.skeleton(body), repose.a_pose_with("left elbow=90"))
        )
        shape = torch.zeros(1, 0)
        whole, some = (
            BodyModel(some_body).double()(shape.double(), pose)[0].numpy() for some_body in (body, own)
        )
        distances = np.linalg.norm(some - surface.interpolate(whole)[mesh.rows], axis=1)
        assert distances[mesh.rows < len(body.template)].max() < tolerance
        assert np.quantile(distances, 0.99) < 0.002 and distances.max() < 0.01


def test_meshes_of_other_bodies_are_told(doll):
    mesh = topology(doll, sheet(doll), "14k")
    with pytest.raises(DataError, match=r"the mesh has 131 vertices, but the meshes of .* have 132 vertices"):
        recognise_topology(doll, 131, mesh.faces, "one.ply")
    with pytest.raises(DataError, match=r"as many vertices as .* \(132\) but different triangles"):
        recognise_topology(doll, 132, np.flip(mesh.faces + 1, 0) % 132, "one.ply")


def test_somebody_posed_anew_is_as_in_that_pose_and_reshaped_as_of_that_shape(default):
    """Compare with the body's own skinning of clothes that are up to two centimetres outwards in the rest pose."""
    body, traits = default
    few = reduce_shapes(body, traits)
    surface = sheet(body, 0)
    mesh = topology(body, surface, "7k")
    whole, own = (BodyModel(body_in_topology(somebody, surface, mesh)).double() for somebody in (body, few))
    rest = whole.template.unflatten(0, (3, -1)).T
    outwards = trimesh.Trimesh(rest, mesh.faces, process=False).vertex_normals
    clothes = (0.01 + 0.01 * torch.sin(9 * rest[:, :1])) * torch.tensor(outwards)[None]
    random = np.random.default_rng(5)
    shape = traits.coefficients(torch.from_numpy(sample_adults(traits.labels, 1, random))).double()
    before, after = (
        torch.from_numpy(poses.rotations(body, poses.skeleton(body), moved))
        for moved in (repose.a_pose_with("yaw=170,right knee=30"), poses.draw(1, random))
    )
    still = torch.tensor([[1.0, 0.2, -3.0]]).double()
    registration = RegisteredMesh(
        whole(shape, before, still, clothes)[0].float(),
        torch.zeros(6890, 3).byte(),
        torch.from_numpy(mesh.faces),
    )
    somebody = repose.subject(body, few, registration, "somebody")
    assert somebody.folded == 0 and somebody.fit.error < 0.015
    back = own(somebody.fit.shape, somebody.fit.pose, somebody.fit.translation, somebody.offsets)[0]
    torch.testing.assert_close(back, registration.vertices.double(), atol=1e-6, rtol=0)
    taller = torch.zeros(COUNT).double()
    taller[0] = 2.0
    step = torch.from_numpy(body_in_topology(few, surface, mesh).shapes[..., 0]).double()
    joints = torch.from_numpy(few.joint_shapes[..., 0]).double()
    for estimate, truth in (
        (somebody.posed(after[0].numpy()), whole(shape, after, None, clothes)[0]),
        (somebody.posed(before[0].numpy(), taller), None),
    ):
        if truth is None:  # joints and vertices of the truth are moved by the same two standard deviations
            whole.joints += 2 * joints
            truth = whole(shape, before, None, clothes + 2 * step)[0]
        ours = estimate.vertices.double()
        gaps = ((ours - ours.mean(0)) - (truth - truth.mean(0))).norm(dim=1)
        assert gaps.median() < 0.006 and gaps.quantile(0.95) < 0.012
        assert ours[:, 1].min() == pytest.approx(float(registration.vertices[:, 1].min()), abs=1e-6)


def registered(folder, doll, number=0):
    random = np.random.default_rng(number)
    pose = poses.rotations(doll, poses.skeleton(doll), repose.a_pose_with("yaw=20"))
    mesh = (
        BodyModel(doll).double()(torch.from_numpy(random.normal(size=(1, 4))), torch.from_numpy(pose))[0]
        + 5.0
    )
    colors = torch.from_numpy(random.integers(0, 256, (len(mesh), 3), np.uint8))
    registration = RegisteredMesh(mesh.float(), colors, torch.from_numpy(doll.faces))
    scan_layout.write_registration(folder / "registration_mine.ply", registration)
    return registration


def test_what_is_written_is_read_by_the_data_set_and_seen_whole(doll, tmp_path, capsys):
    registration = registered(tmp_path / "ann", doll)
    out = tmp_path / "out"
    wanted = ["--pose", "rest", "--pose", "left raise=90,right knee=40", "--random", "2"]
    wanted += ["--shape", "0=-2", "--shape", "1=1,3=2"]
    arguments = ["--body", DOLL["body"], "--topology", "mine", "--views", "3", "--size", "40", "30"]
    repose.main([str(tmp_path / "ann"), "--out", str(out), *wanted, *arguments])
    output = capsys.readouterr().out
    assert "ann: 132 vertices" in output and "0 folded" in output and "7 meshes, 3 cameras" in output
    files = {file.stem: file for file in sorted(out.glob("*.ply"))}
    assert list(files) == sorted(
        f"ann_{name}"
        for name in (
            "registration",
            "pose_0",
            "pose_1",
            "random_000",
            "random_001",
            "shape_0=-2",
            "shape_1=1,3=2",
        )
    )
    same = meshes.read(files["ann_registration"])
    differences = registration.vertices.numpy() - same.vertices
    np.testing.assert_allclose(differences, np.broadcast_to(differences[0], differences.shape), atol=1e-5)
    assert abs(differences[0, 1]) < 1e-5
    rest = meshes.read(files["ann_pose_0"]).vertices
    joints = rest.reshape(22, 6, 3).mean(1)
    assert np.abs(joints[[0]] * [1, 0, 1]).max() < 1e-4  # the root is over the origin
    assert joints[18, 1] == pytest.approx(
        joints[16, 1], abs=0.01
    )  # in the rest pose the doll's arms are level
    data = build("data", resolve("data", {"name": "human_scans", **SMALL, "height": 40, "width": 30}))
    cameras = scan_layout.read_cameras(out / "cameras.json")
    for file in files.values():
        assert len(data.read([file])) == 3
        np.testing.assert_array_equal(scan_layout.vertex_colors(meshes.read(file)), registration.colors)
        for camera in cameras.values():
            pixel, depth = camera.project(torch.from_numpy(meshes.read(file).vertices).float())
            assert (depth > 0).all() and (pixel > -0.5).all() and (pixel < torch.tensor([29.5, 39.5])).all()
    turned = [
        math.atan2(*(-camera.rotation.T @ camera.translation)[[0, 2]].tolist()) for camera in cameras.values()
    ]
    np.testing.assert_allclose(np.exp(1j * np.array(turned)), np.exp(2j * np.pi * np.arange(3) / 3), atol=0.2)


WRONG = {
    "no movement": (["--pose", "left elbw=3"], "no movement 'left elbw'. Did you mean 'left elbow'"),
    "no number": (["--pose", "left elbow"], "expected a name and a number"),
    "infinite": (["--pose", "left elbow=inf"], "from -10000 to 10000"),
    "no direction": (["--shape", "4=1"], "'4' is not a direction; expected a number from 0 to 3"),
    "no file": (["--motion", "none.bvh"], "none.bvh: no such file"),
    "another body": ([], "the mesh has 40 vertices, but the meshes of"),
    "twice": (["ann"], "the name ann occurs twice"),
}


@pytest.mark.parametrize("more, words", WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_said_and_nothing_is_written(more, words, doll, tmp_path):
    registered(tmp_path / "ann", doll)
    scan_layout.write_registration(tmp_path / "other.ply", colored_mesh(0))
    people = [tmp_path / ("ann" if more else "other.ply")]
    people += [tmp_path / more.pop()] if more == ["ann"] else []
    arguments = ["--body", DOLL["body"], "--topology", "mine", "--out", str(tmp_path / "out"), *more]
    with pytest.raises(DataError, match=words):
        repose.main([*map(str, people), *arguments])
    assert not (tmp_path / "out").exists()
