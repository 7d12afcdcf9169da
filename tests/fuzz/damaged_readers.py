"""All readers of files, each with undamaged files, damage inside checksums, and malicious files."""

import gzip
import json
import warnings
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import torch
from safetensors.torch import save as to_safetensors

from framework.bodies import body_files, motion
from framework.configuration import loading
from framework.configuration.config import Config
from framework.datasets import scan_layout
from framework.datasets.csv_columns import mostly_numbers, numbers, read_columns
from framework.datasets.images import Crop
from framework.datasets.shards import open_shards
from framework.geometry import meshes
from framework.runs import resuming
from framework.scenes import scene_files, turntable, views
from framework.storage.generated import read_mark
from framework.storage.weights import read_weights
from framework.sweeps import jobs
from framework.testing import sample_files
from framework.testing import sample_scenes as scenes
from framework.tracking.journal import Journal
from framework.tracking.run_info import read_run_info
from plugins.data.cest.volumes import read_volume
from plugins.data.coil20.views import read_views
from plugins.data.head_pose import caviar_labels, idiap_labels, towncentre_labels
from plugins.data.human_scans import skins
from plugins.data.image_folder.idx import read_idx
from plugins.data.images_with_angles.table import read_table
from plugins.data.labelled_clouds.archive import read_archive
from plugins.data.pascal3d import layout
from plugins.data.pose_from_image.data import PoseFromImage
from plugins.data.registration import faust
from plugins.data.table_tennis import recordings
from tests.fuzz import crafted_files as crafted
from tests.fuzz import crafted_scenes
from tests.fuzz import damaged_files as whole
from tests.fuzz.damage import Reader, spoilt
from tests.fuzz.damaged_files import (
    FACES,
    VERTICES,
    image,
    in_gzip,
    in_mat,
    in_png,
    in_values,
    in_zip,
    npy,
    npz,
    signed,
    written,
)
from tests.fuzz.damaged_states import states

warnings.simplefilter("ignore")  # of what libraries say of damage


def crop(file: Path) -> object:
    return Crop(file, None, 0.1, 16, upright=True).read()


def columns(file: Path) -> object:
    found = read_columns(file)
    return [numbers(found, name, missing=None) for name in found.cells if mostly_numbers(found, name)]


def annotations(file: Path) -> object:
    return layout.read_annotations(file.parent.parent.parent, "car", "pascal", file.stem)


def cloud(file: Path) -> object:
    mesh = meshes.read(file, drop_non_finite=True)
    return mesh.attribute(())


def weight(file: Path) -> object:
    return read_weights(str(file))


def stored(file: Path) -> object:
    """Read a stored config with all checks that a run makes before it reads data."""
    (file.parent / "overrides.yaml").write_text("- seed=1\n", encoding="utf-8")
    values, changed = resuming.read_command(file.parent, {}, [f"resume={file.parent}"])
    return Config.of(values, file.parent, changed).assembly


def records(file: Path) -> object:
    return jobs.find_records(file.parent)


def value(file: Path) -> object:
    return jobs.Job(0, [], [], file.parent, "", "").value()


def readers() -> Iterator[Reader]:
    """Yield all readers in the order of the report."""
    yield from clouds()
    yield from subjects()
    yield from people()
    yield from tables_and_images()
    yield from labels()
    yield from spectra()
    yield from flights()
    yield from models()
    yield from states()
    yield from runs()


def clouds() -> Iterator[Reader]:
    off = written("a.off", lambda file: sample_files.write_off(file, VERTICES, FACES))
    text = written("a.ply", lambda file: sample_files.write_ply(file, VERTICES, FACES))
    binary = [whole.ply_binary("<", "binary_little_endian"), whole.ply_binary(">", "binary_big_endian")]
    arrays = [npy(VERTICES), npy(VERTICES.astype(">i4")), npy(np.asfortranarray(VERTICES))]
    packed = [npz(packed=packed, points=VERTICES, normals=VERTICES, faces=FACES) for packed in (False, True)]
    yield Reader("OFF", "one.off", [off], cloud, crafted=crafted.OFF)
    yield Reader("PLY, text", "one.ply", [text], cloud)
    yield Reader("PLY, binary", "two.ply", binary, cloud, crafted=crafted.PLY)
    yield Reader("STL", "one.stl", [whole.stl_text(), whole.stl_binary()], cloud)
    yield Reader("OBJ", "one.obj", [whole.obj()], cloud)
    yield Reader("LAS", "one.las", whole.las_files(), cloud, crafted=crafted.las_files())
    yield Reader("XYZ", "one.xyz", [whole.xyz()], cloud, crafted=crafted.XYZ)
    yield Reader("NPY, clouds", "one.npy", arrays, cloud, crafted=crafted.NPY)
    yield Reader("NPZ, clouds", "one.npz", packed, cloud, [in_zip], [*crafted.npz("points")])
    shard = npy(np.stack([VERTICES, VERTICES]).astype(np.float32))
    yield Reader("NPY, shards", "part-000000.npy", [shard], shards, crafted=crafted.NPY)
    index = b'{"version": 1, "files": 2, "part": 2, "columns": ["x", "y", "z"], "data": {"name": "a"}}'
    yield Reader("JSON, index of shards", "encoding.json", [index], shards, crafted=crafted.JSONS)
    scans = [whole.dales(False), whole.dales(True)]
    yield Reader(
        "NPZ, objects of scans",
        "objects.npz",
        scans,
        lambda file: read_archive(str(file)),
        [in_zip],
        [*crafted.npz("points")],
    )


def shards(file: Path) -> object:
    """Read a folder of shards, of which the only shard or the index is damaged."""
    shard = npy(np.stack([VERTICES, VERTICES]).astype(np.float32))
    beside(file, {"encoding.json": b'{"version": 1, "files": 2, "part": 2}', "part-000000.npy": shard})
    return [batch.numpy() for batch in open_shards(file.parent).batches(0, 2)]


def subjects() -> Iterator[Reader]:
    """Yield readers of the scenes that a command draws, and of the files that belong to them."""
    square = scenes.quad()
    camera = b'{"K": [[9, 0, 4], [0, 9, 4], [0, 0, 1]], "R": [[1,0,0], [0,1,0], [0,0,1]], "t": [0,0,2], "size": [9, 9]}'
    made = [*crafted_scenes.crafted()]
    glb, gltf = scenes.glb(*square), scenes.gltf(*square)
    yield Reader("GLB, scenes", "one.glb", [glb], scene_files.read, [crafted_scenes.in_glb], made)
    yield Reader("GLTF, scenes", "one.gltf", [gltf], scene_files.read, [crafted_scenes.in_gltf])
    yield Reader("OBJ, scenes", "scene/one.obj", [scenes.OBJ], materials)
    yield Reader("MTL", "scene/one.mtl", [scenes.MTL], materials, crafted=crafted_scenes.MTLS)
    yield Reader(
        "PNG, textures",
        "scene/one.png",
        [image("PNG"), image("JPEG")],
        materials,
        [in_png],
        [*crafted.images()],
        optional=True,
    )
    parts, binary = scenes.describe(*square)
    parts["buffers"][0]["uri"] = "scene.bin"
    yield Reader(  # the scene is named where bytes say nothing by themselves
        "BIN, buffers of scenes",
        "scene.bin",
        [binary],
        partial(with_buffer, document=json.dumps(parts)),
        told="scene.",
    )
    drawn = [image("PNG", "RGBA"), image("PNG")]
    true_image = partial(views.read_true_image, ground=(1.0, 1.0, 1.0))
    yield Reader("PNG, true images", "one.png", drawn, true_image, [in_png], [*crafted.images()])
    yield Reader("JSON, cameras", "camera.json", [camera], turntable.read_camera)


def with_buffer(file: Path, document: str) -> object:
    """Read a scene whose numbers are in a second file."""
    scene = file.with_suffix(".gltf")
    scene.write_text(document, encoding="utf-8")
    return scene_files.read(scene)


def people() -> Iterator[Reader]:
    """Yield readers of motions, and of the files of photographed people."""
    colors = np.arange(3 * len(VERTICES), dtype=np.uint8).reshape(-1, 3)
    parts = (torch.from_numpy(part) for part in (VERTICES.astype(np.float32), colors, FACES.astype(np.int64)))
    mesh = written(
        "a.ply", lambda file: scan_layout.write_registration(file, scan_layout.RegisteredMesh(*parts))
    )
    places = [
        npz(
            packed=packed, faces=FACES, uv=np.random.default_rng(0).random((len(VERTICES), 2)), uv_faces=FACES
        )
        for packed in (False, True)
    ]
    camera = b'"K": [[9, 0, 4], [0, 9, 4], [0, 0, 1]], "R": [[1,0,0], [0,1,0], [0,0,1]], "t": [0,0,2]'
    cameras = b'{"views": [{"name": "view_00", "height": 9, "width": 9, %s}]}' % camera
    yield Reader(
        "BVH", "walk.bvh", [whole.bvh()], motion.read, crafted=[*crafted.TEXTS, *crafted.motions(whole.bvh())]
    )
    yield Reader("PLY, registrations", "registration_7k.ply", [mesh], scan_layout.read_registration)
    yield Reader(
        "NPZ, places in textures",
        "topology_7k.npz",
        places,
        lambda file: scan_layout.read_places(file.parent, "7k"),
        [in_zip],
        [*crafted.npz("uv")],
    )
    yield Reader(
        "JSON, cameras of people", "cameras.json", [cameras], scan_layout.read_cameras, crafted=crafted.JSONS
    )
    yield Reader("text, lists of people", "train.txt", [b"test_0001\ntest_0002\n"], lists)
    yield Reader(
        "text, pairs of FAUST",
        "test/challenge_pairs/intra_challenge.txt",
        [b"000_001\n001_000\n002_001\n"],
        pairs,
        crafted=crafted.TEXTS,
    )


def pairs(file: Path) -> object:
    """Read the list of pairs of scans of the FAUST challenge."""
    folder = file.parents[2]
    for number in range(3):
        scan = faust.test_scan(folder, number)
        scan.parent.mkdir(exist_ok=True)
        scan.touch()
    return faust.pairs(folder, "intra")


def lists(file: Path) -> object:
    """Read the splits of people, one of whose lists is damaged."""
    for number, split in enumerate(("validation", "test")):
        file.with_name(f"{split}.txt").write_text(f"other_{number}\n")
    return scan_layout.read_splits(file.parent)


def beside(file: Path, sound: Mapping[str, bytes]) -> None:
    """Write the undamaged files that belong to a damaged file, by name, if they are missing."""
    for name, content in sound.items():
        if name != file.name and not file.with_name(name).exists():
            file.with_name(name).write_bytes(content)


def materials(file: Path) -> object:
    """Read an OBJ file and the files that it names, one of which is damaged."""
    beside(file, {"one.obj": scenes.OBJ, "one.mtl": scenes.MTL, "one.png": image("PNG")})
    return scene_files.read(file.with_suffix(".obj"))


def tables_and_images() -> Iterator[Reader]:
    table = b"\xef\xbb\xbfa,b,c\n" + b'1,2.5,x\n3,,y\n-1e3,4,"z\nw"\n' * 3
    angles = b"file,pan,tilt,split\n" + b"".join(
        b"%d.png,%d,-3.5,train\n" % (row, 10 * row) for row in range(9)
    )
    yield Reader("CSV, tables", "one.csv", [table], columns, crafted=crafted.CSV)
    packed = [*map(gzip.compress, crafted.CSV), gzip.compress(bytes(2**28), 1)]
    yield Reader("CSV, packed", "one.csv", [gzip.compress(table, 1)], columns, [in_gzip], packed)
    yield Reader("Parquet", "one.parquet", whole.parquets(), columns, crafted=crafted.parquets())
    yield Reader(
        "CSV, images with angles",
        "angles.csv",
        [angles],
        lambda file: read_table(file, None, None),
        crafted=crafted.CSV,
    )
    digits = bytes([0, 0, 8, 3, 0, 0, 0, 5, 0, 0, 0, 4, 0, 0, 0, 4]) + bytes(range(80))
    yield Reader("idx", "one", [digits], lambda file: read_idx(file, 3))
    yield Reader(
        "idx, packed", "one.gz", [gzip.compress(digits, 1)], lambda file: read_idx(file, 3), [in_gzip]
    )
    pngs = [image("PNG"), image("PNG", "P"), image("PNG", "RGBA"), image("PNG", "I;16")]
    jpegs = [image("JPEG"), image("JPEG", progressive=True), image("JPEG", "L"), image("JPEG", "CMYK")]
    others = [
        image(kind)
        for kind in ("GIF", "BMP", "TIFF", "WEBP", "PPM", "TGA", "PCX", "SGI", "JPEG2000", "ICO", "AVIF")
    ]
    others += [image("TIFF", compression=how) for how in ("tiff_lzw", "tiff_deflate", "packbits", "jpeg")]
    yield Reader("PNG", "one.png", pngs, crop, [in_png], [*crafted.images()])
    yield Reader("JPEG", "one.jpg", jpegs, crop)
    yield Reader("other images", "one.img", others, crop)
    yield Reader("images of skin", "one.png", pngs, skin, crafted=[*crafted.images()])
    bodies = [image("PNG", "RGBA"), image("TIFF", "RGBA")]
    yield Reader("images of bodies", "one.png", bodies, body, crafted=[*crafted.images()])


def skin(file: Path) -> object:
    return skins.content(file), skins.read(file)


def body(file: Path) -> object:
    return PoseFromImage._picture_of(cast(PoseFromImage, SimpleNamespace(input_shape=(4, 20, 24))), file)


def labels() -> Iterator[Reader]:
    yield Reader(
        "MATLAB 5, labels of CAVIAR", "or_label.mat", [whole.caviar(False), whole.caviar(True)],
        caviar_labels.read_labels, [in_mat], [*crafted.mat("or_label_train")],
    )  # fmt: skip
    yield Reader(
        "MATLAB 5, annotations of PASCAL3D+", "Annotations/car_pascal/one.mat",
        [whole.annotation(False), whole.annotation(True)], annotations, [in_mat], [*crafted.mat("record")],
    )  # fmt: skip
    yield Reader(
        "MATLAB 5, COIL-20", "COIL20.mat", [whole.coil()], lambda file: read_views(str(file), 32), [in_mat],
        [*crafted.mat("X")],
    )  # fmt: skip
    yield Reader(
        "MATLAB 7.3 (HDF5), labels of IDIAP", "or_label_full.mat",
        [whole.idiap(4), whole.idiap(1), whole.idiap_of_ours()],
        lambda file: idiap_labels.read_labels(file, "radians"), crafted=[*crafted.hdf5()],
    )  # fmt: skip
    text = b"pan = -13.50\nvalid = 1\n"
    yield Reader(
        "text, labels of TownCentre", "one.txt", [text], towncentre_labels.read_label, crafted=crafted.TEXTS
    )
    names = b"2008_000008 -1\n2008_000015  1\n2008_000019\n"
    yield Reader(
        "text, lists of PASCAL VOC", "car_train.txt", [names], layout.read_list, crafted=crafted.TEXTS
    )


def spectra() -> Iterator[Reader]:
    """Yield readers of Z-spectra, and of their offsets and masks."""
    found = whole.z_spectra()
    mats = [whole.mat(packed, **found) for packed in (False, True)]
    packed = [npz(packed=packed, **found) for packed in (False, True)]
    plain, offsets = whole.nifti(found["spectra"]), "\n".join(map(str, found["offsets"])).encode()
    yield Reader("MATLAB 5, Z-spectra", "slice.mat", mats, read_volume, [in_mat], [*crafted.mat("spectra")])
    yield Reader("NPZ, Z-spectra", "slice.npz", packed, read_volume, [in_zip], [*crafted.npz("spectra")])
    yield Reader("NIfTI, Z-spectra", "slice.nii", [plain], nifti, crafted=[*crafted.niftis(plain)])
    yield Reader(
        "NIfTI, Z-spectra, packed",
        "slice.nii.gz",
        [gzip.compress(plain)],
        nifti,
        [in_gzip],
        [gzip.compress(content) for content in crafted.niftis(plain)],
    )
    yield Reader(  # the volume is named where numbers say nothing by themselves
        "text, offsets of Z-spectra",
        "slice.offsets.txt",
        [offsets],
        nifti,
        crafted=crafted.TEXTS,
        told="slice.",
    )
    mask = gzip.compress(whole.nifti(found["mask"]))
    yield Reader("NIfTI, masks of Z-spectra", "slice.mask.nii.gz", [mask], nifti, [in_gzip], told="slice.")


def nifti(file: Path) -> object:
    """Read a volume with its offsets and its mask, one of which is damaged."""
    found = whole.z_spectra()
    sound = {
        "slice.nii": whole.nifti(found["spectra"]),
        "slice.offsets.txt": "\n".join(map(str, found["offsets"])).encode(),
        "slice.mask.nii.gz": gzip.compress(whole.nifti(found["mask"])),
    }
    beside(file, sound)
    return read_volume(file if file.name == "slice.nii.gz" else file.with_name("slice.nii"))


def flights() -> Iterator[Reader]:
    rows = whole.flight()
    table = b"t,x,y,z\n" + b"".join(b"%f,%f,%f,%f\n" % tuple(row) for row in rows)
    cells = np.empty((1, 2), object)
    cells[0, :] = rows, rows[:5]
    times, balls = np.empty((1, 2), object), np.empty((1, 2), object)
    for number in range(2):
        times[0, number], balls[0, number] = cells[0, number][:, :1], cells[0, number][:, 1:]
    mats = [
        whole.mat(packed, **content)
        for packed in (False, True)
        for content in ({"ballTrain": {"data": cells}}, {"time": times, "ball": balls})
    ]
    read = partial(recordings.flights_of, step=0.016)
    yield Reader("CSV, flights", "one.csv", [table], read, crafted=crafted.CSV)
    yield Reader(
        "MATLAB 5, flights",
        "one.mat",
        mats,
        read,
        [in_mat],
        [*crafted.mat("ballTrain"), *crafted.mat("ball")],
    )


def models() -> Iterator[Reader]:
    bodies = [npz(**whole.body()), npz(packed=True, **whole.body())]
    made = whole.checkpoint()
    harm = [*crafted.checkpoints(made, crafted.sha)]
    tensors = {"a.weight": torch.zeros(3, 4), "b": torch.arange(5)}
    files = [whole.saved(lambda stream: torch.save(tensors, stream))]
    yield Reader(
        "pickles of bodies", "body.pkl", whole.body_pickles(), body_files.read, crafted=crafted.PICKLES
    )
    yield Reader("NPZ of bodies", "body.npz", bodies, body_files.read, [in_zip], [*crafted.npz("v_template")])
    yield Reader(
        "checkpoints", "model.ckpt", [made], loading.load, [signed(spoilt), signed(in_zip), in_values], harm
    )
    bomb = crafted.deflated_part("archive/data.pkl", crafted.zeros(), crafted.BOMB)
    yield Reader("weights, torch", "one.pth", files, weight, [in_zip], [bomb, *crafted.PICKLES])
    yield Reader(
        "weights, safetensors",
        "one.safetensors",
        [to_safetensors(tensors)],
        weight,
        crafted=crafted.SAFETENSORS,
    )


def runs() -> Iterator[Reader]:
    config = whole.config()
    job = b'{"key": "a", "number": 0, "status": "completed", "overrides": ["seed=1"], "config": "x"}'
    mark = b'{"version": 1, "images": 20}'
    yield Reader(
        "run.json",
        "run.json",
        [whole.run_json()],
        lambda file: read_run_info(file.parent),
        crafted=crafted.JSONS,
    )
    yield Reader(
        "journal",
        "journal.jsonl",
        [whole.journal()],
        lambda file: list(Journal(file).lines()),
        crafted=crafted.JOURNALS,
    )
    yield Reader(  # a key is named, as where a user wrote it
        "config.yaml of a run", "config.yaml", [config], stored, crafted=[*crafted.yamls(config)], told=""
    )
    yield Reader("records of jobs", jobs.RECORD, [job], records, crafted=crafted.JSONS)
    yield Reader("values of jobs", jobs.VALUE, [b"0.5"], value, crafted=crafted.JSONS, optional=True)
    yield Reader(
        "marks of generated data",
        "synthetic.json",
        [mark],
        lambda file: read_mark(file.parent),
        crafted=crafted.JSONS,
    )
