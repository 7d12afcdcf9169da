"""The contract of an encoder: one function a property, each reporting the worst case it saw."""

import math
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from framework.encoder import Encoder
from framework.errors import UserError
from framework.testing.cloud_encoders import (
    any_order,
    bad_clouds,
    different_clouds,
    gradients_of_padding,
    other_shapes,
    padding,
)
from framework.testing.finding import SEED, Finding, Worst, examined
from framework.testing.rows import CloudRow, EncoderRow

Make = Callable[[], Encoder]


def examine_encoder(row: EncoderRow, build: Callable[[tuple[int, ...]], Encoder]) -> Iterator[Finding]:
    """Every property of one encoder, built for a shape of input, fresh for each."""

    def make(seed: int = SEED) -> Encoder:
        torch.manual_seed(seed)
        return build(row.input_shape).eval()

    def inputs(count: int) -> Tensor:
        """The row's own, or images in [0, 1], or normal vectors."""
        if row.inputs is not None:
            return row.inputs(count)
        generator = torch.Generator().manual_seed(SEED)
        if len(row.input_shape) == 3:
            return torch.rand(count, *row.input_shape, generator=generator)
        return torch.randn(count, *row.input_shape, generator=generator)

    checks: dict[str, tuple[float, Callable[[Worst], None]]] = {
        "feature shapes": (0.0, lambda worst: _shapes(make, inputs, worst)),
        "number types": (0.0, lambda worst: _number_types(make, inputs, worst)),
        "same seed, same bits": (0.0, lambda worst: _repeatable(make, inputs, worst)),
        "rows of a batch apart": (1e-4, lambda worst: _rows_apart(make, inputs, worst)),
        "state-dict round trip": (0.0, lambda worst: _round_trip(make, inputs, worst)),
        "gradients reach every parameter": (0.0, lambda worst: _gradients(make, inputs, worst)),
        "gradient": (1e-4, lambda worst: _against_differences(make, inputs, worst)),
        "finite on extreme inputs": (0.0, lambda worst: _extremes(make, inputs, worst)),
    }
    if len(row.input_shape) == 3:
        checks["bytes are read as 0 to 1"] = (1e-5, lambda worst: _bytes(make, row, worst))
    if isinstance(row, CloudRow):
        clouds = different_clouds(*row.input_shape)
        checks |= {
            "padding": (1e-5, lambda worst: padding(make, clouds, worst)),
            "points in any order": (1e-5, lambda worst: any_order(make, clouds, worst)),
            "gradients of padding": (0.0, lambda worst: gradients_of_padding(make, clouds, worst)),
            "bad clouds are named": (0.0, lambda worst: bad_clouds(make, clouds, worst)),
            "what is no cloud is refused": (0.0, lambda worst: other_shapes(build, worst)),
        }
    for name, (limit, check) in checks.items():
        if name not in row.leave_out:
            yield examined(name, row.limits.get(name, limit), check)


def _shapes(make: Make, inputs: Callable[[int], Tensor], worst: Worst) -> None:
    encoder = make()
    worst.count(
        not all(isinstance(side, int) and side > 0 for side in encoder.output_shape),
        f"output_shape {encoder.output_shape}",
    )
    with torch.no_grad():
        for count in (0, 1, 3):
            found = tuple(encoder(inputs(count)).shape)
            worst.same(f"features of {count} samples", found, (count, *encoder.output_shape))
        found = tuple(encoder.train()(inputs(4)).shape)
        worst.same("features of 4 samples in training", found, (4, *encoder.output_shape))


def _number_types(make: Make, inputs: Callable[[int], Tensor], worst: Worst) -> None:
    """Features are of the parameters' type, whatever float comes."""
    for kind in (torch.float32, torch.float64):
        with torch.no_grad():
            worst.same(f"features of {kind}", make().to(kind)(inputs(2).to(kind)).dtype, kind)


def _bytes(make: Make, row: EncoderRow, worst: Worst) -> None:
    pixels = torch.randint(0, 256, (3, *row.input_shape), dtype=torch.uint8)
    with torch.no_grad():
        found, wanted = make()(pixels), make()(pixels.float() / 255)
    worst.see(
        (found - wanted).abs() / wanted.abs().amax().clamp(min=1e-6), "bytes against the same in [0, 1]"
    )


def _repeatable(make: Make, inputs: Callable[[int], Tensor], worst: Worst) -> None:
    with torch.no_grad():
        encoder = make()
        worst.same_bits("features of two calls", encoder(inputs(3)), encoder(inputs(3)))
        worst.same_bits("features of two encoders of one seed", encoder(inputs(3)), make()(inputs(3)))


def _rows_apart(make: Make, inputs: Callable[[int], Tensor], worst: Worst) -> None:
    """In evaluation a sample's features do not depend on its batch, up to the rounding of another matrix product."""
    encoder, batch = make(), inputs(4)
    with torch.no_grad():
        whole = encoder(batch)
        scale = whole.abs().amax().clamp(min=1e-6)
        for index in range(len(batch)):
            alone = encoder(batch[index : index + 1])[0]
            worst.see((whole[index] - alone).abs().max() / scale, f"sample {index} alone")


def _round_trip(make: Callable[..., Encoder], inputs: Callable[[int], Tensor], worst: Worst) -> None:
    encoder = make()
    other = make(SEED + 7)  # so that a parameter which is not stored starts elsewhere
    other.load_state_dict(encoder.state_dict())
    with torch.no_grad():
        worst.same_bits("features of the stored state", other(inputs(3)), encoder(inputs(3)))


def _gradients(make: Make, inputs: Callable[[int], Tensor], worst: Worst) -> None:
    """In training, on a few batches so that dropout and dead units leave none out by chance."""
    encoder = make().train()
    worst.count(False, "no parameters")
    if not any(True for _ in encoder.parameters()):
        return
    for _ in range(4):
        encoder(inputs(16)).square().sum().backward()
    for name, parameter in encoder.named_parameters():
        if parameter.requires_grad:
            missing = parameter.grad is None or not parameter.grad.abs().sum() > 0
            worst.count(missing, f"parameter {name}")


def _against_differences(
    make: Make, inputs: Callable[[int], Tensor], worst: Worst, step: float = 1e-6
) -> None:
    """The directional derivative of the features' mean square in the input, in evaluation and float64."""
    encoder, batch = make().double(), inputs(2).double()
    encoder.requires_grad_(False)
    batch.requires_grad_()
    found = encoder(batch)
    if not found.requires_grad:  # an encoder that is not learned may have no gradient
        worst.count(False, "no gradient flows")
        return
    generator = torch.Generator().manual_seed(SEED)
    direction = torch.randn(batch.shape, dtype=torch.float64, generator=generator)
    (gradient,) = torch.autograd.grad(found.square().mean(), batch)
    analytic = (gradient * direction).sum().item()
    with torch.no_grad():
        ends = [encoder(batch + sign * step * direction).square().mean().item() for sign in (1, -1)]
    numeric = (ends[0] - ends[1]) / (2 * step)
    worst.see(
        abs(analytic - numeric) / max(abs(numeric), 1e-8), f"{analytic:.9g}, by differences {numeric:.9g}"
    )


def _extremes(make: Make, inputs: Callable[[int], Tensor], worst: Worst) -> None:
    """Constant inputs, and for vectors large ones; NaN stays in its row, or is refused."""
    encoder, like = make(), inputs(3)
    sizes = (0.0, 1.0) if like.dim() == 4 else (0.0, 1e-30, 1.0, 1e6)
    with torch.no_grad():
        for size in sizes:
            worst.finite(f"features of a constant {size:g}", encoder(torch.full_like(like, size)))
        like[1].fill_(math.nan)
        try:
            worst.finite("features of the rows beside one of NaN", encoder(like)[[0, 2]])
        except UserError as error:  # a cloud of NaN holds no point
            worst.count("1" not in str(error), f"an error that does not name row 1: {error}")
