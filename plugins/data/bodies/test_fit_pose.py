import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from scipy.stats import norm
from torch.distributions import Independent, Normal

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError, DataError
from framework.geometry.srgb import linear_from_bytes
from framework.prediction import Prediction
from framework.renderer import Renderer
from framework.target import Target
from plugins.data.bodies.descent import (
    STAGES,
    Descent,
    Stage,
    blurred,
    reduced,
    smaller,
    updated,
)
from plugins.data.bodies.figure import PLACE, figure_of
from plugins.data.bodies.fit_pose import PoseDensity
from plugins.data.bodies.pose_error import place_errors
from plugins.data.bodies.rows import DOLL

SIZE = {"height": 48, "width": 40}
FINE = {"name": "rasterizer", "supersampling": 4}


def renderer(**config):
    return build("renderer", resolve("renderer", {**FINE, **config}))


@pytest.fixture(scope="module")
def figure():
    return figure_of(DOLL["body"])


@pytest.fixture(scope="module")
def data():
    config = {
        "name": "pose_from_image",
        "renderer": FINE,
        "train": 3,
        "validation": 2,
        "test": 6,
        **SIZE,
        **DOLL,
    }
    found = build("data", resolve("data", config))
    found.prepare()
    return found


def head(target, **config):
    config = {"name": "fit_pose", "renderer": FINE, **SIZE, **DOLL, **config}
    return build("density_head", resolve("density_head", config), target=target).eval()


def numbers(figure, seed=0, size=1.0):
    random = np.random.default_rng(seed)
    found = torch.from_numpy(random.normal(0, 1, len(figure.names))) * figure.spread
    found[:6] = torch.from_numpy(random.normal(0, 1, 6)) * 0.2
    return size * torch.minimum(torch.maximum(found, figure.limits[:, 0]), figure.limits[:, 1])


def test_place_turns_the_body_about_its_root_and_moves_it(figure):
    nominal = figure(torch.zeros(len(figure.names))).double().numpy()
    place = torch.zeros(len(figure.names), dtype=torch.float64)
    place[:6] = torch.tensor([0.3, -1.2, 0.7, 0.1, -0.2, 0.3])
    root = figure.joints[figure.parents.index(-1)].numpy()
    wanted = Rotation.from_rotvec(place[:3].numpy()).apply(nominal - root) + root + place[3:6].numpy()
    np.testing.assert_allclose(figure(place).numpy(), wanted, atol=2e-6)
    np.testing.assert_allclose(nominal, figure.template.T.numpy(), atol=1e-6)


def test_movements_bend_what_they_name(figure):
    """Check that the forearm moves forwards, the knee back and the arm up, and that left mirrors right."""

    def moved(name):
        given = torch.zeros(len(figure.names), dtype=torch.float64)
        given[figure.names.index(name)] = 0.2
        return (figure(given) - figure(given * 0)).double()

    mirror = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    for name, axis, sign in (
        ("elbow", 2, 1),
        ("knee", 2, -1),
        ("raise", 1, 1),
        ("hip", 2, 1),
        ("forward", 2, 1),
    ):
        left, right = moved(f"left_{name}"), moved(f"right_{name}")
        far = left.norm(dim=1).argmax()
        assert sign * left[far, axis] > 0.02, name
        assert (left.sum(0) * mirror - right.sum(0)).abs().max() < 0.02, name


def test_slopes_are_those_of_the_vertices(figure):
    at, chosen, step = numbers(figure), torch.arange(0, len(figure.colors), 7), 1e-3
    slopes = figure.slopes(at, chosen)
    for column in range(len(at)):
        aside = torch.zeros_like(at)
        aside[column] = step
        wanted = (figure(at + aside) - figure(at - aside))[chosen] / (2 * step)
        torch.testing.assert_close(
            slopes[:, :, column], wanted, atol=1e-3, rtol=1e-3, msg=figure.names[column]
        )


def test_a_smaller_picture_is_the_mean_of_the_pixels(figure):
    """Check that 1/part of the pixels with part times the samples has the same samples, and so the same numbers."""
    camera, fine = figure.camera(**SIZE), renderer(supersampling=8)
    whole = renderer(supersampling=2)(figure.scene(numbers(figure), camera))["color"]
    drawn = fine(figure.scene(numbers(figure), smaller(camera, 4)))["color"]
    torch.testing.assert_close(drawn, reduced(whole, 4), atol=1e-5, rtol=0)


@pytest.mark.parametrize("deviation", [0.7, 1.0, 2.0])
def test_blur_is_a_gaussian(deviation):
    picture = torch.rand(20, 12, 3)
    wanted = gaussian_filter(
        picture.double().numpy(),
        (deviation, deviation, 0),
        mode="constant",
        radius=(*2 * [round(3 * deviation)], 0),
    )
    np.testing.assert_allclose(blurred(picture, deviation).numpy(), wanted, atol=1e-6)


def test_the_gradient_is_that_of_the_loss(figure):
    """Compare with central differences of a loss drawn with 16 x 16 samples a pixel, and check the curvature."""
    camera, stage = figure.camera(**SIZE), Stage(2, 1.0, 0.1)
    at, fine = numbers(figure, 1, 0.5), renderer(supersampling=16)
    aim = fine(figure.scene(at + 0.05 * numbers(figure, 2), camera))["color"]
    descents = [
        Descent(figure, drawing, camera, steps=1, restarts=0, enough=1e-3) for drawing in (renderer(), fine)
    ]
    aims = blurred(reduced(aim, stage.part), stage.blur)
    view = smaller(camera, stage.part)
    _, slope = descents[0]._loss(at, stage, view, aims)
    wanted = torch.zeros_like(at)
    for column, step in enumerate(figure.spread * 0.1):
        aside = torch.zeros_like(at)
        aside[column] = step if column >= 6 else 0.02
        ends = [descents[1]._loss(at + sign * aside, stage, view, aims)[0] for sign in (1, -1)]
        wanted[column] = (ends[0] - ends[1]) / (2 * aside[column])
    cosine = torch.nn.functional.cosine_similarity(slope * figure.spread, wanted * figure.spread, dim=0)
    assert cosine > 0.98
    curvature = descents[0]._curvature(at, stage)
    assert torch.linalg.eigvalsh(curvature).min() > 0
    assert (slope @ torch.linalg.solve(curvature, wanted)) > 0


def test_an_update_keeps_the_curvature_positive_and_learns_a_quadratic():
    """Check that BFGS with exact steps along n conjugate directions finds the matrix.

    Source: Nocedal & Wright 2006, th. 6.4.
    """
    random = np.random.default_rng(0)
    root = torch.from_numpy(random.normal(0, 1, (5, 5)))
    wanted = root @ root.T + torch.eye(5)
    found = torch.eye(5, dtype=torch.float64)
    for direction in torch.linalg.eigh(wanted).eigenvectors.T:
        found = updated(found, direction, wanted @ direction)
    torch.testing.assert_close(found, wanted)
    for _ in range(20):
        found = updated(found, *torch.from_numpy(random.normal(0, 1, (2, 5))))
        assert torch.linalg.eigvalsh(found).min() > 0


@pytest.mark.parametrize("gradient", ["boundary", "nmr", "soft"])
def test_a_small_offset_is_found_again(figure, gradient):
    """Check that every gradient reduces the error, and that the exact one finds the original parameters."""
    camera = figure.camera(**SIZE)
    wanted = torch.zeros(len(figure.names), dtype=torch.float64)
    wanted[:6] = torch.tensor([0.05, 0.15, -0.1, 0.05, -0.04, 0.06])
    picture = renderer(supersampling=8)(figure.scene(wanted, camera))["color"]
    drawing = renderer(gradient=gradient)
    fit = Descent(figure, drawing, camera, steps=20, restarts=0, enough=1e-3)(picture)
    degrees, centimetres = place_errors(fit.numbers, wanted)
    start = place_errors(wanted * 0, wanted)
    assert degrees < start[0] / 2 and centimetres < start[1] / 2
    if gradient == "boundary":
        assert degrees < 1 and centimetres < 1
    assert fit.path.shape[1] == 2 + len(figure.names) and fit.path.isfinite().all()
    again = Descent(figure, drawing, camera, steps=20, restarts=0, enough=1e-3)(picture)
    assert torch.equal(again.numbers, fit.numbers)


def test_place_errors_against_scipy():
    random = np.random.default_rng(0)
    one, other = random.normal(0, 1, (2, 20, 8))
    degrees, centimetres = place_errors(torch.from_numpy(one), torch.from_numpy(other))
    between = Rotation.from_rotvec(one[:, :3]).inv() * Rotation.from_rotvec(other[:, :3])
    np.testing.assert_allclose(degrees, np.degrees(between.magnitude()), rtol=1e-9)
    np.testing.assert_allclose(centimetres, 100 * np.linalg.norm(one[:, 3:6] - other[:, 3:6], axis=1))


def test_samples_are_as_far_off_as_they_should_be(data):
    batch = data.splits().test.__getitems__(range(6))
    torch.testing.assert_close(batch["target"][:, :3].norm(dim=1), torch.full((6,), np.pi / 6))
    torch.testing.assert_close(batch["target"][:, 3:6].norm(dim=1), torch.full((6,), 0.2))
    assert batch["input"].shape == (6, 4, 48, 40) and batch["color"].shape == (6, 48, 40, 3)
    assert torch.equal(batch["color"].movedim(-1, 1), batch["input"][:, :3])
    assert torch.equal(batch["mask"], batch["input"][:, 3] >= 0.5) and batch["mask"].any((1, 2)).all()
    assert torch.equal(data.splits().test[4]["input"], batch["input"][4])
    assert data.target.names[:6] == PLACE


def test_own_pictures_are_read_and_others_refused(data, tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (48, 40, 4), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "cut.png")
    found = data.read([tmp_path / "cut.png"])[0]["input"]
    cover = torch.from_numpy(pixels[..., 3:]).float() / 255
    torch.testing.assert_close(
        found.movedim(0, -1)[..., :3], linear_from_bytes(torch.from_numpy(pixels[..., :3])) * cover
    )
    for name, other in {"rgb.png": pixels[..., :3], "small.png": pixels[:20]}.items():
        Image.fromarray(np.ascontiguousarray(other)).save(tmp_path / name)
        with pytest.raises(DataError, match=rf"{name}.*wanted 40 × 48 and an alpha channel"):
            data.read([tmp_path / name])


def test_the_density_knows_how_far_off_it_is(data):
    batch = data.splits().test.__getitems__(range(6))
    raw, target = batch["input"].flatten(1), batch["target"]
    fitting = head(data.target, steps=3, restarts=0)
    fitting.fit(raw, target, 0)
    torch.testing.assert_close(fitting.prior[3:6].square().sum(), torch.tensor(0.04, dtype=torch.float64))
    nothing = torch.stack([torch.zeros_like(raw[0]), -raw[0], 2 * raw[0]])
    empty = fitting(nothing)
    assert empty.fits == [None] * 3
    assert torch.equal(empty.mean, torch.zeros_like(empty.mean))
    np.testing.assert_allclose(empty.stddev[0], fitting.prior, rtol=1e-6)
    fitting.calibrate(raw, target)
    density = fitting(raw)
    agrees = torch.tensor([fit.difference <= fitting.enough for fit in density.fits])
    for group in (agrees, ~agrees):
        if group.any():
            off = (density.mean - target)[group].double().square().mean(0).sqrt()
            np.testing.assert_allclose(density.stddev[group][0], off.clamp(min=1e-5), rtol=1e-4)
    wanted = norm.logpdf(target.double(), density.mean.double(), density.stddev.double()).sum(1)
    np.testing.assert_allclose(density.log_prob(target), wanted, rtol=1e-4)
    np.testing.assert_allclose(density.entropy(), norm.entropy(0, density.stddev.double()).sum(1), rtol=1e-4)
    seen = Prediction(density, batch, reads=("color", "mask"))
    assert seen.image("color").shape == seen.true_image("color").shape == (6, 48, 40, 3)
    assert seen.image("mask").shape == seen.true_image("mask").shape
    assert torch.isfinite(seen.image("color")).all()
    drawn_by = (fitting.figure, density.renderer, density.camera)
    there = PoseDensity(target, density.stddev, [None] * 6, *drawn_by)
    shown = Prediction(there, batch, reads=("color", "mask"))
    assert (shown.image("color") - shown.true_image("color")).abs().mean() < 0.01
    other = head(data.target, steps=3, restarts=0)
    other.load_state_dict(fitting.state_dict())
    assert torch.equal(other(raw).log_prob(target), density.log_prob(target))


def test_the_metric_sees_what_arrived(data):
    metric = build("metric", resolve("metric", {"name": "pose_error"}), target=data.target)
    batch = data.splits().test.__getitems__(range(3))
    metric.update(Prediction(head(data.target, steps=1, restarts=0)(batch["input"].flatten(1)), batch))
    found = metric.compute()
    degrees, _ = place_errors(torch.zeros(30), batch["target"][0])
    assert float(degrees) == pytest.approx(30, abs=1e-4)
    assert float(found["rotation_worst_deg"]) >= float(found["rotation_median_deg"])
    assert 0 <= found["found"] <= 1 and len(metric.shown) == 3
    figure = metric.figure("three dolls", synthetic=True)
    assert len(figure.axes) == 15
    metric.reset()
    assert not metric.shown


class Blind(Renderer):
    """Renderer without gradients."""

    bibtex = ""
    channels = frozenset({"color", "face"})

    def __call__(self, scene, channels=("color",)):
        raise NotImplementedError


def test_what_does_not_fit_gets_a_sentence(data):
    from plugins.data.bodies.fit_pose import FitPoseHead

    with pytest.raises(ConfigError, match=r"renderer = Blind has no gradient in.*vertices.*another renderer"):
        FitPoseHead(data.target, renderer=Blind(), **SIZE, **DOLL)
    with pytest.raises(ConfigError, match=r"data's are x, y\. Choose data=pose_from_image"):
        head(Target("real", ("x", "y")))
    with pytest.raises(ConfigError, match="pose_error reads rotation_x"):
        build("metric", resolve("metric", {"name": "pose_error"}), target=Target("real", ("x", "y")))
    with pytest.raises(ValueError, match="row 1"):
        head(data.target)(torch.full((2, 4 * 48 * 40), 0.5).index_fill(0, torch.tensor([1]), torch.nan))


def test_stages_let_go_of_the_usual_pose():
    pulls = [stage.pull for stage in STAGES]
    assert pulls == sorted(pulls, reverse=True)
    assert all(8 % stage.part == 0 for stage in STAGES)


def test_the_metric_draws_densities_that_do_not_say_how_they_were_found(data):
    metric = build("metric", resolve("metric", {"name": "pose_error"}), target=data.target)
    batch = data.splits().test.__getitems__(range(3))
    there = Independent(Normal(batch["target"], torch.full_like(batch["target"], 1e-6)), 1)
    metric.update(Prediction(there, batch))
    assert metric.compute()["found"] == 1
    assert len(metric.figure("found", synthetic=True).axes) == 1
