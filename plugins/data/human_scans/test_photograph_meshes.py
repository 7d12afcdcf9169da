import shutil

import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.datasets import scan_layout
from framework.errors import DataError
from framework.testing.bodies import colored_mesh
from plugins.data.human_scans import photograph_meshes
from plugins.data.human_scans.rows import SMALL

SMALLER = ["--views", "3", "--size", "20", "16", "--topology", "mine"]


@pytest.fixture
def mesh_folder(tmp_path):
    folder = tmp_path / "given"
    for split, names in {"train": ("ann", "bob"), "validation": ("dan",), "test": ("eve",)}.items():
        for number, name in enumerate(names):
            scan_layout.write_registration(folder / split / f"{name}_scan.ply", colored_mesh(number))
            scan_layout.write_registration(
                folder / split / f"{name}_registration.ply", colored_mesh(number + 5)
            )
    return folder


def test_meshes_become_a_root(mesh_folder, tmp_path, capsys):
    root = tmp_path / "root"
    photograph_meshes.main([str(mesh_folder), str(root), *SMALLER])
    assert "4 people" in capsys.readouterr().out
    data = build(
        "data", resolve("data", {"name": "human_scans", **SMALL, "root": str(root), "topology": "mine"})
    )
    data.prepare()
    assert data.synthetic and data.size == (20, 16)
    assert [len(split) for split in data.splits()] == [6, 3, 3]
    read = scan_layout.read_subject(root, "bob", "mine").mesh
    assert torch.equal(read.vertices, colored_mesh(6).vertices) and torch.equal(
        read.colors, colored_mesh(6).colors
    )
    with pytest.raises(DataError, match="exists already"):
        photograph_meshes.main([str(mesh_folder), str(root), *SMALLER])


WRONG = {
    "no registration": (
        lambda folder: (folder / "train/bob_registration.ply").unlink(),
        "bob_scan.ply: the registration of this scan is missing",
    ),
    "no scans": (lambda folder: shutil.rmtree(folder / "test"), "test: the folder has no scan"),
    "twice": (
        lambda folder: [
            shutil.copy(folder / f"train/ann_{kind}.ply", folder / "test")
            for kind in ("scan", "registration")
        ],
        "the name ann occurs twice",
    ),
    "no mesh": (lambda folder: (folder / "validation/dan_scan.ply").write_text("dan"), "dan_scan.ply"),
}


@pytest.mark.parametrize("spoil, words", WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_said_and_nothing_is_left(mesh_folder, tmp_path, spoil, words):
    spoil(mesh_folder)
    with pytest.raises(DataError, match=words):
        photograph_meshes.main([str(mesh_folder), str(tmp_path / "root"), *SMALLER])
    assert not (tmp_path / "root").exists()
