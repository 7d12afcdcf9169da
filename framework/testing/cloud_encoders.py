"""Checks of encoders of point clouds, beside those of any encoder."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from framework.encoder import Encoder
from framework.errors import ConfigError, DataError
from framework.geometry.clouds import pad
from framework.testing.finding import SEED, Worst

Make = Callable[[], Encoder]
NO_CLOUDS = ((7,), (3, 32, 32), (100, 2))


def different_clouds(points: int, columns: int) -> list[Tensor]:
    """Return clouds (points, columns) off the origin, of different sizes where there is more than one point."""
    generator = torch.Generator().manual_seed(SEED)
    sizes = (points, 1, -(-points // 3), -(-points // 2))
    return [4 * torch.randn(size, columns, generator=generator) + 7 for size in sizes]


def padding(make: Make, clouds: list[Tensor], worst: Worst) -> None:
    """Check that rows of NaN at the end change no feature, with and without a gradient."""
    encoder = make()
    batch = pad([*clouds, clouds[0].new_zeros(len(clouds[0]) + 5, clouds[0].shape[1])])
    with torch.no_grad():
        found = encoder(batch)
    for index, cloud in enumerate(clouds):
        alone = encoder(cloud[None])[0].detach()
        scale = alone.abs().amax().clamp(min=1e-6)
        worst.see((found[index] - alone).abs().max() / scale, f"cloud of {len(cloud)} points, padded")


def any_order(make: Make, clouds: list[Tensor], worst: Worst) -> None:
    """Check that the order of the points changes no feature."""
    encoder = make()
    generator = torch.Generator().manual_seed(SEED)
    with torch.no_grad():
        for cloud in clouds:
            first = encoder(cloud[None])
            turned = encoder(cloud[torch.randperm(len(cloud), generator=generator)][None])
            scale = first.abs().amax().clamp(min=1e-6)
            worst.see((first - turned).abs().max() / scale, f"{len(cloud)} points in another order")


def gradients_of_padding(make: Make, clouds: list[Tensor], worst: Worst) -> None:
    """Check that gradients are finite and 0 in the padding; an encoder may have no gradient."""
    encoder = make().double()
    batch = pad([cloud.double() for cloud in clouds]).requires_grad_()
    found = encoder(batch)
    worst.count(False, "no gradient flows")
    if not found.requires_grad:
        return
    (gradient,) = torch.autograd.grad(found.square().sum(), batch)
    for index, cloud in enumerate(clouds):
        worst.finite(f"gradient of a cloud of {len(cloud)} points", gradient[index, : len(cloud)])
        worst.count(gradient[index, len(cloud) :] != 0, f"gradient of the padding of {len(cloud)} points")


def bad_clouds(make: Make, clouds: list[Tensor], worst: Worst) -> None:
    """Check that a non-finite number or a cloud without points raises an error that names the cloud and the point."""
    encoder, largest = make(), clouds[0]
    last = len(largest) - 1
    for column in (0, 2):
        for number in (math.inf, -math.inf, math.nan):
            bad = torch.stack([largest, largest])
            bad[1, last, column] = number
            _refused(encoder, bad, ("Cloud 1", f"column {column} of its point {last}"), worst)
    _refused(encoder, torch.stack([largest, largest * math.nan]), ("Cloud 1", "no point"), worst)


def _refused(encoder: Encoder, clouds: Tensor, wanted: tuple[str, ...], worst: Worst) -> None:
    try:
        with torch.no_grad():
            encoder(clouds)
    except DataError as error:
        missing = [words for words in wanted if words not in str(error)]
        worst.count(
            bool(missing), f"an error that does not say {missing}: {error}" if missing else str(error)
        )
    else:
        worst.count(True, f"taken without a word, where the error should say {', '.join(wanted)}")


def other_shapes(build: Callable[[tuple[int, ...]], Encoder], worst: Worst) -> None:
    """Check that input shapes that are no clouds are refused at construction, with a message that names the shape."""
    for shape in NO_CLOUDS:
        try:
            build(shape)
        except ConfigError as error:
            told = f"inputs of shape {shape}" in str(error) and "wanted clouds" in str(error)
            worst.count(not told, f"an error that does not speak of {shape} or of clouds: {error}")
        else:
            worst.count(True, f"inputs of shape {shape} are accepted")
