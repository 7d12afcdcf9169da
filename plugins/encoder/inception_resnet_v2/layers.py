"""The blocks of Inception-ResNet-v2 (Szegedy et al. 2017), named as weight files name them."""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn


class ConvNorm(nn.Module):
    """A convolution without bias, followed by batch norm and ReLU.

    Args:
        inputs, outputs: numbers of channels.
        kernel: (height, width) of the kernel, or one number if both are equal.
        stride: step of the kernel, pixels.
        padding: "same" keeps height and width; "valid" pads nothing.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: int | tuple[int, int] = 1,
        *,
        stride: int = 1,
        padding: Literal["same", "valid"] = "same",
    ) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, padding, bias=False)
        self.bn = nn.BatchNorm2d(outputs, eps=1e-3)

    def forward(self, inputs: Float[Tensor, "batch planes height width"]) -> Float[Tensor, "batch _ _ _"]:
        """Return the maps after convolution, batch norm and ReLU."""
        return self.bn(self.conv(inputs)).relu_()


class Branches(nn.Module):
    """Parallel layers that read the same input; their outputs are concatenated along the channels."""

    def __init__(self, *branches: nn.Module) -> None:
        super().__init__()
        for number, branch in enumerate(branches):
            self.add_module(f"branch{number}", branch)

    def forward(self, inputs: Float[Tensor, "batch planes height width"]) -> Float[Tensor, "batch _ _ _"]:
        """Return the concatenated outputs of the branches."""
        return torch.cat([branch(inputs) for branch in self.children()], 1)


class Residual(nn.Module):
    """The scaled Inception-ResNet block ReLU(x + scale · conv(branches(x))) of Szegedy et al. 2017.

    Args:
        planes: number of channels of x.
        joined: number of channels of the concatenated outputs of the branches.
        branches: the branches.
        scale: factor of the block's output before it is added to x.
        relu: whether the sum is rectified; the last block of the network does not rectify its sum.
    """

    def __init__(
        self, planes: int, joined: int, *branches: nn.Module, scale: float, relu: bool = True
    ) -> None:
        super().__init__()
        self.count, self.scale, self.relu = len(branches), scale, relu
        for number, branch in enumerate(branches):
            self.add_module(f"branch{number}", branch)
        self.conv2d = nn.Conv2d(joined, planes, kernel_size=1)

    def forward(
        self, inputs: Float[Tensor, "batch planes height width"]
    ) -> Float[Tensor, "batch planes height width"]:
        """Return the maps after the residual block."""
        joined = torch.cat([self.get_submodule(f"branch{number}")(inputs) for number in range(self.count)], 1)
        total = torch.add(inputs, self.conv2d(joined), alpha=self.scale)
        return total.relu_() if self.relu else total


def mixed_5b() -> Branches:
    """Return the block Mixed 5b, from 192 to 320 channels."""
    return Branches(
        ConvNorm(192, 96),
        nn.Sequential(ConvNorm(192, 48), ConvNorm(48, 64, 5)),
        nn.Sequential(ConvNorm(192, 64), ConvNorm(64, 96, 3), ConvNorm(96, 96, 3)),
        # the mean excludes padding, as in the TensorFlow code with which the published weights were trained
        nn.Sequential(nn.AvgPool2d(3, stride=1, padding=1, count_include_pad=False), ConvNorm(192, 64)),
    )


def block35() -> Residual:
    """Return a residual block for 320 channels."""
    return Residual(
        320,
        128,
        ConvNorm(320, 32),
        nn.Sequential(ConvNorm(320, 32), ConvNorm(32, 32, 3)),
        nn.Sequential(ConvNorm(320, 32), ConvNorm(32, 48, 3), ConvNorm(48, 64, 3)),
        scale=0.17,
    )


def mixed_6a() -> Branches:
    """Return the reduction Mixed 6a, from 320 to 1088 channels and half the size."""
    return Branches(
        ConvNorm(320, 384, 3, stride=2, padding="valid"),
        nn.Sequential(
            ConvNorm(320, 256), ConvNorm(256, 256, 3), ConvNorm(256, 384, 3, stride=2, padding="valid")
        ),
        nn.MaxPool2d(3, stride=2),
    )


def block17() -> Residual:
    """Return a residual block for 1088 channels."""
    return Residual(
        1088,
        384,
        ConvNorm(1088, 192),
        nn.Sequential(ConvNorm(1088, 128), ConvNorm(128, 160, (1, 7)), ConvNorm(160, 192, (7, 1))),
        scale=0.10,
    )


def mixed_7a() -> Branches:
    """Return the reduction Mixed 7a, from 1088 to 2080 channels and half the size."""
    return Branches(
        nn.Sequential(ConvNorm(1088, 256), ConvNorm(256, 384, 3, stride=2, padding="valid")),
        nn.Sequential(ConvNorm(1088, 256), ConvNorm(256, 288, 3, stride=2, padding="valid")),
        nn.Sequential(
            ConvNorm(1088, 256), ConvNorm(256, 288, 3), ConvNorm(288, 320, 3, stride=2, padding="valid")
        ),
        nn.MaxPool2d(3, stride=2),
    )


def block8(*, scale: float = 0.20, relu: bool = True) -> Residual:
    """Return a residual block for 2080 channels.

    `scale` multiplies the output of the branches before it is added to the input; `relu` says whether the sum is
    rectified.
    """
    return Residual(
        2080,
        448,
        ConvNorm(2080, 192),
        nn.Sequential(ConvNorm(2080, 192), ConvNorm(192, 224, (1, 3)), ConvNorm(224, 256, (3, 1))),
        scale=scale,
        relu=relu,
    )
