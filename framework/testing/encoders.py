"""Contract tests of an encoder: one function for each property; each reports its worst case."""

import copy
import math
import time
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.func import functional_call, stack_module_state

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
from framework.testing.devices import OneDevice, Questions, on_one_device
from framework.testing.encoder_gradients import STEPS, moved_a_little, of_weights
from framework.testing.finding import SEED, Finding, Worst, examined
from framework.testing.rows import CloudRow, EncoderRow

Make = Callable[[], Encoder]
MANY, SOME = 131, 9
"""Number of samples of a large batch; SOME where four samples take more processor time than SLOW seconds."""
SLOW = 0.03


def examine_encoder(row: EncoderRow, build: Callable[[tuple[int, ...]], Encoder]) -> Iterator[Finding]:
    """Yield one finding for each property of an encoder; `build` makes a new one for an input shape."""

    def make(seed: int = SEED) -> Encoder:
        torch.manual_seed(seed)
        return build(row.input_shape).eval()

    def inputs(count: int) -> Tensor:
        """Return the row's own inputs, or images in [0, 1], or normal vectors."""
        if row.inputs is not None:
            return row.inputs(count)
        generator = torch.Generator().manual_seed(SEED)
        if len(row.input_shape) == 3:
            return torch.rand(count, *row.input_shape, generator=generator)
        return torch.randn(count, *row.input_shape, generator=generator)

    @cache
    def slow() -> bool:
        return _slow(make, inputs)

    checks: dict[str, tuple[float, Callable[[Worst], None]]] = {
        "on the device of its inputs": (0.0, lambda worst: _on_one_device(make, inputs, worst)),
        "feature shapes": (0.0, lambda worst: _shapes(make, inputs, worst)),
        "number types": (0.0, lambda worst: _number_types(make, inputs, worst)),
        "same seed, same bits": (0.0, lambda worst: _repeatable(make, inputs, worst)),
        "rows of a batch apart": (1e-4, lambda worst: _rows_apart(make, inputs, worst, slow=slow())),
        "state-dict round trip": (0.0, lambda worst: _round_trip(make, inputs, worst)),
        "inputs are left as they are": (0.0, lambda worst: _untouched(make, inputs, worst)),
        "what it says of itself": (1e-4, lambda worst: _claims(make, inputs, worst)),
        "gradients reach every parameter": (0.0, lambda worst: _gradients(make, inputs, worst)),
        "gradient": (1e-4, lambda worst: _against_differences(make, inputs, worst)),
        "gradient in weights": (
            5e-3,
            lambda worst: of_weights(make, inputs, worst, slow=slow()),
        ),
        "finite on extreme inputs": (0.0, lambda worst: _extremes(make, inputs, worst)),
    }
    if len(row.input_shape) == 3:
        checks["bytes are read as 0 to 1"] = (1e-5, lambda worst: _bytes(make, row, worst))
        checks["all of an image counts"] = (
            0.0,
            lambda worst: _every_part(make, inputs(4 if slow() else 16), worst),
        )
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


def _on_one_device(make: Make, inputs: Callable[[int], Tensor], worst: Worst) -> None:
    """Check evaluation, training with a gradient in the input, and images as bytes for mixed devices."""

    def questions(mode: OneDevice) -> Questions:
        encoder = make()
        mode.move(encoder)
        batch = mode.receive(inputs(2))

        @torch.enable_grad()
        def trained() -> None:
            encoder.train()(batch.clone().requires_grad_())

        if batch.is_floating_point():
            yield "training", trained
        encoder.eval()
        yield "evaluation", lambda: encoder(batch)
        if batch.dim() == 4:
            yield "bytes", lambda: encoder((255 * batch).to(torch.uint8))

    on_one_device(questions, worst)


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
    """Check that features have the dtype of the parameters, whatever the float dtype of the inputs."""
    for kind in (torch.float32, torch.float64):
        with torch.no_grad():
            worst.same(f"features of {kind}", make().to(kind)(inputs(2).to(kind)).dtype, kind)


def _bytes(make: Make, row: EncoderRow, worst: Worst) -> None:
    """Check that bytes are read as 0 to 1, also in a nearly black image, whose bytes could be mistaken for floats."""
    encoder = make()
    for what, brightest in {"bytes": 256, "dark bytes": 2}.items():
        pixels = torch.randint(0, brightest, (3, *row.input_shape), dtype=torch.uint8)
        with torch.no_grad():
            found, wanted = encoder(pixels), encoder(pixels.float() / 255)
        scale = wanted.abs().amax().clamp(min=1e-6)
        worst.see((found - wanted).abs() / scale, f"{what} against the same in [0, 1]")


def _every_part(make: Make, batch: Tensor, worst: Worst) -> None:
    """Check that each channel and each quarter of an image affects the features, with weights as after training."""
    encoder = make()
    moved_a_little(encoder)
    channels, height, width = batch.shape[1:]
    whole = slice(None)
    parts: dict[str, tuple[Any, ...]] = {
        f"channel {channel}": (channel, whole, whole) for channel in range(channels)
    }
    for row in {0, height // 2} if height > 1 else {0}:
        for column in {0, width // 2} if width > 1 else {0}:
            place = slice(row, row + -(-height // 2)), slice(column, column + -(-width // 2))
            parts[f"the quarter from {row}, {column}"] = (whole, *place)
    generator = torch.Generator().manual_seed(SEED + 1)
    other = torch.rand(batch.shape, generator=generator)
    with torch.no_grad():
        found = encoder(batch)
        for what, place in parts.items():
            changed = batch.clone()
            changed[(whole, *place)] = other[(whole, *place)]
            worst.count(torch.equal(encoder(changed), found), f"{what} changes nothing")


def _repeatable(make: Make, inputs: Callable[[int], Tensor], worst: Worst) -> None:
    """Check that features repeat, whatever was encoded before, and that evaluation changes no state."""
    with torch.no_grad():
        encoder, batch = make(), inputs(3)
        before = {name: value.clone() for name, value in _state(encoder).items()}
        first = encoder(batch)
        worst.same_bits("features of two calls", encoder(batch), first)
        for count in (5, 3):
            encoder(inputs(7)[-count:])
        worst.same_bits("features after other inputs", encoder(batch), first)
        for name, value in _state(encoder).items():
            worst.same_bits(f"state {name} after evaluation", value, before[name])
        other = make()
        other(inputs(7)[-4:])
        worst.same_bits(
            "features of another of one seed, which other inputs came to first", other(batch), first
        )


def _state(encoder: Encoder) -> dict[str, Tensor]:
    return {name: value for name, value in encoder.state_dict().items() if isinstance(value, Tensor)}


def _rows_apart(make: Make, inputs: Callable[[int], Tensor], worst: Worst, *, slow: bool) -> None:
    """Check that in evaluation a sample's features do not depend on its batch, up to rounding of matrix products."""
    encoder = make()

    def compare(batch: Tensor, sizes: list[int]) -> None:
        whole = encoder(batch)
        worst.same(f"features of {len(batch)}", tuple(whole.shape), (len(batch), *encoder.output_shape))
        scale = whole.abs().amax().clamp(min=1e-6)
        start = 0
        for part in batch.split(sizes):
            gap = (whole[start : start + len(part)] - encoder(part)).abs().flatten(1).amax(-1) / scale
            said = f"of {len(batch)}, among {len(part)}"
            worst.see(gap, lambda at, start=start, said=said: f"sample {start + at[0]} {said}")
            start += len(part)

    with torch.no_grad():
        if slow:
            compare(inputs(SOME), [1, SOME - 1])
            return
        compare(inputs(4), [1] * 4)
        compare(inputs(MANY), [7] * (MANY // 7) + [MANY % 7])


def _slow(make: Make, inputs: Callable[[int], Tensor]) -> bool:
    encoder, batch = make(), inputs(4)
    start = time.process_time()
    with torch.no_grad():
        encoder(batch)
    return time.process_time() - start > SLOW


def _untouched(make: Make, inputs: Callable[[int], Tensor], worst: Worst) -> None:
    """Check that encoding leaves the batch as it is, since other members of an ensemble read it."""
    encoder, batches = make(), {"floats": inputs(4)}
    if batches["floats"].dim() == 4:
        batches["bytes"] = (batches["floats"] * 255).round().clamp(0, 255).to(torch.uint8)
    for what, batch in batches.items():
        for training in (False, True):
            given = batch.clone()
            with torch.no_grad():
                encoder.train(training)(given)
            worst.same_bits(f"{what} after {'training' if training else 'evaluation'}", given, batch)


def _round_trip(make: Callable[..., Encoder], inputs: Callable[[int], Tensor], worst: Worst) -> None:
    """Check that a stored encoder gives the same bits, also after training changed buffers such as running means."""
    encoder = make()
    other = make(SEED + 7)  # so that a parameter that is not stored has another value
    for what, batches in {"the first state": 0, "the state after training": 2}.items():
        with torch.no_grad():
            for _ in range(batches):
                encoder.train()(inputs(5))
            wanted = encoder.eval()(inputs(3))
            other.load_state_dict(encoder.state_dict())
            worst.same_bits(f"features of {what}", other(inputs(3)), wanted)
    with torch.no_grad():
        worst.same_bits("features of a copy", copy.deepcopy(encoder)(inputs(3)), encoder(inputs(3)))


def _claims(make: Callable[..., Encoder], inputs: Callable[[int], Tensor], worst: Worst) -> None:
    """Check the claims of an encoder.

    With `fixed`, features depend on the input alone. With `vectorises`, several encoders evaluated at once give the
    features of each.
    """
    encoder = make()
    worst.count(False, "it says nothing of itself")
    if not (encoder.fixed or encoder.vectorises):
        return
    other, batch = make(SEED + 7), inputs(3)
    with torch.no_grad():
        if encoder.fixed:
            learned = [name for name, value in encoder.named_parameters() if value.requires_grad]
            worst.same("parameters learned though fixed", learned, [])
            wanted = encoder(batch)
            worst.same_bits("fixed features with another seed", other(batch), wanted)
            worst.same_bits("fixed features in training", encoder.train()(batch), wanted)
            encoder.eval()
        if encoder.vectorises and any(True for _ in encoder.parameters()):
            both = [encoder, other]
            state = stack_module_state(both)  # type: ignore[arg-type]  # modules
            found = torch.vmap(lambda parts: functional_call(encoder, parts, (batch,)), randomness="same")(
                state
            )
            for number, (one, each) in enumerate(zip(found, both, strict=True)):
                wanted = each(batch)
                scale = wanted.abs().amax().clamp(min=1e-6)
                worst.see((one - wanted).abs() / scale, f"features of {number} of two at once")


def _gradients(make: Make, inputs: Callable[[int], Tensor], worst: Worst) -> None:
    """Check that in training every parameter gets a gradient.

    Several batches are used, so that dropout and dead units leave out no parameter by chance.
    """
    encoder = make().train()
    worst.count(False, "no parameters")
    if not any(True for _ in encoder.parameters()):
        return
    missing = {name for name, parameter in encoder.named_parameters() if parameter.requires_grad}
    for _ in range(4):
        encoder(inputs(16)).square().sum().backward()
        for name, parameter in encoder.named_parameters():
            if parameter.grad is not None and parameter.grad.abs().sum() > 0:
                missing.discard(name)
        if not missing:
            return
    for name in sorted(missing):
        worst.count(True, f"parameter {name}")


def _against_differences(make: Make, inputs: Callable[[int], Tensor], worst: Worst) -> None:
    """Check the directional derivative of the features' mean square in the input, in evaluation mode and float64.

    The error is relative to the gradient's size. The step that agrees best counts, since long steps cross kinks and
    short steps lose digits.
    """
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
    told, error = "", math.inf
    for step in STEPS:
        with torch.no_grad():
            ends = [encoder(batch + sign * step * direction).square().mean().item() for sign in (1, -1)]
        numeric = (ends[0] - ends[1]) / (2 * step)
        gap = abs(analytic - numeric) / max(abs(numeric), gradient.norm().item(), 1e-8)
        if not gap >= error:
            told, error = f"{analytic:.9g}, by differences {numeric:.9g}", gap
    worst.see(error, told)


def _extremes(make: Make, inputs: Callable[[int], Tensor], worst: Worst) -> None:
    """Check that features are finite at constant inputs, which for vectors are also large.

    NaN must not affect other rows, or it must be refused.
    """
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
