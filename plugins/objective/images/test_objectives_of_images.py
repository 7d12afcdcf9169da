"""Tests of losses of images beyond their contract: formulas, weight files, caches, and trained parameters."""

import copy
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from torch.distributions import Independent, Normal
from torch.nn.functional import mse_loss

from framework.configuration.schema import build, resolve
from framework.errors import CheckpointError, ConfigError
from framework.model import Model, Predictor, one_pass
from framework.target import Target
from framework.uncertainty import own_batches
from plugins.objective.images.patch_gan import PatchGAN
from plugins.objective.images.perceptual import Perceptual, RandomFeatures
from plugins.objective.images.squared_error import SquaredError
from plugins.objective.images.vgg import CONVOLUTIONS, TAPS, WIDTHS, Depth, layers_of


class PredictorOf(Predictor):
    """A predictor that returns the images it was constructed with."""

    def __init__(self, images: Tensor) -> None:
        super().__init__()
        self.images = nn.Parameter(images)

    def forward(self, inputs):
        return Independent(Normal(self.images[inputs], 1.0, validate_args=False), 3)

    def training_densities(self, inputs):
        return self(inputs)

    def loss(self, inputs, target):
        return -self(inputs).log_prob(target)

    def calibrate(self, batches):
        pass


def pair(*size: int) -> tuple[PredictorOf, dict[str, Tensor]]:
    torch.manual_seed(1)
    predictor = PredictorOf(torch.rand(3, *size, 3))
    return predictor, {"input": torch.arange(3), "target": torch.rand(3, *size, 3)}


IMAGES = Target("image", ("red", "green", "blue"), size=(16, 16))


def painter() -> Model:
    config = {"name": "slim", "widths": [4, 6], "normalisation": "group", "crop": None}
    encoder = build("encoder", resolve("encoder", config), input_shape=(3, 16, 16))
    return Model([encoder], build("density_head", resolve("density_head", "laplace_image"), target=IMAGES))


@pytest.mark.parametrize("wrapped", [False, True], ids=["ensemble", "temperature of an ensemble"])
@pytest.mark.parametrize(
    "make",
    [SquaredError, lambda: RandomFeatures(width=4), lambda: PatchGAN(width=4, layers=1, scales=1)],
    ids=["squared error", "random features", "discriminators"],
)
def test_each_member_of_an_ensemble_is_judged_by_the_images_of_its_own_rows(make, wrapped: bool) -> None:
    """Compare value and gradients with those of models alone, each of which draws its own rows once."""
    torch.manual_seed(0)
    alone = [painter() for _ in range(3)]
    copies = iter(copy.deepcopy(alone))
    ensemble = resolve("uncertainty", {"name": "ensemble", "members": 3})
    whole = build("uncertainty", ensemble, model=lambda: next(copies), target=IMAGES)
    members = [module for module in whole.modules() if isinstance(module, Model)]
    if wrapped:
        inner = whole
        whole = build(
            "uncertainty", resolve("uncertainty", "temperature"), model=lambda: inner, target=IMAGES
        )
    painted: list[int] = []
    for member in members:
        member.encoders[0].register_forward_hook(lambda module, inputs, output: painted.append(len(output)))
    inputs, target = torch.rand(6, 3, 16, 16), torch.rand(6, 16, 16, 3)
    objective = make()
    with own_batches(whole), one_pass(whole):
        whole.loss(inputs, target)
        penalty = objective(whole, {"input": inputs, "target": target})
    penalty.backward()
    assert painted == [2, 2, 2]
    separate = [
        objective(model, {"input": rows, "target": true})
        for model, rows, true in zip(alone, inputs.chunk(3), target.chunk(3), strict=True)
    ]
    torch.testing.assert_close(penalty, torch.stack(separate).mean())
    sum(separate).backward()
    for mine, theirs in zip(members, alone, strict=True):
        for ours, wanted in zip(mine.parameters(), theirs.parameters(), strict=True):
            torch.testing.assert_close(ours.grad, wanted.grad, rtol=1e-4, atol=1e-7)
    together = objective(whole, {"input": inputs, "target": target})
    penalties = torch.stack([objective(model, {"input": inputs, "target": target}) for model in alone])
    torch.testing.assert_close(together, penalties.mean(), msg="all see all rows where none has its own")


def torchvision(depth: Depth) -> nn.Sequential:
    """Return the features as torchvision documents them: convolution, ReLU, and pooling after each block."""
    torch.manual_seed(depth)
    layers: list[nn.Module] = []
    channels = 3
    for count, width in zip(CONVOLUTIONS[depth], WIDTHS, strict=True):
        for _ in range(count):
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
        layers.append(nn.MaxPool2d(2, 2))
    return nn.Sequential(*layers)


@pytest.mark.parametrize(
    ("depth", "last", "part"), [(16, 22, ""), (16, 22, "features."), (19, 29, "features.")]
)
def test_features_are_those_of_torchvisions_layout(
    tmp_path: Path, depth: Depth, last: int, part: str
) -> None:
    network = torchvision(depth)
    file = tmp_path / "vgg.pth"
    stored = {f"{part}{name}": tensor for name, tensor in network.state_dict().items()}
    torch.save({**stored, "classifier.0.weight": torch.zeros(2, 2)}, file)
    predictor, batch = pair(32, 32)
    objective = Perceptual(weight=2.0, weights=str(file), layers=depth)
    penalty = objective(predictor, batch)

    def features(images: Tensor) -> list[Tensor]:
        hidden = (images.movedim(-1, 1) - torch.tensor([0.485, 0.456, 0.406])[:, None, None]) / torch.tensor(
            [0.229, 0.224, 0.225]
        )[:, None, None]
        outputs = []
        for layer in network:
            hidden = layer(hidden)
            outputs.append(hidden)
        places = {16: (3, 8, 15, 22), 19: (1, 6, 11, 20, 29)}[depth]
        return [outputs[place] for place in places]

    with torch.no_grad():
        pairs = list(zip(features(predictor.images), features(batch["target"]), strict=True))
        wanted = sum(
            2.0 ** (level + 1 - len(pairs)) * (a - b).abs().mean() for level, (a, b) in enumerate(pairs)
        )
    torch.testing.assert_close(penalty, 2 * wanted)
    assert layers_of(depth, TAPS[depth][-1])[-1][2] == last - 1
    assert objective.logged_terms["perceptual"] == penalty / 2
    assert not list(objective.state_dict())


def test_other_weights_are_refused(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"weights is null, but torchvision's file of VGG16.*random_features"
    ):
        Perceptual()
    with pytest.raises(ConfigError, match=r"The weight file .*gone\.pth does not exist"):
        Perceptual(weights=str(tmp_path / "gone.pth"))
    (tmp_path / "bad.pth").write_bytes(b"PK\3\4 nonsense")
    with pytest.raises(CheckpointError, match=r"bad\.pth"):
        Perceptual(weights=str(tmp_path / "bad.pth"))
    torch.save(torchvision(16).state_dict(), tmp_path / "vgg16.pth")
    with pytest.raises(ConfigError, match=r"features\.\d+\.weight is (missing|of shape).*VGG19"):
        Perceptual(weights=str(tmp_path / "vgg16.pth"), layers=19)


def test_what_is_kept_changes_no_number_and_stays_within_its_bound() -> None:
    predictor, batch = pair(24, 20)
    plain, keeping = RandomFeatures(width=4, cache=0), RandomFeatures(width=4, cache=1)
    calls: list[int] = []
    keeping.network.register_forward_hook(lambda module, arguments, output: calls.append(len(arguments[0])))
    for number in range(4):
        torch.testing.assert_close(keeping(predictor, batch), plain(predictor, batch))
        if number == 2:  # another image under the same number is another image
            batch["target"][1] = 0.5
    assert calls == [3, 3, 3, 3, 3, 1]
    assert 0 < keeping.cached_bytes <= 2**20
    tiny = RandomFeatures(width=64, cache=1)
    predictor, batch = pair(64, 64)
    for _ in range(2):
        tiny(predictor, batch)
    assert tiny.cached_bytes <= 2**20


def test_random_features_are_a_function_of_their_seed_and_keep_their_size() -> None:
    predictor, batch = pair(48, 48)
    first, same, other = (RandomFeatures(seed=seed)(predictor, batch) for seed in (0, 0, 1))
    assert first == same != other
    features = RandomFeatures().network(batch["target"].movedim(-1, 1))
    assert all(0.2 < level.std() < 3 for level in features)


def test_the_discriminators_learn_against_the_predictor() -> None:
    predictor, batch = pair(40, 36)
    objective = PatchGAN(weight=3.0, feature_matching=0.25, width=8)
    penalty = objective(predictor, batch)
    penalty.backward()
    terms = objective.logged_terms
    torch.testing.assert_close(penalty, 3 * (terms["generator"] + 0.25 * terms["feature_matching"]))
    judge = objective.discriminators
    ours = {
        name: parameter.grad.clone()
        for name, parameter in judge.named_parameters()
        if parameter.grad is not None
    }
    images = predictor.images.grad
    assert images is not None
    slope = images.clone()

    def judged(images: Tensor) -> list[list[Tensor]]:
        return judge(images.movedim(-1, 1))

    judge.zero_grad()
    false, true = judged(predictor.images.detach()), judged(batch["target"])
    own = (
        sum(
            (1 - t[-1]).square().mean() / 2 + f[-1].square().mean() / 2
            for f, t in zip(false, true, strict=True)
        )
        / 2
    )
    torch.testing.assert_close(terms["discriminator"], own.detach())
    (3 * own).backward()
    for name, parameter in judge.named_parameters():
        assert parameter.grad is not None
        torch.testing.assert_close(ours[name], parameter.grad)

    predictor.zero_grad()
    false = judged(predictor.images)
    true = [[layer.detach() for layer in scale] for scale in true]
    fooled = sum((1 - f[-1]).square().mean() for f in false) / 2
    alike = torch.stack(
        [
            (a - b).abs().mean()
            for f, t in zip(false, true, strict=True)
            for a, b in zip(f[:-1], t[:-1], strict=True)
        ]
    ).mean()
    torch.testing.assert_close(terms["generator"], fooled.detach())
    torch.testing.assert_close(terms["feature_matching"], alike.detach())
    (3 * (fooled + 0.25 * alike)).backward()
    assert predictor.images.grad is not None
    torch.testing.assert_close(slope, predictor.images.grad)


def test_targets_that_are_no_images_are_refused() -> None:
    predictor = PredictorOf(torch.rand(3, 4, 4, 2))
    with pytest.raises(ConfigError, match=r"images of three colours.*\(4, 4, 2\)"):
        RandomFeatures()(predictor, {"input": torch.arange(3), "target": torch.rand(3, 4, 4, 2)})


def test_the_squared_error_is_torchs_and_each_member_has_its_own() -> None:
    predictor, batch = pair(6, 5)
    objective = SquaredError(weight=3.0)
    wanted = mse_loss(predictor.images, batch["target"])
    torch.testing.assert_close(objective(predictor, batch), 3 * wanted)
    torch.testing.assert_close(objective.logged_terms["squared_error"], wanted.detach())
    members = PredictorOf(torch.rand(3, 2, 6, 5, 3))
    penalty = objective(members, batch)
    slope = torch.autograd.grad(penalty, members.images)[0]
    for member in range(2):
        alone = PredictorOf(members.images[:, member].detach().clone())
        own = torch.autograd.grad(objective(alone, batch), alone.images)[0]
        torch.testing.assert_close(slope[:, member], own)
    empty = {name: values[:0] for name, values in batch.items()}
    assert objective(PredictorOf(torch.rand(0, 6, 5, 3)), empty).item() == 0
