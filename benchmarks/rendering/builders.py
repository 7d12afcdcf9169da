"""Renderers and encoders from their names and settings, for the benchmarks of images."""

from typing import Any

import torch

from framework.configuration.schema import build, resolve
from framework.encoder import Encoder
from framework.renderer import Renderer


def build_renderer(name: str, **config: Any) -> Renderer:
    """Return a renderer; settings that are not given have their default values."""
    return build("renderer", resolve("renderer", {"name": name, **config}))


def build_encoder(name: str, shape: tuple[int, ...], **config: Any) -> Encoder:
    """Return an encoder for inputs of a shape, with random weights of a fixed seed, in evaluation mode."""
    torch.manual_seed(0)
    return build(
        "encoder", resolve("encoder", {"name": name, **config}), input_shape=shape, input_columns=()
    ).eval()
