import numpy as np
import pytest
import torch
from PIL import Image

from framework.bodies.parametric import PLACE
from framework.configuration.schema import build, resolve
from framework.errors import ConfigError, DataError
from framework.geometry.srgb import linear_from_bytes
from plugins.data.pose_from_image.data import Apart, Counts, PoseFromImage

SIZE = {"height": 48, "width": 40}
FINE = {"name": "rasterizer", "supersampling": 4}


def test_samples_are_as_far_off_as_they_should_be(doll_images):
    batch = doll_images.splits().test.__getitems__(range(6))
    torch.testing.assert_close(batch["target"][:, :3].norm(dim=1), torch.full((6,), np.pi / 6))
    torch.testing.assert_close(batch["target"][:, 3:6].norm(dim=1), torch.full((6,), 0.2))
    assert batch["input"].shape == (6, 4, 48, 40) and batch["color"].shape == (6, 48, 40, 3)
    assert torch.equal(batch["color"].movedim(-1, 1), batch["input"][:, :3])
    assert torch.equal(batch["mask"], batch["input"][:, 3] >= 0.5) and batch["mask"].any((1, 2)).all()
    assert torch.equal(doll_images.splits().test[4]["input"], batch["input"][4])
    assert doll_images.target.names[:6] == PLACE


def test_own_pictures_are_read_and_others_refused(doll_images, tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (48, 40, 4), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "cut.png")
    image = doll_images.read([tmp_path / "cut.png"])[0]["input"]
    cover = torch.from_numpy(pixels[..., 3:]).float() / 255
    torch.testing.assert_close(
        image.movedim(0, -1)[..., :3], linear_from_bytes(torch.from_numpy(pixels[..., :3])) * cover
    )
    for name, other in {"rgb.png": pixels[..., :3], "small.png": pixels[:20]}.items():
        Image.fromarray(np.ascontiguousarray(other)).save(tmp_path / name)
        with pytest.raises(DataError, match=rf"{name}.*expected 40 × 48 and an alpha channel"):
            doll_images.read([tmp_path / name])


def test_images_want_a_renderer_that_tells_the_body_from_the_ground():
    rasterizer = type(build("renderer", resolve("renderer", {"name": "rasterizer"})))
    on_white = type("OnWhite", (rasterizer,), {"background": 1.0})
    colourless = type("Colourless", (rasterizer,), {"channels": frozenset({"depth"})})
    for renderer in (on_white(), colourless()):
        with pytest.raises(
            ConfigError,
            match=f"{type(renderer).__name__} does not draw the channel `color` with a black background",
        ):
            PoseFromImage(renderer=renderer, counts=Counts(), displacement=Apart())
