"""Contract tests of an encoder: one function for each property; each records its largest error."""

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
from framework.testing.devices import Calls, OneDevice, check_devices
from framework.testing.encoder_gradients import STEPS, check_parameter_gradients, perturb_parameters
from framework.testing.finding import SEED, Finding, Worst, run_check
from framework.testing.rows import CloudRow, EncoderRow

Make = Callable[[], Encoder]
MANY, SOME = 131, 9
"""Number of samples of a large batch, for a fast and for a slow encoder."""
CLOSE = 1e-5
"""Relative error of a derivative in the input below which no further step is tried."""
SLOW = 0.03
"""Processor time for four samples above which an encoder is slow, seconds."""


def examine_encoder(row: EncoderRow, build: Callable[[tuple[int, ...]], Encoder]) -> Iterator[Finding]:
    """Yield one finding for each property of an encoder; `build` returns a new encoder for an input shape."""

    def make(seed: int = SEED) -> Encoder:
        torch.manual_seed(seed)
        return build(row.input_shape).eval()

    def inputs(count: int) -> Tensor:
        """Return the row's own inputs if it has some, else images in [0, 1] or normal random vectors."""
        if row.inputs is not None:
            return row.inputs(count)
        generator = torch.Generator().manual_seed(SEED)
        if len(row.input_shape) == 3:
            return torch.rand(count, *row.input_shape, generator=generator)
        return torch.randn(count, *row.input_shape, generator=generator)

    # An encoder may take long to build, so checks that do not change its state share one.
    @cache
    def evaluated() -> Encoder:
        """Return an encoder in evaluation mode, always the same one, which is never trained or converted."""
        return make()

    @cache
    def trained() -> Encoder:
        """Return an encoder, always the same one, whose running moments change; a check sets its mode."""
        return make()

    @cache
    def perturbed() -> Encoder:
        """Return an encoder in evaluation mode, always the same one; a check converts it to the dtype it needs."""
        encoder = make()
        perturb_parameters(encoder)  # some may be 0 before training
        return encoder

    @cache
    def slow() -> bool:
        return _is_slow(evaluated(), inputs)

    checks: dict[str, tuple[float, Callable[[Worst], None]]] = {
        # the first check that uses `trained`, so that the encoder is built while new tensors are labelled
        "on the device of its inputs": (0.0, lambda worst: _on_one_device(trained, inputs, worst)),
        "feature shapes": (0.0, lambda worst: _shapes(trained(), inputs, worst)),
    }
    if len(row.input_shape) == 3:
        checks["bytes are read as 0 to 1"] = (1e-5, lambda worst: _bytes(evaluated(), row, worst))
        checks["every part of an image is read"] = (
            0.0,
            lambda worst: _all_image_parts(perturbed(), inputs(2 if slow() else 16), worst),
        )
    checks |= {
        "number types": (0.0, lambda worst: _number_types(perturbed(), inputs, worst)),
        "inputs are left as they are": (
            0.0,
            lambda worst: _inputs_unchanged(evaluated(), trained(), inputs, worst),
        ),
        "same seed, same bits": (0.0, lambda worst: _repeatable(evaluated(), make, inputs, worst)),
        "batch rows are independent": (
            1e-4,
            lambda worst: _rows_apart(evaluated(), inputs, worst, slow=slow()),
        ),
        "state-dict round trip": (
            0.0,
            lambda worst: _round_trip(evaluated(), trained(), make, inputs, worst),
        ),
        "fixed and vectorises are true": (
            1e-4,
            lambda worst: _stated_attributes(evaluated(), make, inputs, worst),
        ),
        "gradients reach every parameter": (
            0.0,
            lambda worst: _gradients(trained(), inputs(4 if slow() else 16), worst),
        ),
        "gradient in weights": (
            5e-3,
            lambda worst: check_parameter_gradients(
                perturbed if slow() else make, inputs, worst, slow=slow()
            ),
        ),
        "gradient": (1e-4, lambda worst: _against_differences(perturbed(), inputs, worst)),
        "finite on extreme inputs": (0.0, lambda worst: _extremes(evaluated(), inputs(3), worst)),
    }
    if isinstance(row, CloudRow):
        clouds = different_clouds(*row.input_shape)
        checks |= {
            "padding": (1e-5, lambda worst: padding(make, clouds, worst)),
            "points in any order": (1e-5, lambda worst: any_order(make, clouds, worst)),
            "gradients of padding": (0.0, lambda worst: gradients_of_padding(make, clouds, worst)),
            "bad clouds are named": (0.0, lambda worst: bad_clouds(make, clouds, worst)),
            "inputs that are not clouds are refused": (0.0, lambda worst: other_shapes(build, worst)),
        }
    for name, (limit, check) in checks.items():
        if name not in row.leave_out:
            yield run_check(name, row.limits.get(name, limit), check)


def _on_one_device(make: Make, inputs: Callable[[int], Tensor], worst: Worst) -> None:
    """Check that evaluation, training with a gradient in the input, and images as bytes mix no devices."""

    def calls(mode: OneDevice) -> Calls:
        encoder = make()
        mode.label_module(encoder)
        batch = mode.label_device(inputs(2))

        @torch.enable_grad()
        def train() -> None:
            encoder.train()(batch.clone().requires_grad_())

        if batch.is_floating_point():
            yield "training", train
        encoder.eval()
        yield "evaluation", lambda: encoder(batch)
        if batch.dim() == 4:
            yield "bytes", lambda: encoder((255 * batch).to(torch.uint8))

    check_devices(calls, worst)


def _shapes(encoder: Encoder, inputs: Callable[[int], Tensor], worst: Worst) -> None:
    worst.count(
        not all(isinstance(side, int) and side > 0 for side in encoder.output_shape),
        f"output_shape is {encoder.output_shape}, expected integers above 0",
    )
    with torch.no_grad():
        encoder.eval()
        for count in (0, 1, 3):
            shape = tuple(encoder(inputs(count)).shape)
            worst.same(f"shape of the features of {count} samples", shape, (count, *encoder.output_shape))
        shape = tuple(encoder.train()(inputs(4)).shape)
        worst.same("shape of the features of 4 samples in training", shape, (4, *encoder.output_shape))


def _number_types(encoder: Encoder, inputs: Callable[[int], Tensor], worst: Worst) -> None:
    """Check that features have the dtype of parameters and inputs, float32 or float64."""
    for kind in (torch.float32, torch.float64):
        with torch.no_grad():
            worst.same(f"dtype of the features for {kind}", encoder.to(kind)(inputs(2).to(kind)).dtype, kind)


def _bytes(encoder: Encoder, row: EncoderRow, worst: Worst) -> None:
    """Check that images as bytes are scaled to [0, 1], also a nearly black image, whose bytes are only 0 and 1."""
    for pixel_kind, brightest in {"bytes": 256, "dark bytes": 2}.items():
        pixels = torch.randint(0, brightest, (3, *row.input_shape), dtype=torch.uint8)
        with torch.no_grad():
            actual, expected = encoder(pixels), encoder(pixels.float() / 255)
        scale = expected.abs().amax().clamp(min=1e-6)
        worst.record(
            (actual - expected).abs() / scale, f"features of {pixel_kind} and of the same image in [0, 1]"
        )


def _all_image_parts(encoder: Encoder, batch: Tensor, worst: Worst) -> None:
    """Check that each channel and each quarter of an image affects the features."""
    encoder.float()
    channels, height, width = batch.shape[1:]
    whole = slice(None)
    parts: dict[str, tuple[Any, ...]] = {
        f"channel {channel}": (channel, whole, whole) for channel in range(channels)
    }
    for row in {0, height // 2} if height > 1 else {0}:
        for column in {0, width // 2} if width > 1 else {0}:
            region = slice(row, row + -(-height // 2)), slice(column, column + -(-width // 2))
            parts[f"the quarter from {row}, {column}"] = (whole, *region)
    generator = torch.Generator().manual_seed(SEED + 1)
    other = torch.rand(batch.shape, generator=generator)
    with torch.no_grad():
        original = encoder(batch)
        for part_name, region in parts.items():
            changed = batch.clone()
            changed[(whole, *region)] = other[(whole, *region)]
            worst.count(torch.equal(encoder(changed), original), f"{part_name} does not affect the features")


def _repeatable(encoder: Encoder, make: Make, inputs: Callable[[int], Tensor], worst: Worst) -> None:
    """Check that inputs have the same features after other inputs were encoded, and that evaluation keeps the state."""
    with torch.no_grad():
        batch = inputs(3)
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
            "features of a second encoder with the same seed that encoded other inputs first",
            other(batch),
            first,
        )


def _state(encoder: Encoder) -> dict[str, Tensor]:
    return {name: value for name, value in encoder.state_dict().items() if isinstance(value, Tensor)}


def _rows_apart(encoder: Encoder, inputs: Callable[[int], Tensor], worst: Worst, *, slow: bool) -> None:
    """Check in evaluation mode that features of a sample do not depend on its batch, except for rounding errors."""

    def compare(batch: Tensor, sizes: list[int]) -> None:
        whole = encoder(batch)
        worst.same(
            f"shape of the features of {len(batch)}", tuple(whole.shape), (len(batch), *encoder.output_shape)
        )
        scale = whole.abs().amax().clamp(min=1e-6)
        start = 0
        for part in batch.split(sizes):
            gap = (whole[start : start + len(part)] - encoder(part)).abs().flatten(1).amax(-1) / scale
            batch_sizes = f"in a batch of {len(batch)} and of {len(part)}"
            worst.record(
                gap, lambda at, start=start, batch_sizes=batch_sizes: f"sample {start + at[0]} {batch_sizes}"
            )
            start += len(part)

    with torch.no_grad():
        if slow:
            compare(inputs(SOME), [1, SOME - 1])
            return
        compare(inputs(4), [1] * 4)
        compare(inputs(MANY), [7] * (MANY // 7) + [MANY % 7])


def _is_slow(encoder: Encoder, inputs: Callable[[int], Tensor]) -> bool:
    batch = inputs(4)
    start = time.process_time()
    with torch.no_grad():
        encoder(batch)
    return time.process_time() - start > SLOW


def _inputs_unchanged(
    evaluated: Encoder, trained: Encoder, inputs: Callable[[int], Tensor], worst: Worst
) -> None:
    """Check that encoding does not change the batch, since other members of an ensemble read it."""
    batches = {"floats": inputs(4)}
    if batches["floats"].dim() == 4:
        batches["bytes"] = (batches["floats"] * 255).round().clamp(0, 255).to(torch.uint8)
    for kind, batch in batches.items():
        for mode, encoder in {"evaluation": evaluated, "training": trained.train()}.items():
            passed = batch.clone()
            with torch.no_grad():
                encoder(passed)
            worst.same_bits(f"inputs as {kind} after {mode}", passed, batch)


def _round_trip(
    evaluated: Encoder,
    trained: Encoder,
    make: Callable[..., Encoder],
    inputs: Callable[[int], Tensor],
    worst: Worst,
) -> None:
    """Check that an encoder that loads a stored state returns the features of the encoder that stored it.

    The state is stored before and after training, which may change buffers.
    """
    other = make(SEED + 7)  # so that a parameter that is not stored has another value
    batch = inputs(3)
    with torch.no_grad():
        trained.train()(inputs(5))
        trained.eval()
        for state_name, encoder in {
            "the initial state": evaluated,
            "the state after training": trained,
        }.items():
            expected = encoder(batch)
            other.load_state_dict(encoder.state_dict())
            worst.same_bits(f"features of {state_name}", other(batch), expected)
        worst.same_bits("features of a copy", copy.deepcopy(trained)(batch), expected)


def _stated_attributes(
    encoder: Encoder, make: Callable[..., Encoder], inputs: Callable[[int], Tensor], worst: Worst
) -> None:
    """Check that the encoder behaves as its attributes `fixed` and `vectorises` state.

    If `fixed` is true, features depend on the inputs alone. If `vectorises` is true, torch.vmap over the parameters of
    several encoders gives the features of each.
    """
    worst.count(False, "neither fixed nor vectorises")
    if not (encoder.fixed or encoder.vectorises):
        return
    other, batch = make(SEED + 7), inputs(3)
    with torch.no_grad():
        if encoder.fixed:
            learned = [name for name, value in encoder.named_parameters() if value.requires_grad]
            worst.same("learned parameters although fixed", learned, [])
            expected = encoder(batch)
            worst.same_bits("fixed features with another seed", other(batch), expected)
            worst.same_bits("fixed features in training", other.train()(batch), expected)
            other.eval()
        if encoder.vectorises and any(True for _ in encoder.parameters()):
            both = [encoder, other]
            state = stack_module_state(both)  # type: ignore[arg-type]  # modules
            stacked_features = torch.vmap(
                lambda parts: functional_call(encoder, parts, (batch,)), randomness="same"
            )(state)
            for number, (features, member) in enumerate(zip(stacked_features, both, strict=True)):
                expected = member(batch)
                scale = expected.abs().amax().clamp(min=1e-6)
                worst.record(
                    (features - expected).abs() / scale, f"features of encoder {number} of two by torch.vmap"
                )


def _gradients(encoder: Encoder, batch: Tensor, worst: Worst) -> None:
    """Check that in training every parameter gets a gradient.

    The batch is encoded several times, since dropout and inactive units may leave out a parameter by chance.
    """
    worst.count(False, "no parameter of the encoder is trained")
    missing = {name for name, parameter in encoder.named_parameters() if parameter.requires_grad}
    if not missing:
        return
    encoder.train()
    encoder.zero_grad()  # other checks share the encoder
    for _ in range(4):
        encoder(batch).square().sum().backward()
        for name, parameter in encoder.named_parameters():
            if parameter.grad is not None and parameter.grad.abs().sum() > 0:
                missing.discard(name)
        if not missing:
            return
    for name in sorted(missing):
        worst.count(True, f"parameter {name} has no gradient")


def _against_differences(encoder: Encoder, inputs: Callable[[int], Tensor], worst: Worst) -> None:
    """Compare a directional derivative in the input with central differences, in evaluation mode and float64.

    The derivative is that of the mean square of the features. The error is relative to the norm of the gradient. Of
    several step lengths, the one with the smallest error counts, since long steps cross kinks and short steps lose
    digits.
    """
    batch = inputs(2).double()
    encoder.double().requires_grad_(False)
    batch.requires_grad_()
    features = encoder(batch)
    if not features.requires_grad:  # an encoder without learned parameters may have no gradient
        worst.count(False, "the features have no gradient in the input")
        return
    generator = torch.Generator().manual_seed(SEED)
    direction = torch.randn(batch.shape, dtype=torch.float64, generator=generator)
    (gradient,) = torch.autograd.grad(features.square().mean(), batch)
    analytic = (gradient * direction).sum().item()
    description, error = "", math.inf
    for step in STEPS:
        with torch.no_grad():
            ends = [encoder(batch + sign * step * direction).square().mean().item() for sign in (1, -1)]
        numeric = (ends[0] - ends[1]) / (2 * step)
        gap = abs(analytic - numeric) / max(abs(numeric), gradient.norm().item(), 1e-8)
        if not gap >= error:
            description, error = f"{analytic:.9g}, by differences {numeric:.9g}", gap
        if error < CLOSE:
            break
    worst.record(error, description)


def _extremes(encoder: Encoder, like: Tensor, worst: Worst) -> None:
    """Check that features are finite for constant inputs; vectors are also tried with tiny and large numbers.

    A sample of NaN must not affect other samples, or must be refused.
    """
    sizes = (0.0, 1.0) if like.dim() == 4 else (0.0, 1e-30, 1.0, 1e6)
    with torch.no_grad():
        for size in sizes:
            worst.finite(f"features of inputs that are all {size:g}", encoder(torch.full_like(like, size)))
        like[1].fill_(math.nan)
        try:
            worst.finite("features of the samples beside one of NaN", encoder(like)[[0, 2]])
        except UserError as error:  # a cloud of NaN has no points
            worst.count("1" not in str(error), f"the error message does not name sample 1: {error}")
