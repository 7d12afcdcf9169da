"""Residual networks up to their global average pooling."""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from framework.configuration.paths import FilePath
from framework.encoder import Encoder, images_in_unit_range, require_grey_or_color
from framework.storage.weights import fill_from_file

SMALLEST = 32
"""Smallest height and width of an image, pixels; the last layers then see a single pixel."""
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of each channel of ImageNet's images, with which the published weights were trained."""
BLOCKS = {18: (2, 2, 2, 2), 34: (3, 4, 6, 3), 50: (3, 4, 6, 3), 101: (3, 4, 23, 3)}
"""Number of blocks in each of the four stages, by the number of layers (He et al. 2016, table 1)."""
Depth = Literal[18, 34, 50, 101]


class ResNet(Encoder):
    """A residual network for images; its weights are random or from a local weight file.

    The weights have the names and shapes of torchvision's `resnet18`, `resnet34`, `resnet50` and `resnet101`, so that
    their weight files load name by name; the classifier's weights are left out. In blocks of three layers the 3 × 3
    convolution has the stride, as in torchvision. Images are standardised by mean and deviation of ImageNet, as these
    weights require. A single channel is repeated to three.

    Args:
        input_shape: (channels, height, width), 1 or 3 channels, at least 32 × 32 pixels; the published weights were
            trained with 224 × 224.
        depth: number of layers.
        weights: a local file (`framework.storage.weights`), or None to start from random weights.
        frozen: True if the network keeps the weights of the file. Its batch norm then uses the stored mean and
            variance, and features are computed once per sample if the data do not vary the images. Without a file,
            the weights are random numbers of a fixed seed.

    Raises:
        ConfigError: the input is not an image, or too small; or the weight file does not exist.
        CheckpointError: the weights in the file do not fit the network, or the file is damaged.
    """

    initial = frozenset({"weights"})
    bibtex = "he2016deep"
    mean: Tensor
    deviation: Tensor

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        depth: Depth = 18,
        weights: FilePath | None = None,
        frozen: bool = False,
    ) -> None:
        super().__init__()
        require_grey_or_color(input_shape, by="resnet", smallest=SMALLEST)
        self.fixed = frozen
        self.register_buffer("mean", torch.tensor(MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("deviation", torch.tensor(DEVIATION).view(3, 1, 1), persistent=False)
        if frozen:
            with torch.random.fork_rng([]):
                torch.manual_seed(0)
                self._build(depth)
        else:
            self._build(depth)
        if weights is not None:
            fill_from_file(self, weights, ignored=("fc.",))
        if frozen:
            self.eval().requires_grad_(False)

    def _build(self, depth: Depth) -> None:
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.maxpool = nn.MaxPool2d(3, stride=2, padding=1)
        channels = 64
        block = Basic if depth < 50 else Bottleneck
        for stage, count in enumerate(BLOCKS[depth]):
            width, stride = 64 * 2**stage, 1 if stage == 0 else 2
            blocks: list[nn.Module] = []
            for number in range(count):
                blocks.append(block(channels, width, stride if number == 0 else 1))
                channels = block.expansion * width
            self.add_module(f"layer{stage + 1}", nn.Sequential(*blocks))
        self.output_shape = (channels,)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def train(self, mode: bool = True) -> "ResNet":
        """Set training mode, except in a frozen network, whose batch norm always uses the stored numbers."""
        super().train(mode and not self.fixed)
        return self

    def forward(self, inputs: Tensor) -> Float[Tensor, "batch features"]:
        """Return the features of the images."""
        images = images_in_unit_range(inputs, self.conv1.weight.dtype)
        maps = self.maxpool(self.bn1(self.conv1((images - self.mean) / self.deviation)).relu())
        for stage in range(4):
            maps = self.get_submodule(f"layer{stage + 1}")(maps)
        return maps.mean((2, 3))


class Basic(nn.Module):
    """Two 3 × 3 convolutions, added to their input (He et al. 2016, figure 5, left).

    Args:
        channels: number of channels of the input.
        width: number of channels of the output.
        stride: stride of the first convolution; with a stride above 1, or another number of channels, the input is
            projected by a 1 × 1 convolution.
    """

    expansion = 1

    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1 = _conv3(channels, width, stride)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = _conv3(width, width, 1)
        self.bn2 = nn.BatchNorm2d(width)
        self.downsample = _projection(channels, width, stride)

    def forward(self, maps: Float[Tensor, "batch channels height width"]) -> Tensor:
        """Return the maps of the next layer."""
        change = self.bn2(self.conv2(self.bn1(self.conv1(maps)).relu()))
        return (change + (maps if self.downsample is None else self.downsample(maps))).relu()


class Bottleneck(nn.Module):
    """Convolutions of 1 × 1, 3 × 3 and 1 × 1, added to their input (He et al. 2016, figure 5, right).

    Args:
        channels: number of channels of the input.
        width: number of channels of the 3 × 3 convolution; the output has four times as many.
        stride: stride of the 3 × 3 convolution; with a stride above 1, or another number of channels, the input is
            projected by a 1 × 1 convolution.
    """

    expansion = 4

    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = _conv3(width, width, stride)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, 4 * width, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(4 * width)
        self.downsample = _projection(channels, 4 * width, stride)

    def forward(self, maps: Float[Tensor, "batch channels height width"]) -> Tensor:
        """Return the maps of the next layer."""
        change = self.bn1(self.conv1(maps)).relu()
        change = self.bn2(self.conv2(change)).relu()
        change = self.bn3(self.conv3(change))
        return (change + (maps if self.downsample is None else self.downsample(maps))).relu()


def _conv3(channels: int, width: int, stride: int) -> nn.Conv2d:
    return nn.Conv2d(channels, width, 3, stride=stride, padding=1, bias=False)


def _projection(channels: int, width: int, stride: int) -> nn.Sequential | None:
    if stride == 1 and channels == width:
        return None
    return nn.Sequential(nn.Conv2d(channels, width, 1, stride=stride, bias=False), nn.BatchNorm2d(width))
