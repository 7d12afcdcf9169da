"""Distance of two images in the feature space of an image classification network (Zhang et al. 2018)."""

from pathlib import Path
from typing import Literal

import torch
import torchmetrics
from jaxtyping import Float
from torch import Tensor, nn

from framework.storage.weights import fill_from_file, read_weights

Backbone = Literal["alex", "vgg"]
TAPS = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}
"""Indices of the compared layers: in AlexNet after each convolution, in VGG16 the last layer of each size."""
LEAST_SIDE = {"alex": 31, "vgg": 16}
"""Smallest side, pixels, of images for which the last compared layer has an output."""
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Mean and standard deviation of ImageNet for images in [-1, 1], by which the authors' scaling layer normalises."""


class Distance(nn.Module):
    """LPIPS distance (Zhang et al. 2018, eq. 1) with the authors' weights, version 0.1, which are part of torchmetrics.

    Args:
        backbone: AlexNet, or VGG16.
        weights: file of the backbone trained on ImageNet, with torchvision's names, of all layers or only the features;
            the user must provide this file.

    Raises:
        ConfigError: the file does not exist.
        CheckpointError: the file cannot be read, or belongs to another network.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, backbone: Backbone, weights: str) -> None:
        super().__init__()
        self.features = AlexNet() if backbone == "alex" else VGG16()
        self.taps = TAPS[backbone]
        fill_from_file(self.features, weights, ignored=("classifier.",), within="features.")
        bundled = Path(torchmetrics.__file__).parent / "functional/image/lpips_models" / f"{backbone}.pth"
        bundled_weights = read_weights(str(bundled))
        # these weights multiply squares, so they are the squares of w in eq. 1
        heads = [bundled_weights[f"lin{number}.model.1.weight"] for number in range(len(self.taps))]
        self.heads = nn.ParameterList(heads)
        self.register_buffer("shift", torch.tensor(SHIFT).view(3, 1, 1))
        self.register_buffer("scale", torch.tensor(SCALE).view(3, 1, 1))
        self.requires_grad_(False).eval()

    def __deepcopy__(self, memo: object) -> "Distance":
        return self  # the weights never change, and a metric is copied for every group of samples

    def forward(
        self, predicted: Float[Tensor, "batch 3 height width"], true: Float[Tensor, "batch 3 height width"]
    ) -> Float[Tensor, "batch"]:
        """Return the distance of each pair of images.

        Args:
            predicted: sRGB colours in [0, 1].
            true: sRGB colours of the true images.
        """
        maps = (2 * torch.cat([predicted, true]) - 1 - self.shift) / self.scale
        total = maps.new_zeros(len(predicted))
        heads = iter(self.heads)
        for index, layer in enumerate(self.features):
            maps = layer(maps)
            if index in self.taps:
                predicted_features, true_features = _normalise_channels(maps).chunk(2)
                total = total + ((predicted_features - true_features).square() * next(heads)).sum(1).mean(
                    (1, 2)
                )
        return total


def _normalise_channels(maps: Float[Tensor, "batch channel height width"]) -> Tensor:
    return maps / (maps.norm(dim=1, keepdim=True) + 1e-10)  # a zero vector stays zero


class AlexNet(nn.Sequential):
    """Convolutions of AlexNet (Krizhevsky 2014) up to the last compared layer, numbered as in torchvision."""

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
    """Convolutions of VGG configuration D (Simonyan & Zisserman 2015), numbered as in torchvision."""

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
