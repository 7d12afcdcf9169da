"""Tests of textures, compared with torch's own sampling, and of the consistency of channels."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from framework.geometry.camera import look_from
from framework.renderer import Scene, Texture, Wrap, join_scenes
from plugins.renderer.rasterizer.renderer import Rasterizer
from plugins.renderer.rasterizer.test_gradient import blob, camera


def textured_body(kind: torch.dtype = torch.float64, wrap: Wrap = "repeat", smooth: bool = True) -> Scene:
    """Return a body with a small, repeated texture; corners share vertices, but not texture coordinates."""
    vertices, faces, colors = blob(10)
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(5, 7, colors.shape[1], generator=generator, dtype=torch.float64).to(kind)
    places = torch.arange(3 * len(faces)).reshape(-1, 3)
    uv = 1.5 * vertices[faces].reshape(-1, 3)[:, :2].to(kind) + 0.3
    uv = uv + 0.02 * torch.rand(uv.shape, generator=generator).to(kind)
    texture = Texture((image,), uv, places, wrap=wrap, smooth=smooth)
    return Scene(vertices, faces, None, camera(), texture)


def sample_by_torch(image: Tensor, uv: Tensor, wrap: Wrap) -> Tensor:
    """Return bilinear samples by torch at texture coordinates (row, column, 2) in [-1, 2]."""
    if wrap == "repeat":  # five copies each way, the middle one from 0 to 1
        image, uv, wrap = image.repeat(5, 5, 1), (uv + 2) / 5, "clamp"
    grid = torch.stack([2 * uv[..., 0] - 1, 1 - 2 * uv[..., 1]], -1)
    mode = {"clamp": "border", "mirror": "reflection"}[wrap]
    samples = grid_sample(image.movedim(-1, 0)[None], grid[None], padding_mode=mode, align_corners=False)
    return samples[0].movedim(0, -1)


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
@pytest.mark.parametrize("wrap", ["repeat", "clamp", "mirror"])
def test_colours_and_gradients_equal_those_of_torch_sampling(wrap: Wrap, kind: torch.dtype) -> None:
    scene = textured_body(kind, wrap)
    assert scene.texture is not None
    image, uv = scene.texture.images[0].clone().requires_grad_(), scene.texture.uv.clone().requires_grad_()
    learned = replace(scene, texture=replace(scene.texture, images=(image,), uv=uv))
    channels = Rasterizer(gradient="interior")(learned, ("color", "barycentric", "face", "uv", "mask"))
    face, mask = channels["face"].long(), channels["mask"]
    weights = channels["barycentric"].double()
    again, places = image.detach().clone().requires_grad_(), uv.detach().clone().requires_grad_()
    place = (weights[..., None] * places[scene.texture.faces[face.clamp(min=0)]]).sum(-2)
    assert (place.detach() - channels["uv"])[mask].abs().max() < 1e-6
    wanted = sample_by_torch(again.double(), place.double(), wrap) * mask[..., None]
    assert (channels["color"] - wanted).abs().max() < 3e-6
    slope = torch.randn(channels["color"].shape, generator=torch.Generator().manual_seed(2))
    got = torch.autograd.grad((channels["color"] * slope).sum(), (image, uv))
    expected = torch.autograd.grad((wanted * slope).sum(), (again, places))
    # gradients use corners that are not rounded, so a point may lie beyond a texel centre, at which the gradient jumps
    for gradient, expected_gradient, limit in zip(got, expected, (1e-3, 0.03), strict=True):
        assert gradient.dtype == kind
        assert (gradient - expected_gradient).norm() < limit * expected_gradient.norm()


def test_the_nearest_texel_is_shown_without_smoothing() -> None:
    scene = textured_body(smooth=False)
    assert scene.texture is not None
    channels = Rasterizer()(scene, ("color", "uv", "mask"))
    image = scene.texture.images[0]
    place = channels["uv"].double()
    column, row = (place[..., 0] * 7).floor() % 7, ((1 - place[..., 1]) * 5).floor() % 5
    wanted = image[row.long(), column.long()] * channels["mask"][..., None]
    near = ((place * torch.tensor([7, 5]) - (place * torch.tensor([7, 5])).round()).abs() < 1e-4).any(-1)
    assert torch.equal(channels["color"][~near], wanted[~near].float())
    assert near[channels["mask"]].float().mean() < 0.01


def test_joined_subjects_look_the_same_as_alone() -> None:
    """Check subjects with textures, colours, both or neither; each keeps its own image, whatever the order."""
    textured = textured_body()
    assert textured.texture is not None
    vertices, faces, colors = blob(10)
    right, down = torch.tensor([0.9, 0.0, 0.0]), torch.tensor([0.0, 0.0, -0.9])
    small = torch.rand(2, 3, colors.shape[1], generator=torch.Generator().manual_seed(3)).double()
    other = replace(textured, texture=replace(textured.texture, images=(small,)), vertices=vertices + right)
    plain = Scene(vertices + down, faces, colors, camera())
    both = replace(other, vertices=vertices + down + right, colors=colors)
    subjects = [textured, other, plain, both]
    wide = look_from(0.3, 0.2, 0.1, distance=9.0, field_of_view=0.6, size=(70, 90))
    subjects = [replace(subject, camera=wide) for subject in subjects]
    renderer = Rasterizer()
    whole = renderer(join_scenes(subjects), ("color", "face", "uv"))
    pixel_count = 0
    for number, subject in enumerate(subjects):
        alone = renderer(subject, ("color", "face", "uv"))
        low, high = number * len(faces), (number + 1) * len(faces)
        shows_subject = (whole["face"] >= low) & (whole["face"] < high)
        pixel_count += int(shows_subject.sum())
        assert shows_subject.sum() > 100
        for name in ("color", "uv"):
            assert torch.equal(whole[name][shows_subject], alone[name][shows_subject])
    assert pixel_count == (whole["face"] >= 0).sum()


@pytest.mark.parametrize(("colored", "textured"), list(itertools.product([False, True], repeat=2))[1:])
def test_joining_keeps_colours_and_textures(colored: bool, textured: bool) -> None:
    vertices, faces, colors = blob(4)
    plain = Scene(vertices, faces, colors if colored else None, camera())
    scene = join_scenes([plain, replace(plain, texture=textured_body().texture if textured else None), plain])
    assert len(scene.vertices) == 3 * len(vertices) and scene.faces.max() == 3 * len(vertices) - 1
    assert (scene.colors is not None) == colored and (scene.texture is not None) == textured
    if scene.texture is not None:
        assert scene.texture.shown is not None and set(scene.texture.shown.tolist()) == {-1, 0}


WHOLE = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)


@pytest.mark.parametrize("count", [100, 300, 40_000])
@pytest.mark.parametrize("textured", list(itertools.product([False, True], repeat=2)), ids=str)
@pytest.mark.parametrize(("kind", "other"), list(itertools.product(WHOLE, repeat=2)), ids=str)
def test_joined_indices_are_right_for_all_index_types(
    kind: torch.dtype, other: torch.dtype, textured: tuple[bool, bool], count: int
) -> None:
    """Join many vertices, texture coordinates and images with few, so that indices exceed the smaller types."""

    def subject(count: int, kind: torch.dtype, cover: bool) -> Scene:
        most = min(count, torch.iinfo(kind).max)
        faces = torch.tensor([[0, 1, most - 1], [2, most - 2, 1]]).to(kind)
        images = tuple(torch.full((1, 1, 3), 0.5) for _ in range(min(most, 130) - 1))
        shown = torch.tensor([0, len(images) - 1]).to(kind)
        texture = Texture(images, torch.zeros(count, 2), faces.long(), shown.long())
        scene = Scene(
            torch.zeros(count, 3), faces.long(), torch.zeros(count, 3), camera(), texture if cover else None
        )
        # bypasses the type checks of the tests, which do not allow uint8
        for part, name, value in (
            (scene, "faces", faces),
            (texture, "faces", faces),
            (texture, "shown", shown),
        ):
            object.__setattr__(part, name, value)
        return scene

    merged = join_scenes([subject(count, kind, textured[0]), subject(100, other, textured[1])])
    # expected result: the same small numbers as int64, shifted by hand
    first, last = subject(count, kind, True), subject(100, other, True)
    assert first.texture is not None and first.texture.shown is not None
    assert last.texture is not None and last.texture.shown is not None
    assert merged.faces.tolist() == [*first.faces.tolist(), *(last.faces.long() + count).tolist()]
    if merged.texture is None:
        assert not any(textured)
        return
    places, images = (count, len(first.texture.images)) if textured[0] else (0, 0)
    nothing = torch.zeros(2, 3, dtype=torch.int64)
    parts = [first.texture.faces if textured[0] else nothing]
    parts += [last.texture.faces.long() + places if textured[1] else nothing]
    assert merged.texture.faces.tolist() == torch.cat(parts).tolist()
    shown = first.texture.shown.tolist() if textured[0] else [-1, -1]
    shown += (last.texture.shown.long() + images).tolist() if textured[1] else [-1, -1]
    assert merged.texture.shown is not None and merged.texture.shown.tolist() == shown


def test_subjects_that_do_not_fit_together_are_not_joined() -> None:
    vertices, faces, colors = blob(4)
    with pytest.raises(ValueError, match="1 and 3 channels; expected the same number"):
        join_scenes([Scene(vertices, faces, colors[:, :1], camera()), textured_body()])
    with pytest.raises(ValueError, match="Got no scene to join"):
        join_scenes([])
    other = textured_body(wrap="clamp")
    with pytest.raises(ValueError, match="The textures of the scenes differ in `wrap` or `smooth`"):
        join_scenes([textured_body(), other])


@pytest.mark.parametrize("implementation", [Rasterizer.__call__, Rasterizer.on_device])
@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"images": ()}, "without images"),
        ({"images": (torch.tensor(1.0),)}, "shape ()"),
        ({"images": (torch.zeros(4, 3),)}, "shape (4, 3)"),
        ({"images": (torch.zeros(0, 4, 3),)}, "shape (0, 4, 3)"),
        ({"images": (torch.zeros(2, 2, 3), torch.zeros(2, 2, 1))}, "shape (2, 2, 1)"),
        ({"images": (torch.zeros(2, 2, 3, dtype=torch.uint8),)}, "torch.uint8, expected floating point"),
        ({"uv": torch.full((30, 2), torch.nan)}, "not finite"),
        ({"uv": torch.full((30, 2), 1e9)}, "beyond 1e+06"),
        ({"uv": torch.zeros(30, 3)}, "shape (30, 3)"),
        ({"uv": torch.zeros(30)}, "shape (30,)"),
        ({"uv": torch.zeros(30, 2, dtype=torch.int64)}, "uv: got torch.int64"),
        ({"faces": torch.zeros(4, 3)}, "texture.faces: got torch.float32, expected whole numbers"),
        ({"faces": torch.zeros(12, dtype=torch.int64)}, "texture.faces: got the shape (12,)"),
        ({"faces": torch.zeros(4, 4, dtype=torch.int64)}, "texture.faces: got the shape (4, 4)"),
        ({"faces": torch.full((4, 3), -1)}, "-1 to -1, expected 0 to 29"),
        ({"shown": torch.zeros(4)}, "texture.shown: got torch.float32, expected whole numbers"),
        ({"faces": torch.full((4, 3), 99)}, "99 to 99, expected 0 to 29"),
        ({"faces": torch.zeros(5, 3, dtype=torch.int64)}, "has 5 faces"),
        ({"shown": torch.zeros(3, dtype=torch.int64)}, "shown has the shape (3,)"),
        ({"shown": torch.full((4,), 1)}, "images 1 to 1, expected -1 to 0"),
        ({"wrap": "around"}, "'around', expected one of repeat"),
    ],
)
def test_a_texture_that_does_not_fit_raises_a_clear_message(
    change: dict[str, object],
    sentence: str,
    implementation: Callable[[Rasterizer, Scene, Sequence[str]], dict[str, Tensor]],
) -> None:
    corners = torch.rand(12, 3, generator=torch.Generator().manual_seed(0))
    faces = torch.arange(12).reshape(4, 3)
    texture = Texture((torch.rand(2, 2, 3),), torch.rand(30, 2), faces)
    for name, value in change.items():
        object.__setattr__(texture, name, value)  # bypasses the type checks of the tests
    scene = Scene(corners, faces, None, camera(), texture)
    for channels in (("color",), ("uv",), ("mask", "color")):
        with pytest.raises(ValueError) as caught:
            implementation(Rasterizer(), scene, channels)
        assert sentence in str(caught.value)
    assert set(implementation(Rasterizer(), scene, ("mask", "depth"))) == {
        "mask",
        "depth",
    }  # these channels do not read the texture


def test_soft_images_do_not_support_textures() -> None:
    with pytest.raises(ValueError, match="gradient=soft draws only colours of vertices"):
        Rasterizer(gradient="soft")(textured_body())
    assert Rasterizer(gradient="soft")(textured_body(), ("mask", "uv"))["mask"].any()
    assert "texture" not in Rasterizer(gradient="soft").differentiable
