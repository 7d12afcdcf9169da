"""Additional checks of encoders of point clouds.

The argument `make` of a check is a function that returns a new encoder. `clouds` are point clouds (points, columns)
that the encoder can read. Errors are recorded in `worst` (`framework.testing.finding.Worst`), which keeps the largest.
"""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from framework.encoder import Encoder
from framework.errors import ConfigError, DataError
from framework.geometry.clouds import pad
from framework.testing.finding import SEED, Worst

Make = Callable[[], Encoder]
NO_CLOUDS = ((7,), (3, 32, 32), (100, 2))
"""Input shapes that are not shapes of clouds; an encoder of clouds must refuse them."""


def different_clouds(points: int, columns: int) -> list[Tensor]:
    """Return four clouds away from the origin, (size, columns), with sizes from 1 to `points`."""
    generator = torch.Generator().manual_seed(SEED)
    sizes = (points, 1, -(-points // 3), -(-points // 2))
    return [4 * torch.randn(size, columns, generator=generator) + 7 for size in sizes]


def batch_of(lengths: Sequence[int], columns: int = 3, dtype: torch.dtype = torch.float64) -> Tensor:
    """Return padded random clouds, not centred at the origin, which are equal in every dtype up to rounding.

    Args:
        lengths: Number of points of each cloud.
        columns: Number of columns of each cloud.
        dtype: Type of the result.
    """
    generator = torch.Generator().manual_seed(0)
    clouds = [torch.randn(length, columns, generator=generator, dtype=torch.float64) for length in lengths]
    return pad([cloud.to(dtype) * 30 + 7 for cloud in clouds])


def padding(make: Make, clouds: list[Tensor], worst: Worst) -> None:
    """Check that padding, rows of NaN at the end of a cloud, changes no feature, with and without a gradient."""
    encoder = make()
    batch = pad([*clouds, clouds[0].new_zeros(len(clouds[0]) + 5, clouds[0].shape[1])])
    with torch.no_grad():
        features = encoder(batch)
    for index, cloud in enumerate(clouds):
        alone = encoder(cloud[None])[0].detach()
        scale = alone.abs().amax().clamp(min=1e-6)
        worst.record(
            (features[index] - alone).abs().max() / scale,
            f"features of a cloud of {len(cloud)} points, with padding",
        )


def any_order(make: Make, clouds: list[Tensor], worst: Worst) -> None:
    """Check that the order of the points changes no feature."""
    encoder = make()
    generator = torch.Generator().manual_seed(SEED)
    with torch.no_grad():
        for cloud in clouds:
            first = encoder(cloud[None])
            shuffled = encoder(cloud[torch.randperm(len(cloud), generator=generator)][None])
            scale = first.abs().amax().clamp(min=1e-6)
            worst.record(
                (first - shuffled).abs().max() / scale, f"features of {len(cloud)} points in another order"
            )


def gradients_of_padding(make: Make, clouds: list[Tensor], worst: Worst) -> None:
    """Check that gradients in the inputs are finite, and 0 in the padding; an encoder may have no gradient."""
    encoder = make().double()
    batch = pad([cloud.double() for cloud in clouds]).requires_grad_()
    features = encoder(batch)
    worst.count(False, "the features have no gradient in the input")
    if not features.requires_grad:
        return
    (gradient,) = torch.autograd.grad(features.square().sum(), batch)
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
            _check_refused(encoder, bad, ("Cloud 1", f"column {column}", f"point {last}"), worst)
    _check_refused(encoder, torch.stack([largest, largest * math.nan]), ("Cloud 1", "no point"), worst)


def _check_refused(encoder: Encoder, clouds: Tensor, expected: tuple[str, ...], worst: Worst) -> None:
    try:
        with torch.no_grad():
            encoder(clouds)
    except DataError as error:
        missing = [words for words in expected if words not in str(error)]
        worst.count(bool(missing), f"the error message lacks {missing}: {error}" if missing else str(error))
    else:
        worst.count(True, f"accepted; expected an error that says {', '.join(expected)}")


def other_shapes(build: Callable[[tuple[int, ...]], Encoder], worst: Worst) -> None:
    """Check that the constructor refuses input shapes of anything but clouds, with a message that names the shape."""
    for shape in NO_CLOUDS:
        try:
            build(shape)
        except ConfigError as error:
            names_shape = f"inputs of shape {shape}" in str(error) and "reads clouds" in str(error)
            worst.count(not names_shape, f"the error message does not name shape {shape} and clouds: {error}")
        else:
            worst.count(True, f"inputs of shape {shape} are accepted, expected a ConfigError")
