import json
from zipfile import ZipFile

import numpy as np
import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.errors import DataError
from framework.geometry.meshes import read
from framework.testing.bodies import person, small_body
from framework.testing.sample_files import write_ply
from plugins.data.registration import faust
from plugins.data.registration.correspond import write_correspondences
from plugins.data.registration.faust_generator import people_root
from plugins.data.registration.rows import people

NO_FACES = np.empty((0, 3), int)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faust")
    people(folder)
    return folder


def data(root, **config):
    return build("data", resolve("data", {"name": "faust", "root": root and str(root), **config}))


def test_people_are_split_and_meshes_come_back_in_metres(root):
    faust = data(root, points=200)
    faust.prepare()
    numbers = {"train": [0, 3], "validation": [70, 75], "test": [80, 81, 90, 99]}
    assert faust.input_shape == (200, 3)
    assert faust.columns == ("x", "y", "z")
    assert len(faust.target.names) == 120
    assert faust.target.names[:4] == ("x0", "y0", "z0", "x1")
    assert not faust.synthetic
    assert faust.faces.tolist() == [[0, 1, 2], [2, 1, 3]]
    for name, wanted in numbers.items():
        split = getattr(faust.splits(), name)
        batch = split.__getitems__(range(len(split)))
        assert batch["subject"].tolist() == [number // 10 for number in wanted]
        for row, number in enumerate(wanted):
            mesh, scan = person(number)
            place = batch["centre"][row].numpy(), batch["scale"][row].numpy()
            vertices = batch["target"][row].reshape(-1, 3).numpy() * place[1] + place[0]
            np.testing.assert_allclose(vertices, mesh, atol=1e-6)
            cloud = batch["input"][row].numpy() * place[1] + place[0]
            gap = np.linalg.norm(cloud[:, None] - scan, axis=-1)
            assert gap.min(1).max() < 1e-6  # points of the scan,
            assert len(set(gap.argmin(1))) == 200  # none twice


def test_points_depend_on_the_seed_and_small_scans_are_padded(root):
    first, second, whole = data(root, points=150), data(root, points=150, data_seed=1), data(root, points=500)
    for data_set in (first, second, whole):
        data_set.prepare()
    assert not torch.equal(first.splits().train.fields["input"], second.splits().train.fields["input"])
    assert whole.splits().train.fields["input"].shape == (2, 300, 3)


def test_a_generated_layout_says_so(root, tmp_path):
    for number in (1, 70, 80):
        mesh, scan = person(number)
        write_ply(tmp_path / f"training/registrations/tr_reg_{number:03}.ply", mesh, NO_FACES)
        write_ply(tmp_path / f"training/scans/tr_scan_{number:03}.ply", scan, NO_FACES)
    (tmp_path / "synthetic.json").write_text(json.dumps({"bodies": 3}))
    faust = data(tmp_path)
    faust.prepare()
    assert faust.synthetic


def test_what_is_not_there_is_said(root, tmp_path):
    with pytest.raises(DataError, match="this folder does not hold FAUST"):
        data(tmp_path).prepare()
    mesh, scan = person(0)
    write_ply(tmp_path / "training/scans/tr_scan_004.ply", scan, NO_FACES)
    with pytest.raises(DataError, match=r"tr_reg_004\.ply is missing"):
        data(tmp_path).prepare()
    write_ply(tmp_path / "training/registrations/tr_reg_004.ply", mesh, NO_FACES)
    with pytest.raises(DataError, match=r"no scan for the validation split; the folder has the people \[0\]"):
        data(tmp_path).prepare()
    for number in (70, 80):
        write_ply(tmp_path / f"training/scans/tr_scan_{number:03}.ply", scan, NO_FACES)
        write_ply(tmp_path / f"training/registrations/tr_reg_{number:03}.ply", mesh[: number - 40], NO_FACES)
    with pytest.raises(
        DataError, match=r"tr_reg_070\.ply: the mesh has 30 vertices, but the first registration has 40"
    ):
        data(tmp_path).prepare()
    with pytest.raises(DataError, match=r"both name the people \[8\]"):
        data(root, validation=[7, 8]).prepare()


@pytest.fixture(scope="module")
def generated():
    return people_root(small_body()["body"])


def test_generated_people_lie_in_fausts_layout_and_say_so(generated):
    faust_data = data(None, body=small_body()["body"], points=200)
    faust_data.prepare()
    assert faust_data.synthetic and faust_data.fingerprint()["root"] == "generated"
    assert [len(split) for split in faust_data.splits()] == [70, 10, 20]
    assert {path.parent.name for path in generated.glob("test/*/*")} == {
        "scans",
        "registrations",
        "challenge_pairs",
    }
    for challenge in faust.CHALLENGES:
        scan_pairs = faust.pairs(generated, challenge)
        assert len(set(scan_pairs)) == 30
        assert all((path // 3 == second // 3) == (challenge == "intra") for path, second in scan_pairs)


@pytest.mark.slow
@pytest.mark.parametrize("challenge", faust.CHALLENGES)
def test_challenges_are_answered_as_they_ask(generated, tmp_path, challenge):
    def registered(scan, off=0.0):
        truth = read(faust.test_registration(generated, int(scan.stem[-3:]))).vertices
        return truth + np.array([off, 0, 0])

    result = write_correspondences(registered, generated, challenge, tmp_path)
    assert result.pairs == 30 and max(result.error_cm) < 1e-3
    with ZipFile(result.file) as archive:
        scan_pairs = faust.pairs(generated, challenge)
        assert archive.namelist() == [f"{pair}.txt" for pair in scan_pairs]
        places = np.loadtxt(archive.open(f"{scan_pairs[0]}.txt"))
    assert places.shape == read(faust.test_scan(generated, scan_pairs[0].first)).vertices.shape
    mesh = read(faust.test_registration(generated, scan_pairs[0].second)).vertices
    gap = np.linalg.norm(places[:200, None] - mesh, axis=-1)
    assert gap.min(1).max() < 1e-5  # a vertex of the mesh on the second scan
    off = write_correspondences(lambda scan: registered(scan, 0.07), generated, challenge, tmp_path)
    # the error is 7 cm, or less if a point of the first scan is mapped to a neighbour that is nearer
    assert all(error > 4 for error in off.error_cm)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("000_01\n", "'000_01'; expected two test scans"),
        ("000_199\n", r"test_scan_199\.ply does not exist"),
        ("", "contains no pair"),
        ("0\u00e9", "expected two test scans"),
    ],
)
def test_bad_lists_of_pairs_get_a_sentence(tmp_path, text, words):
    mesh, _ = person(0)
    write_ply(faust.test_scan(tmp_path, 0), mesh, NO_FACES)
    file = faust.pairs_file(tmp_path, "intra")
    file.parent.mkdir(parents=True)
    file.write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match=words):
        faust.pairs(tmp_path, "intra")
    with pytest.raises(DataError, match="no such file"):
        faust.pairs(tmp_path, "inter")
