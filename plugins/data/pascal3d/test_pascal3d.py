"""Tests of the reader of the official layout, its protocol, its messages, and the data contract."""

import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import torch
from PIL import Image

from framework.configuration import schema
from framework.datasets import images
from framework.datasets.fields import Fields
from framework.datasets.images import Crop, Crops
from framework.errors import ConfigError, DataError
from framework.renderer import Renderer
from framework.storage import parsed_files
from framework.testing.data_samples import fields_of, prepared
from framework.testing.sample_files import damaged_copies
from plugins.data.pascal3d import layout
from plugins.data.pascal3d.data import Pascal3D, validation_files
from plugins.data.pascal3d.generator import generate_class
from plugins.data.pascal3d.layout import VOC_LISTS, read_annotations
from plugins.data.pascal3d.scene import shoot


@pytest.fixture(scope="session")
def renderer() -> Renderer:
    return schema.build("renderer", schema.resolve("renderer", "rasterizer"))


@pytest.fixture(scope="session")
def shared_root(tmp_path_factory: pytest.TempPathFactory, renderer: Renderer) -> Path:
    """Return a generated root of 80 images of cars, which tests must not change."""
    return generate_class(tmp_path_factory.mktemp("roots"), "car", 80, 0, renderer)


@pytest.fixture
def root(shared_root: Path, tmp_path: Path) -> Path:
    """Return a copy of the shared root, which a test may change."""
    return Path(shutil.copytree(shared_root, tmp_path / "root"))


def prepare_data(root: Path | None, **config: Any) -> Pascal3D:
    return prepared("pascal3d", root=root and str(root), **config)


# ---- single annotations, as MATLAB writes them -----------------------------------------------------------

FINE = {"azimuth": 30.0, "elevation": 10.0, "theta": -5.0, "distance": 4.0}
CAR = {"class": "car", "bbox": [11.0, 21.0, 50.0, 60.0], "viewpoint": FINE}
EMPTY = np.zeros((0, 0))


def struct_array(entries: list[dict[str, Any]]) -> np.ndarray:
    """Return a MATLAB struct array; fields that an entry lacks are empty, as MATLAB fills them."""
    names = list(dict.fromkeys(name for entry in entries for name in entry))
    array = np.empty((1, len(entries)), dtype=[(name, object) for name in names])
    for index, entry in enumerate(entries):
        array[0, index] = tuple(entry.get(name, EMPTY) for name in names)
    return array


def write_and_read(
    folder: Path, *objects: dict[str, Any], filename: str = "image.jpg", **record: Any
) -> list[layout.Annotation]:
    """Write an annotation file with these objects, and return what the reader reads from it."""
    annotations = folder / "Annotations" / "car_pascal"
    annotations.mkdir(parents=True, exist_ok=True)
    content = {"filename": filename, "objects": struct_array(list(objects)), **record}
    scipy.io.savemat(annotations / "image.mat", {"record": content})
    return read_annotations(folder, "car", "pascal", "image")


def test_an_annotation_gives_the_image_box_and_angles_of_its_object(tmp_path: Path) -> None:
    (annotation,) = write_and_read(tmp_path, CAR)
    # the bbox counts pixels from 1 and includes both ends: 40 × 40 pixels
    assert annotation.box == (10.0, 20.0, 50.0, 60.0)
    assert annotation.angles == (30.0, 10.0, -5.0)
    assert (annotation.truncated, annotation.occluded, annotation.difficult) == (False, False, False)
    assert (annotation.symmetry, annotation.blur) == (1, None)
    assert annotation.image == tmp_path / "Images" / "car_pascal" / "image.jpg"


def test_one_object_that_is_a_plain_struct(tmp_path: Path) -> None:
    (annotation,) = write_and_read(tmp_path, objects=CAR)
    assert annotation.angles == (30.0, 10.0, -5.0)


def test_objects_in_a_cell_array(tmp_path: Path) -> None:
    cells = np.empty((1, 2), dtype=object)
    cells[0, 0], cells[0, 1] = CAR, {**CAR, "truncated": 1}
    annotations = write_and_read(tmp_path, objects=cells)
    assert [annotation.truncated for annotation in annotations] == [False, True]


def test_many_objects_of_many_classes_and_flags(tmp_path: Path) -> None:
    person = {"class": "person", "bbox": [1, 2, 3, 4]}
    annotations = write_and_read(
        tmp_path, person, {**CAR, "truncated": 1}, {**CAR, "occluded": True}, {**CAR, "difficult": 1.0}, CAR
    )
    flags = [(entry.truncated, entry.occluded, entry.difficult) for entry in annotations]
    assert flags == [(True, False, False), (False, True, False), (False, False, True), (False, False, False)]


def test_an_annotation_without_objects_gives_none(tmp_path: Path) -> None:
    assert write_and_read(tmp_path, objects=EMPTY) == []


@pytest.mark.parametrize(
    "viewpoint",
    [
        None,
        EMPTY,
        {"azimuth_coarse": 45.0, "elevation_coarse": 0.0, "distance": 0.0},
        {
            "azimuth_coarse": 45.0,
            "elevation_coarse": 0.0,
            "azimuth": EMPTY,
            "elevation": EMPTY,
            "theta": EMPTY,
        },
        {**FINE, "distance": 0.0},
        {**FINE, "theta": EMPTY},
        {**FINE, "azimuth": "left"},
    ],
    ids=["missing", "empty", "coarse", "empty fields", "distance 0", "no theta", "text"],
)
def test_objects_without_a_fine_label(tmp_path: Path, viewpoint: Any) -> None:
    entry = {name: value for name, value in CAR.items() if name != "viewpoint"}
    if viewpoint is not None:
        entry["viewpoint"] = viewpoint
    (annotation,) = write_and_read(tmp_path, entry)
    assert annotation.angles is None


def test_a_fine_label_without_a_distance_stays_fine(tmp_path: Path) -> None:
    viewpoint = {"azimuth": 1.0, "elevation": 2, "theta": 3}
    (annotation,) = write_and_read(tmp_path, {**CAR, "viewpoint": viewpoint})
    assert annotation.angles == (1.0, 2.0, 3.0)


@pytest.mark.parametrize("degrees", [-725.0, -180.0, -0.0, 179.5, 180.0, 359.0, 360.0, 1000.25])
def test_angles_of_any_size_become_radians(degrees: float) -> None:
    angle = layout.radians(degrees)
    assert -math.pi <= angle < math.pi
    assert math.cos(angle) == pytest.approx(math.cos(math.radians(degrees)), abs=1e-9)
    assert math.sin(angle) == pytest.approx(math.sin(math.radians(degrees)), abs=1e-9)


@pytest.mark.parametrize(
    "bbox", ["text", EMPTY, [1.0, 2.0, 3.0], [1.0, 2.0, math.nan, 4.0], [1.0, 2.0, math.inf, 4.0]]
)
def test_a_bbox_that_is_no_box_is_refused(tmp_path: Path, bbox: Any) -> None:
    with pytest.raises(DataError, match=r"image\.mat: Object 2 has the bbox .* four finite numbers"):
        write_and_read(tmp_path, {"class": "person", "bbox": [1, 2, 3, 4]}, {**CAR, "bbox": bbox})


def test_image_is_found_by_either_suffix_and_by_the_recorded_name(tmp_path: Path) -> None:
    folder = tmp_path / "Images" / "car_pascal"
    folder.mkdir(parents=True)
    for name in ("odd.png", "image.JPEG", "image.jpg"):  # each is preferred to those before it
        (folder / name).write_bytes(b"")
        (annotation,) = write_and_read(tmp_path, CAR, filename="odd.png")
        assert annotation.image == folder / name


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, r"image\.mat: no such file, although a list names it\. Copy it again from the release"),
        (b"", r"image\.mat: cannot be read as a MATLAB file"),
        (b"not a matrix at all" * 20, r"image\.mat: cannot be read as a MATLAB file"),
        (
            b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(400),
            r"image\.mat: got a MATLAB 7\.3 file, .* '-v7'",
        ),
    ],
    ids=["missing", "empty", "text", "7.3"],
)
def test_annotation_that_cannot_be_read(tmp_path: Path, content: bytes | None, message: str) -> None:
    folder = tmp_path / "Annotations" / "car_pascal"
    folder.mkdir(parents=True)
    if content is not None:
        (folder / "image.mat").write_bytes(content)
    with pytest.raises(DataError, match=message):
        read_annotations(tmp_path, "car", "pascal", "image")


def test_annotation_that_is_cut_short_or_is_another_matrix(tmp_path: Path) -> None:
    write_and_read(tmp_path, CAR)
    file = tmp_path / "Annotations" / "car_pascal" / "image.mat"
    whole = file.read_bytes()
    for length in range(0, len(whole), 97):
        file.write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"image\.mat"):
            read_annotations(tmp_path, "car", "pascal", "image")
    scipy.io.savemat(file, {"other": 1})
    with pytest.raises(DataError, match="holds no struct `record`"):
        read_annotations(tmp_path, "car", "pascal", "image")
    scipy.io.savemat(file, {"record": 1})
    with pytest.raises(DataError, match="holds no struct `record`"):
        read_annotations(tmp_path, "car", "pascal", "image")


@pytest.mark.filterwarnings("ignore")  # SciPy warns about some kinds of damage
@pytest.mark.parametrize("compressed", [False, True])
def test_damaged_annotations_are_read_or_named(tmp_path: Path, compressed: bool) -> None:
    """Check files with three random bytes; on one in twenty of the uncompressed ones, SciPy's reader would crash."""
    write_and_read(tmp_path, CAR, {**CAR, "truncated": 1})
    file = tmp_path / "Annotations" / "car_pascal" / "image.mat"
    record = scipy.io.loadmat(file)["record"]
    scipy.io.savemat(file, {"record": record}, do_compression=compressed)
    whole = file.read_bytes()
    refused = 0
    for damaged in damaged_copies(whole, 300):
        file.write_bytes(damaged)
        try:
            annotations = read_annotations(tmp_path, "car", "pascal", "image")
        except DataError as error:
            assert str(error).startswith(str(file))
            refused += 1
        else:
            assert len(annotations) <= 2
    assert refused > 200


def test_a_list_gives_its_positive_images_and_names_a_line_that_is_wrong(tmp_path: Path) -> None:
    file = tmp_path / "car_train.txt"
    file.write_text(
        "2008_000001 -1\n2008_000002  1\n\n2008_000003  0\n2008_000002 1\nn01_2\n", encoding="utf-8"
    )
    assert layout.read_list(file) == ["2008_000002", "2008_000003", "n01_2"]
    file.write_text("2008_000001 1\n2008_000002 7\n", encoding="utf-8")
    with pytest.raises(DataError, match=r"car_train\.txt line 2: '2008_000002 7' is neither"):
        layout.read_list(file)
    for outside in ("../2008_000001", "/home/2008_000001 1"):
        file.write_text(outside, encoding="utf-8")
        with pytest.raises(DataError, match=rf"car_train\.txt line 1: '{outside}' is neither an image name"):
            layout.read_list(file)
    for (
        end
    ) in "\x0b\x0c\x1c\x1d\x1e\x85\u2028\u2029":  # Python ends lines at these characters, but files do not
        file.write_bytes(f"2008_000001{end}n01_2\n".encode())
        with pytest.raises(DataError, match=r"car_train\.txt line 1: .* is neither an image name"):
            layout.read_list(file)
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match=r"car_train\.txt: cannot be read"):
        layout.read_list(file)


# ---- whole roots -----------------------------------------------------------------------------------------


def test_reading_a_generated_root_gives_the_drawn_objects(shared_root: Path, renderer: Renderer) -> None:
    """Compare with images that are drawn again, to which this test applies the protocol itself."""
    data = prepare_data(shared_root)
    assert data.synthetic
    expected: dict[str, list[tuple[float, ...]]] = {"training": [], "test": []}
    left_out = {"without a fine label": 0, "difficult": 0, "truncated or occluded": 0}
    for number in range(80):
        shot = shoot("car", np.random.default_rng([0, 5, number]), renderer)
        for car in (annotated for annotated in shot.objects if annotated.category == "car"):
            if not car.fine:
                left_out["without a fine label"] += 1
            elif car.difficult:
                left_out["difficult"] += 1
            elif car.truncated or car.occluded:
                left_out["truncated or occluded"] += 1
            else:
                angles = (car.view.azimuth, car.view.elevation, car.view.tilt)
                left, top, right, bottom = car.box
                side = 1.2 * (1 + max(right - left, bottom - top))
                blur = shot.blur * 48 / side
                expected["test" if number >= 64 else "training"].append((*angles, blur))
    assert dict(data.excluded) == {reason: count for reason, count in left_out.items() if count}
    assert data.skipped == 0

    def labels(*splits: str) -> np.ndarray:
        fields = [fields_of(data, split) for split in splits]
        columns = [torch.cat([f["target"].rad2deg(), f["blur"][:, None]], dim=1) for f in fields]
        rows = torch.cat(columns).double().numpy()
        rows[:, 0] %= 360
        return rows[np.argsort(rows[:, 0])]

    for name, splits in (("test", ("test",)), ("training", ("train", "validation"))):
        rows = np.array(expected[name])
        np.testing.assert_allclose(labels(*splits), rows[np.argsort(rows[:, 0])], atol=1e-4)


def test_fields_of_a_batch(shared_root: Path) -> None:
    data = prepare_data(shared_root, image_size=32)
    fields = fields_of(data, "train")
    count = len(data.splits().train)  # type: ignore[arg-type]
    assert data.input_shape == (3, 32, 32)
    assert data.groups == ("car",)
    assert data.target.names == ("azimuth", "elevation", "tilt")
    assert fields["input"].shape == (count, 3, 32, 32)
    assert torch.all(abs(fields["target"]) <= math.pi + 1e-6)
    assert torch.equal(fields["symmetry"], torch.ones(count, dtype=torch.int64))
    assert np.array_equal(data.preview(fields["input"][0]), fields["input"][0].permute(1, 2, 0).numpy())


def test_crop_holds_the_object_and_its_margin(shared_root: Path) -> None:
    """Compare a crop with pixels of the image that this test selects itself, about the middle of the box."""
    data = prepare_data(shared_root, margin=0.25, image_size=64)
    first = layout.read_list(shared_root / VOC_LISTS / "car_val.txt")
    annotation = next(
        car
        for name in first
        for car in read_annotations(shared_root, "car", "pascal", name)
        if not (car.truncated or car.occluded or car.difficult) and car.angles
    )
    left, top, right, bottom = annotation.box
    half = 0.75 * max(right - left, bottom - top)
    x, y = (left + right) / 2, (top + bottom) / 2
    with Image.open(annotation.image) as image:
        pixels = np.asarray(image.convert("RGB"), dtype=float)
    rows = np.clip(np.floor(y - half + 2 * half * (np.arange(64) + 0.5) / 64), 0, pixels.shape[0] - 1).astype(
        int
    )
    columns = np.clip(
        np.floor(x - half + 2 * half * (np.arange(64) + 0.5) / 64), 0, pixels.shape[1] - 1
    ).astype(int)
    nearest = pixels[rows][:, columns]
    crop = fields_of(data, "test")["input"][0].permute(1, 2, 0).numpy().astype(float)
    assert abs(crop - nearest).mean() < 12
    shifted = np.roll(nearest, 6, axis=1)
    assert abs(crop - nearest).mean() < 0.7 * abs(crop - shifted).mean()


def test_whole_images_are_held_out_independent_of_their_order(shared_root: Path) -> None:
    annotations = [
        annotation
        for source, file in layout.split_lists("car")["train"]
        for name in layout.read_list(shared_root / file)
        for annotation in read_annotations(shared_root, "car", source, name)
    ]
    held_out = validation_files(annotations, 0.2)
    files = {annotation.file for annotation in annotations}
    assert len(files) == 64
    assert len(held_out) == 13
    assert held_out < files
    assert validation_files(annotations[::-1], 0.2) == held_out


def test_occluded_objects_can_be_used_for_training_but_never_for_the_test(shared_root: Path) -> None:
    without, including = prepare_data(shared_root), prepare_data(shared_root, include_occluded=True)
    counts = [
        len(fields_of(d, "train")["index"]) + len(fields_of(d, "validation")["index"])
        for d in (without, including)
    ]
    assert counts[1] > counts[0]
    assert torch.equal(fields_of(without, "test")["target"], fields_of(including, "test")["target"])
    added = without.excluded["truncated or occluded"] - including.excluded["truncated or occluded"]
    assert counts[1] - counts[0] == added


def test_real_data_have_no_symmetry_and_no_blur(root: Path) -> None:
    """Check that a root without synthetic.json counts as real, independent of its annotations."""
    (root / "synthetic.json").unlink()
    data = prepare_data(root)
    assert "blur" not in fields_of(data, "train")
    assert data.fingerprint()["version"] == "PASCAL3D+ release 1.1"


def test_several_classes_are_groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path))
    data = prepare_data(None, category=["bottle", "diningtable", "bottle"], images=40, image_size=16)
    assert data.groups == ("bottle", "diningtable")
    fields = fields_of(data, "train")
    assert {(int(g), int(s)) for g, s in zip(fields["group"], fields["symmetry"], strict=True)} == {
        (0, 0),
        (1, 2),
    }
    alone = prepare_data(None, category="bottle", images=40, image_size=16)
    bottles = fields["group"] == 0
    assert torch.equal(fields_of(alone, "train")["target"], fields["target"][bottles])


def test_grey_and_cmyk_images_are_read_as_colour(root: Path) -> None:
    files = sorted((root / "Images" / "car_pascal").glob("*.jpg"))
    for file, mode in zip(files, ("L", "CMYK"), strict=False):
        with Image.open(file) as image:
            converted = image.convert(mode)
        converted.save(file)
    data = prepare_data(root)
    assert fields_of(data, "train")["input"].shape[1] == 3
    assert data.skipped == 0


def test_box_beyond_the_image_is_clipped(root: Path) -> None:
    def reach_out(record: dict[str, Any]) -> None:
        record["bbox"] = np.array([[-50.0, -20.0, 900.0, 700.0]])

    before = len(fields_of(prepare_data(root), "test")["index"])
    change_objects(root, "car_val", reach_out)
    data = prepare_data(root)
    assert len(fields_of(data, "test")["index"]) == before
    assert data.skipped == 0


def change_objects(
    root: Path, list_name: str, change: Callable[[dict[str, Any]], None], only: int = 1
) -> list[str]:
    """Change annotations of a VOC list and return their names.

    The first `only` annotations are changed that have a single object which the protocol uses. `change` is called with
    the struct of an object similar to `CAR`.
    """
    changed = []
    for name in layout.read_list(root / VOC_LISTS / f"{list_name}.txt"):
        file = root / "Annotations" / "car_pascal" / f"{name}.mat"
        (car, *further) = read_annotations(root, "car", "pascal", name)
        if further or car.angles is None or car.truncated or car.occluded or car.difficult:
            continue
        entry = {**CAR, "bbox": np.add(car.box, (1, 1, 0, 0)), "viewpoint": dict(FINE), "symmetry": 1}
        change(entry)
        scipy.io.savemat(file, {"record": {"filename": f"{name}.jpg", "objects": struct_array([entry])}})
        changed.append(name)
        if len(changed) == only:
            return changed
    raise AssertionError(f"fewer than {only} annotations to change in {list_name}")


def test_labels_that_an_earlier_command_parsed_are_used_until_their_file_changes(
    root: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(parsed_files, "SETTLED", -(10**9))
    first = prepare_data(root)
    reads: list[Path] = []
    read_variables = layout.read_variables

    def count(file: Path, *arguments: Any) -> Any:
        reads.append(file)
        return read_variables(file, *arguments)

    monkeypatch.setattr(layout, "read_variables", count)
    second = prepare_data(root)
    assert reads == []
    assert second.fingerprint() == first.fingerprint()
    assert second.excluded == first.excluded
    for split in ("train", "validation", "test"):
        assert all(
            torch.equal(field, fields_of(first, split)[name])
            for name, field in fields_of(second, split).items()
        )
    (name,) = change_objects(root, "car_val", lambda entry: entry["viewpoint"].update(azimuth=31.0))
    reads.clear()
    third = prepare_data(root)
    assert [file.stem for file in reads] == [name]
    assert third.fingerprint()["sha256"] != first.fingerprint()["sha256"]


# ---- errors ----------------------------------------------------------------------------------------------


def test_the_message_about_a_wrong_layout_names_the_fault_and_a_remedy(root: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no Annotations/bus_pascal/.*Unpack the whole release into"):
        prepare_data(root, category="bus")
    (root / "Image_sets" / "car_imagenet_val.txt").unlink()
    shutil.rmtree(root / "Images" / "car_imagenet")
    with pytest.raises(DataError, match=r"no Images/car_imagenet/, no Image_sets/car_imagenet_val\.txt\."):
        prepare_data(root)
    with pytest.raises(DataError, match=r"Did you mean .*/root\?"):
        prepare_data(tmp_path)


def test_a_misspelt_class_and_an_empty_list_are_refused(shared_root: Path) -> None:
    with pytest.raises(
        DataError, match=r"'motorbyke' is not a class of PASCAL3D\+\. Did you mean 'motorbike'\?"
    ):
        prepare_data(shared_root, category="motorbyke")
    with pytest.raises(DataError, match="category is empty"):
        prepare_data(shared_root, category=[])


def test_all_unreadable_files_are_named_or_skipped(root: Path) -> None:
    names = layout.read_list(root / "Image_sets" / "car_imagenet_train.txt")[:4]
    (root / "Annotations" / "car_imagenet" / f"{names[0]}.mat").write_bytes(b"broken")
    (root / "Annotations" / "car_imagenet" / f"{names[1]}.mat").unlink()
    test_name = change_objects(root, "car_val", lambda entry: None)[0]
    image = root / "Images" / "car_pascal" / f"{test_name}.jpg"
    image.write_bytes(image.read_bytes()[:900])
    other = change_objects(root, "car_train", lambda entry: entry.update(bbox=[500.0, 500, 600, 600]))[0]
    with pytest.raises(DataError) as caught:
        prepare_data(root)
    message = str(caught.value)
    assert message.startswith("4 of ")
    for part in (f"{names[0]}.mat", f"{names[1]}.mat", f"{test_name}.jpg", f"{other}.jpg: the box"):
        assert part in message
    assert "data.skip_unreadable=true" in message
    data = prepare_data(root, skip_unreadable=True)
    assert data.skipped == 4
    for split in ("train", "validation", "test"):
        fields = fields_of(data, split)
        assert torch.equal(fields["index"], torch.arange(len(fields["input"])))
        assert {len(field) for field in fields.values()} == {len(fields["input"])}


def test_the_message_about_damaged_generated_data_says_to_delete_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path))
    data = prepare_data(None, images=20)
    next(tmp_path.rglob("car_pascal/*.mat")).write_bytes(b"")
    with pytest.raises(
        DataError, match=rf"Delete {tmp_path}/pascal3d; the next run generates the data again"
    ):
        data.prepare()


@pytest.mark.parametrize("name", ["azimuth", "elevation", "theta"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_angle_that_is_not_finite_is_never_skipped(root: Path, name: str, value: float) -> None:
    changed = change_objects(
        root, "car_train", lambda entry: entry["viewpoint"].update({name: value}), only=2
    )
    with pytest.raises(DataError) as caught:
        prepare_data(root, skip_unreadable=True)
    assert str(caught.value).startswith("2 objects have an angle that is not a finite number of degrees")
    assert all(f"{name}.mat" in str(caught.value) for name in changed)


def test_an_empty_split_is_named(root: Path) -> None:
    (root / VOC_LISTS / "car_val.txt").write_text("", encoding="utf-8")
    with pytest.raises(
        DataError, match=r"The test split of car is empty: none of the objects .*left out: \d+ "
    ):
        prepare_data(root)
    (root / VOC_LISTS / "car_train.txt").write_text("", encoding="utf-8")
    for half in ("train", "val"):
        (root / "Image_sets" / f"car_imagenet_{half}.txt").write_text("", encoding="utf-8")
    with pytest.raises(DataError, match="The train split of car is empty"):
        prepare_data(root)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("image_size", 4),
        ("margin", math.nan),
        ("validation_share", 1.0),
        ("images", 3),
        ("jitter", -1),
        ("mirorr", True),
    ],
)
def test_a_config_out_of_range_is_refused(key: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=rf"data\.{key}"):
        schema.resolve("data", {"name": "pascal3d", key: value})


# ---- the rest of the contract ----------------------------------------------------------------------------


def test_large_data_are_read_when_used(shared_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    in_memory = prepare_data(shared_root)
    monkeypatch.setattr(images, "IN_MEMORY", 0)
    lazy = prepare_data(shared_root).splits().train
    assert isinstance(lazy, Crops)
    eager = fields_of(in_memory, "train")
    assert len(lazy) == len(eager["input"])
    for index in (0, len(lazy) - 1):
        item = lazy[index]
        assert item.keys() == eager.keys()
        assert all(torch.equal(item[name], eager[name][index]) for name in eager)


def test_a_missing_image_is_noticed_before_training_even_if_images_are_read_when_used(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = change_objects(root, "car_val", lambda entry: None)[0]
    (root / "Images" / "car_pascal" / f"{name}.jpg").unlink()
    monkeypatch.setattr(images, "IN_MEMORY", 0)
    with pytest.raises(DataError, match=rf"{name}\.jpg: no such file"):
        prepare_data(root)


def test_read_takes_a_users_own_files(shared_root: Path, tmp_path: Path) -> None:
    data = prepare_data(shared_root, image_size=16)
    Image.new("RGB", (30, 10), (255, 0, 0)).save(tmp_path / "wide.png")
    Image.new("L", (5, 9), 128).save(tmp_path / "small.png")
    samples = data.read([tmp_path / "wide.png", tmp_path / "small.png"])
    assert isinstance(samples, Fields)
    assert torch.equal(
        samples[0]["input"], torch.tensor([255, 0, 0], dtype=torch.uint8).view(3, 1, 1).expand(3, 16, 16)
    )
    assert torch.all(samples[1]["input"] == 128)
    (tmp_path / "note.txt").write_text("hello", encoding="utf-8")
    with pytest.raises(DataError, match=r"1 of 2 .*\n.*note\.txt: cannot be read as an image"):
        data.read([tmp_path / "wide.png", tmp_path / "note.txt"])


def test_augment_mirrors_half_of_a_batch_with_its_labels(shared_root: Path) -> None:
    data = prepare_data(shared_root, image_size=16, jitter=0.0)
    torch.manual_seed(0)
    pixels = torch.randint(0, 256, (200, 3, 16, 16), dtype=torch.uint8)
    batch = {"input": pixels, "target": torch.rand(200, 3) + 0.1, "index": torch.arange(200)}
    varied = data.augment(batch)
    same = (255 * varied["input"] - pixels).abs().amax((1, 2, 3)) < 0.01
    flipped = (255 * varied["input"] - pixels.flip(-1)).abs().amax((1, 2, 3)) < 0.01
    assert torch.all(same ^ flipped)
    assert 70 < int(flipped.sum()) < 130
    sign = torch.tensor([-1.0, 1.0, -1.0])
    torch.testing.assert_close(varied["target"][flipped], batch["target"][flipped] * sign, rtol=0, atol=0)
    torch.testing.assert_close(varied["target"][same], batch["target"][same], rtol=0, atol=0)
    assert varied["index"] is batch["index"]
    assert torch.equal(batch["input"], pixels)


def test_augment_can_be_switched_off(shared_root: Path) -> None:
    data = prepare_data(shared_root)
    batch = {name: field[:8] for name, field in fields_of(data, "train").items()}
    assert not torch.equal(data.augment(batch)["input"], data.augment(batch)["input"])
    off = prepare_data(shared_root, mirror=False, jitter=0.0)
    assert off.augment(batch) is batch
    unmirrored = prepare_data(shared_root, mirror=False)
    assert torch.equal(unmirrored.augment(batch)["target"], batch["target"])


def test_fingerprint_changes_with_a_label(root: Path) -> None:
    change_objects(root, "car_val", lambda entry: None)
    before = prepare_data(root).fingerprint()
    change_objects(root, "car_val", lambda entry: entry["viewpoint"].update(azimuth=31.0))
    after = prepare_data(root).fingerprint()
    assert before["test"] == after["test"]
    assert before["sha256"] != after["sha256"]


def test_a_crop_beyond_the_image_repeats_the_border(shared_root: Path) -> None:
    """Check that a box as large as the image is made square without adding black pixels."""
    file = next((shared_root / "Images" / "car_pascal").glob("*.jpg"))
    with Image.open(file) as image:
        width, height = image.size
        whole = np.asarray(image.convert("RGB"))
    pixels = Crop(file, (0.0, 0.0, float(width), float(height)), 0.5, 24).read()
    assert pixels[:, 0].float().mean() == pytest.approx(whole[0].mean(), abs=12)
