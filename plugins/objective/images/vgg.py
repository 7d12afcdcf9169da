"""The convolutional part of VGG networks, with weights from torchvision's files or drawn from a seed."""

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import conv2d, max_pool2d, relu

from framework.errors import ConfigError
from framework.storage.weights import read_weights

Depth = Literal[16, 19]
CONVOLUTIONS: dict[Depth, tuple[int, ...]] = {16: (2, 2, 3, 3, 3), 19: (2, 2, 4, 4, 4)}
"""Number of convolutions of each block, between poolings (Simonyan & Zisserman 2015, table 1, columns D and E)."""
WIDTHS = (64, 128, 256, 512, 512)
"""Number of channels of each block."""
TAPS: dict[Depth, tuple[tuple[int, int], ...]] = {
    16: ((0, 1), (1, 1), (2, 2), (3, 2)),
    19: ((0, 0), (1, 0), (2, 0), (3, 0), (4, 0)),
}
"""Convolutions whose outputs are features, as block and convolution, counted from 0.

In the network of 16 layers they are relu1_2, relu2_2, relu3_3 and relu4_3 (Johnson et al. 2016). In the network of 19
layers they are relu1_1, relu2_1, relu3_1, relu4_1 and relu5_1 (Wang et al. 2018).
"""
MEAN, SPREAD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of red, green and blue over ImageNet; torchvision's weights expect normalised images."""


class VGG(nn.Module):
    """Part of a VGG network that returns features after some of its convolutions; its weights are not trained.

    Args:
        depth: number of layers of the whole network, 16 or 19; only the convolutions up to the last tap are used.
        widths: channels of each block.
        taps: convolutions whose outputs are features, ascending.
    """

    def __init__(self, depth: Depth, widths: Sequence[int], taps: Sequence[tuple[int, int]]) -> None:
        super().__init__()
        self.layers = layers_of(depth, taps[-1])
        self.taps = tuple(taps)
        channels = 3
        for block, place, _ in self.layers:
            shape = (widths[block], channels, 3, 3)
            # not stored in a checkpoint, since the weights come from a file or from a seed
            self.register_buffer(f"weight_{block}_{place}", torch.zeros(shape), persistent=False)
            self.register_buffer(f"bias_{block}_{place}", torch.zeros(widths[block]), persistent=False)
            channels = widths[block]

    def forward(self, images: Float[Tensor, "image 3 height width"]) -> list[Tensor]:
        """Return the features (image, channel, height, width) of sRGB images after each convolution in `taps`."""
        mean, spread = (images.new_tensor(values)[:, None, None] for values in (MEAN, SPREAD))
        hidden, features, block_before = (images - mean) / spread, [], 0
        for block, place, _ in self.layers:
            if block != block_before:
                hidden, block_before = max_pool2d(hidden, 2), block
            weight, bias = (
                getattr(self, f"{name}_{block}_{place}").to(images.dtype) for name in ("weight", "bias")
            )
            hidden = relu(conv2d(hidden, weight, bias, padding=1))
            if (block, place) in self.taps:
                features.append(hidden)
        return features

    @property
    def least_side(self) -> int:
        """Smallest side of an image, pixels, that is large enough for all pooling layers before the last features."""
        return 2 ** self.taps[-1][0]


def layers_of(depth: Depth, last: tuple[int, int]) -> list[tuple[int, int, int]]:
    """Return all convolutions up to `last`, in order, with their indices in torchvision's files.

    Each convolution is a triple: block, number of the convolution in the block, and index in torchvision's `features`.
    `last` holds the block, and the number in the block, of the last convolution whose output is a feature.
    """
    layers, index = [], 0
    for block, count in enumerate(CONVOLUTIONS[depth]):
        for place in range(count):
            layers.append((block, place, index))
            index += 2  # the convolution and its ReLU
            if (block, place) == last:
                return layers
        index += 1  # the pooling
    return layers


def read_vgg(depth: Depth, file: str) -> VGG:
    """Return a VGG network with the weights of torchvision's file of the whole network, or of its `features` alone.

    Raises:
        ConfigError: the file does not exist, or holds the weights of another network.
        CheckpointError: the file is damaged.
    """
    network = VGG(depth, WIDTHS, TAPS[depth])
    stored = read_weights(file)
    for block, place, index in network.layers:
        for name in ("weight", "bias"):
            own = getattr(network, f"{name}_{block}_{place}")
            key = f"features.{index}.{name}"
            tensor = stored.get(key, stored.get(key.removeprefix("features.")))
            if tensor is None or tensor.shape != own.shape:
                state = "missing" if tensor is None else f"of shape {tuple(tensor.shape)}"
                raise ConfigError(
                    f"{file}: the entry {key} is {state}; expected a tensor of shape {tuple(own.shape)}. Set "
                    f"objective.perceptual.weights to torchvision's weights of VGG{depth}, such as vgg{depth}-….pth."
                )
            own.copy_(tensor)
    return network


def random_vgg(depth: Depth, width: int, taps: Sequence[tuple[int, int]], seed: int) -> VGG:
    """Return a VGG network with random weights, which preserve the scale of the features from layer to layer.

    The variance of the weights follows He et al. 2015, eq. 10.

    Args:
        depth: number of layers of the whole network, 16 or 19.
        width: channels of the first block; the channels of further blocks are in the same proportion as in VGG.
        taps: convolutions whose outputs are features, ascending.
        seed: seed of the weights.
    """
    network = VGG(depth, [width * channels // WIDTHS[0] for channels in WIDTHS], taps)
    generator = torch.Generator().manual_seed(seed)
    for block, place, _ in network.layers:
        weight = getattr(network, f"weight_{block}_{place}")
        weight.normal_(0, (2 / weight[0].numel()) ** 0.5, generator=generator)
    return network
