import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from framework.bodies.parametric import parametric_body
from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from framework.heads.posed_body import PosedBodyDensity, scene_of
from framework.prediction import Prediction
from framework.renderer import Renderer
from framework.target import Target
from framework.testing.bodies import DOLL, random_parameters
from plugins.density_head.fit_pose.descent import (
    STAGES,
    Descent,
    Stage,
    blur,
    reduce_camera,
    reduce_image,
    update_hessian,
)

SIZE = {"height": 48, "width": 40}
FINE = {"name": "rasterizer", "supersampling": 4}


def renderer(**config):
    return build("renderer", resolve("renderer", {**FINE, **config}))


@pytest.fixture(scope="module")
def body_model():
    return parametric_body(DOLL["body"])


def head(target, **config):
    config = {"name": "fit_pose", "renderer": FINE, **SIZE, **DOLL, **config}
    return build("density_head", resolve("density_head", config), target=target).eval()


def test_a_smaller_picture_is_the_mean_of_the_pixels(body_model):
    """Compare means of 4 × 4 pixels with the pixels of an image of a quarter of the side that has the same samples."""
    camera, fine = body_model.camera(**SIZE), renderer(supersampling=8)
    whole = renderer(supersampling=2)(scene_of(body_model, random_parameters(body_model), camera))["color"]
    rendered = fine(scene_of(body_model, random_parameters(body_model), reduce_camera(camera, 4)))["color"]
    torch.testing.assert_close(rendered, reduce_image(whole, 4), atol=1e-5, rtol=0)


@pytest.mark.parametrize("deviation", [0.7, 1.0, 2.0])
def test_blur_is_a_gaussian(deviation):
    picture = torch.rand(20, 12, 3)
    wanted = gaussian_filter(
        picture.double().numpy(),
        (deviation, deviation, 0),
        mode="constant",
        radius=(*2 * [round(3 * deviation)], 0),
    )
    np.testing.assert_allclose(blur(picture, deviation).numpy(), wanted, atol=1e-6)


def test_the_gradient_is_that_of_the_loss(body_model):
    """Compare with central differences of a loss drawn with 16 x 16 samples a pixel, and check the curvature."""
    camera, stage = body_model.camera(**SIZE), Stage(2, 1.0, 0.1)
    at, fine = random_parameters(body_model, 1, 0.5), renderer(supersampling=16)
    aim = fine(scene_of(body_model, at + 0.05 * random_parameters(body_model, 2), camera))["color"]
    descents = [
        Descent(body_model, drawing, camera, steps=1, restarts=0, enough=1e-3)
        for drawing in (renderer(), fine)
    ]
    aims = blur(reduce_image(aim, stage.part), stage.blur)
    view = reduce_camera(camera, stage.part)
    _, slope = descents[0]._loss(at, stage, view, aims)
    wanted = torch.zeros_like(at)
    for column, step in enumerate(body_model.spread * 0.1):
        aside = torch.zeros_like(at)
        aside[column] = step if column >= 6 else 0.02
        ends = [descents[1]._loss(at + sign * aside, stage, view, aims)[0] for sign in (1, -1)]
        wanted[column] = (ends[0] - ends[1]) / (2 * aside[column])
    cosine = torch.nn.functional.cosine_similarity(
        slope * body_model.spread, wanted * body_model.spread, dim=0
    )
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
    hessian = torch.eye(5, dtype=torch.float64)
    for direction in torch.linalg.eigh(wanted).eigenvectors.T:
        hessian = update_hessian(hessian, direction, wanted @ direction)
    torch.testing.assert_close(hessian, wanted)
    for _ in range(20):
        hessian = update_hessian(hessian, *torch.from_numpy(random.normal(0, 1, (2, 5))))
        assert torch.linalg.eigvalsh(hessian).min() > 0


def place_errors(parameters, wanted):
    """Return the degrees between two rotations and the centimetres between two translations."""
    turns = Rotation.from_rotvec(parameters[:3].numpy()).inv() * Rotation.from_rotvec(wanted[:3].numpy())
    return np.degrees(turns.magnitude()), 100 * float((parameters[3:6] - wanted[3:6]).norm())


@pytest.mark.slow
@pytest.mark.parametrize("gradient", ["boundary", "nmr", "soft"])
def test_a_small_offset_is_found_again(body_model, gradient):
    """Check that every gradient halves the error, and that the exact one explains the image as the true parameters do.

    In 48 × 40 pixels the body's own turn hides a rotation of a degree, so that the true parameters are not the only
    ones that explain the image.
    """
    camera = body_model.camera(**SIZE)
    wanted = torch.zeros(len(body_model.names), dtype=torch.float64)
    wanted[:6] = torch.tensor([0.05, 0.15, -0.1, 0.05, -0.04, 0.06])
    picture = renderer(supersampling=8)(scene_of(body_model, wanted, camera))["color"]
    drawing = renderer(gradient=gradient)
    descent = Descent(body_model, drawing, camera, steps=20, restarts=0, enough=1e-3)
    fit = descent(picture)
    degrees, centimetres = place_errors(fit.parameters, wanted)
    start = place_errors(wanted * 0, wanted)
    assert degrees < start[0] / 2 and centimetres < start[1] / 2
    if gradient == "boundary":
        assert centimetres < 1
        last = STAGES[-1]
        loss = descent._loss(wanted, last, camera, blur(picture, last.blur))[0]
        assert fit.difference < 1.1 * (loss / picture.numel()) ** 0.5
    assert fit.path.shape[1] == 2 + len(body_model.names) and fit.path.isfinite().all()
    assert torch.equal(descent(picture).parameters, fit.parameters)


@pytest.mark.slow
def test_the_density_knows_how_far_off_it_is(doll_images):
    batch = doll_images.splits().test.__getitems__(range(6))
    raw, target = batch["input"].flatten(1), batch["target"]
    fitting = head(doll_images.target, steps=3, restarts=0)
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
    prediction = Prediction(density, batch, reads=("color", "mask"))
    assert prediction.image("color").shape == prediction.true_image("color").shape == (6, 48, 40, 3)
    assert prediction.image("mask").shape == prediction.true_image("mask").shape
    assert torch.isfinite(prediction.image("color")).all()
    drawn_by = (fitting.body_model, density.renderer, density.camera)
    true_density = PosedBodyDensity(target, density.stddev, [None] * 6, *drawn_by)
    shown = Prediction(true_density, batch, reads=("color", "mask"))
    assert (shown.image("color") - shown.true_image("color")).abs().mean() < 0.01
    other = head(doll_images.target, steps=3, restarts=0)
    other.load_state_dict(fitting.state_dict())
    assert torch.equal(other(raw).log_prob(target), density.log_prob(target))


class Blind(Renderer):
    """Renderer without gradients."""

    bibtex = ""
    channels = frozenset({"color", "face"})

    def __call__(self, scene, channels=("color",)):
        raise NotImplementedError


def test_what_does_not_fit_gets_a_sentence(doll_images):
    from plugins.density_head.fit_pose.head import FitPoseHead

    with pytest.raises(ConfigError, match=r"renderer=Blind lacks vertices.*another renderer"):
        FitPoseHead(doll_images.target, renderer=Blind(), **SIZE, **DOLL)
    with pytest.raises(ConfigError, match=r"this data set are x, y\. Choose data=pose_from_image"):
        head(Target("real", ("x", "y")))
    with pytest.raises(ValueError, match="row 1"):
        head(doll_images.target)(
            torch.full((2, 4 * 48 * 40), 0.5).index_fill(0, torch.tensor([1]), torch.nan)
        )


def test_stages_let_go_of_the_usual_pose():
    pulls = [stage.pull for stage in STAGES]
    assert pulls == sorted(pulls, reverse=True)
    assert all(8 % stage.part == 0 for stage in STAGES)
