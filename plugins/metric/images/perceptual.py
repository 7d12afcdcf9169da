"""How far apart two images are in the features of a network that learned to name things (Zhang et al. 2018)."""

from pathlib import Path
from typing import Literal

import torch
import torchmetrics
from jaxtyping import Float
from torch import Tensor, nn

from framework.storage.weights import fill_from_file, read_weights

Backbone = Literal["alex", "vgg"]
TAPS = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}
"""Layers whose outputs are compared: of AlexNet after every convolution, of VGG16 the last of each size."""
LEAST_SIDE = {"alex": 31, "vgg": 16}
"""Pixels of the smallest images of which the last of these layers has an output."""
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""What the authors' scaling layer subtracts from images in [-1, 1], and divides by: ImageNet's mean and deviation."""


class Distance(nn.Module):
    """Eq. 1 of Zhang et al. 2018, with the authors' weights of features, version 0.1, as torchmetrics brings them.

    Args:
        backbone: AlexNet, or VGG16.
        weights: the user's file of the backbone trained on ImageNet, with torchvision's names: of all layers or of the
            features alone; no such file is shipped.

    Raises:
        ConfigError: there is no such file.
        CheckpointError: it cannot be read, or is of another network.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, backbone: Backbone, weights: str) -> None:
        super().__init__()
        self.features = AlexNet() if backbone == "alex" else VGG16()
        self.taps = TAPS[backbone]
        fill_from_file(self.features, weights, ignored=("classifier.",), within="features.")
        bundled = Path(torchmetrics.__file__).parent / "functional/image/lpips_models" / f"{backbone}.pth"
        found = read_weights(str(bundled))
        # the heads weigh squares: they are the squares of the w of eq. 1
        heads = [found[f"lin{number}.model.1.weight"] for number in range(len(self.taps))]
        self.heads = nn.ParameterList(heads)
        self.register_buffer("shift", torch.tensor(SHIFT).view(3, 1, 1))
        self.register_buffer("scale", torch.tensor(SCALE).view(3, 1, 1))
        self.requires_grad_(False).eval()

    def __deepcopy__(self, memo: object) -> "Distance":
        return self  # nobody changes it, and a metric is copied for every group of samples

    def forward(
        self, predicted: Float[Tensor, "batch 3 height width"], true: Float[Tensor, "batch 3 height width"]
    ) -> Float[Tensor, "batch"]:
        """Args:
        predicted, true: in [0, 1] as files hold colours, not light.
        """
        maps = (2 * torch.cat([predicted, true]) - 1 - self.shift) / self.scale
        total = maps.new_zeros(len(predicted))
        heads = iter(self.heads)
        for place, layer in enumerate(self.features):
            maps = layer(maps)
            if place in self.taps:
                one, other = _of_length_one(maps).chunk(2)
                total = total + ((one - other).square() * next(heads)).sum(1).mean((1, 2))
        return total


def _of_length_one(maps: Float[Tensor, "batch channel height width"]) -> Tensor:
    return maps / (maps.norm(dim=1, keepdim=True) + 1e-10)  # where all features are 0 they stay 0


class AlexNet(nn.Sequential):
    """Its convolutions (Krizhevsky 2014), numbered as torchvision's, up to the last layer compared."""

    def __init__(self) -> None:
        super().__init__(
            nn.Conv2d(3, 64, 11, stride=4, padding=2),
            nn.ReLU(),
            nn.MaxPool2d(3, stride=2),
            nn.Conv2d(64, 192, 5, padding=2),
            nn.ReLU(),
            nn.MaxPool2d(3, stride=2),
            nn.Conv2d(192, 384, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(384, 256, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(256, 256, 3, padding=1),
            nn.ReLU(),
        )


class VGG16(nn.Sequential):
    """Likewise of configuration D of Simonyan & Zisserman 2015."""

    def __init__(self) -> None:
        layers: list[nn.Module] = []
        before = 3
        for width, count in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
            if layers:
                layers.append(nn.MaxPool2d(2))
            for _ in range(count):
                layers += [nn.Conv2d(before, width, 3, padding=1), nn.ReLU()]
                before = width
        super().__init__(*layers)
