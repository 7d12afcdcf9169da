"""Contract tests of a density head: one function for each property; each records its largest error.

The densities that the head returns are checked in framework.testing.densities.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import suppress

import torch
from torch import Tensor

from framework.density_head import DensityHead, Fitted
from framework.distributions.circular import Circular, wrap
from framework.distributions.density import Mixture
from framework.distributions.protocol import estimate, images, median, pick
from framework.geometry.srgb import linear_from_srgb
from framework.testing.devices import Calls, OneDevice, check_devices
from framework.testing.finding import SEED, Finding, Worst, seed
from framework.testing.gradients import gradient, mean_gradient_is_zero
from framework.testing.head_subject import HeadSubject, as_type, seeded
from framework.testing.precision import LIMIT, precision, reference
from framework.testing.protocol_checks import protocol_calls
from framework.testing.units import TOLERANCE, units
from framework.uncertainty import Uncertainty

BATCH_SHAPES = ((), (4,), (3, 2), (0,))
SIZES = (0.0, 1e-38, 1e-20, 1e-8, 1e-3, 1.0, 30.0, 1e3, 1e10, 1e20, 1e30)
"""Sizes of raw parameters that a diverging network may return; the largest number of the dtype is added."""
MANY_ROWS = 300
"""Number of items of a large batch, whose first and last items are compared with those of small batches."""
MOST_COLUMNS = 24
"""Largest number of raw parameters that are changed one at a time."""


def examine_head(subject: HeadSubject) -> Iterator[Finding]:
    """Yield one finding for each property of the head itself, in order of increasing run time."""
    checks = (
        ("on the device of its inputs", 0.0, _on_one_device),
        ("batch shapes", 0.0, _shapes),
        ("number types", 0.0, _number_types),
        ("NaN and infinity refused", 0.0, _refuses_non_finite),
        ("no side effects", 0.0, _side_effects),
        ("same seed, same bits", 0.0, _repeatable),
        ("no randomness in exact densities", 0.0, _not_random),
        ("batch rows are independent", 0.0, _rows_apart),
        ("state-dict round trip", 0.0, _round_trip),
        ("mixture of one equals the component", 0.0, _mixture_of_one),
        ("knobs can be set", 0.0, _knobs),
        ("finite for any raw parameters", 0.0, _finite_anywhere),
        ("calibrate does not harm", 1e-5, _calibrate),
        ("calibrate ignores the order of rows", 1e-5, _calibrate_backwards),
        ("every raw parameter is read", 0.0, _reads_all_parameters),
        ("loss is in nats", 1e-5, _loss_in_nats),
        ("several values at once", 1e-5, _several_values),
        ("target's unit", TOLERANCE, units),
        ("loss gradient", 1e-6, gradient),
        ("loss is least for its own density", 6.0, mean_gradient_is_zero),
        ("float32 against float64", LIMIT, precision),
        ("log_prob, float64", 1e-12, lambda subject, worst: reference(subject, worst, torch.float64)),
        ("log_prob, float32", 2e-6, lambda subject, worst: reference(subject, worst, torch.float32)),
    )
    for name, limit, check in checks:
        if not subject.includes(name) or (name.startswith("log_prob") and subject.row.cases is None):
            continue
        if name == "target's unit" and (subject.build_for is None or subject.row.target.kind != "real"):
            continue
        yield subject.run_check(name, limit, lambda worst, check=check: check(subject, worst))


def _on_one_device(subject: HeadSubject, worst: Worst) -> None:
    """Check that losses, calibration and all functions of the densities mix no devices."""
    raw, value = subject.raw_parameters(2), subject.values(2)

    def calls(mode: OneDevice) -> Calls:
        head = subject.build_anew()
        mode.label_module(head)
        mode.label_device((raw, value))
        pairs = mode.label_device(subject.raw_parameters(1, 2))
        index = mode.label_device(torch.tensor([[0], [1], [0]]))
        temperature = mode.label_device(torch.tensor(1.7, dtype=torch.float64))

        @torch.enable_grad()
        def train() -> None:
            head.train().loss(raw.clone().requires_grad_(), value)

        yield "loss", train
        head.eval()
        yield "calibrate", lambda: head.calibrate(raw, value)
        yield "log_prob of targets", lambda: head(raw).log_prob(value)
        yield "pick", lambda: pick(head(pairs), index).sample()
        yield from protocol_calls(head(raw), index, temperature)

    check_devices(calls, worst)


def _shapes(subject: HeadSubject, worst: Worst) -> None:
    """Check shapes of results for batches of any shape, also empty ones, and that gradients of losses are finite."""
    target = subject.row.target
    event = target.event_shape
    for batch in BATCH_SHAPES:
        head, raw, value = (
            subject.make(),
            subject.raw_parameters(*batch).requires_grad_(),
            subject.values(*batch),
        )
        loss = head.train().loss(raw, value)
        worst.same(f"shape of the loss of a batch of shape {batch}", tuple(loss.shape), batch)
        loss.sum().backward()
        if raw.grad is None:
            worst.record(math.inf, "the loss does not depend on the raw parameters")
            return
        worst.finite(f"gradient of the loss of a batch of shape {batch}", raw.grad)
        with torch.no_grad():
            density = head.eval()(raw)
            several = subject.values(5, *batch)
            shapes = {
                "batch_shape": (density.batch_shape, batch),
                "event_shape": (density.event_shape, event),
                "log_prob": (density.log_prob(value).shape, batch),
                "log_prob of 5 values": (density.log_prob(several).shape, (5, *batch)),
                "sample()": (density.sample().shape, (*batch, *event)),
                "sample((2, 3))": (density.sample(torch.Size((2, 3))).shape, (2, 3, *batch, *event)),
            }
            if 0 not in batch:
                shapes["mode"] = (density.mode.shape, (*batch, *event))
                shapes["entropy"] = (density.entropy().shape, batch)
                if target.kind != "class":
                    shapes["median"] = (median(density, 200).shape, (*batch, *event))
            angles = isinstance(density.support, Circular)
            worst.count(
                angles != (target.kind == "angle"),
                f"support {density.support} for a target of kind {target.kind}",
            )
            if target.kind == "image":
                shapes["color"] = (images(density, {"color"})["color"].shape, (*batch, *event))
                light = linear_from_srgb(density.mean)
                worst.same_bits(
                    "color is the linear RGB of the mean", images(density, {"color"})["color"], light
                )
            if target.kind == "class":
                labels = density.enumerate_support(expand=False).flatten().tolist()
                worst.same("enumerate_support", labels, list(range(len(target.names))))
            for quantity, (actual, expected) in shapes.items():
                worst.same(f"{quantity} of a batch of shape {batch}", tuple(actual), expected)


def _number_types(subject: HeadSubject, worst: Worst) -> None:
    """Check that results are float64 for float64, and float32 for float32 and half precision."""
    float32, float64 = torch.float32, torch.float64
    expected = {float64: float64, float32: float32, torch.float16: float32, torch.bfloat16: float32}
    for input_dtype, result_dtype in expected.items():
        head = subject.make().to(result_dtype)
        value = as_type(subject.values(4), result_dtype)
        with torch.no_grad():
            density = head(subject.raw_parameters(4).to(input_dtype))
            worst.same(
                f"log_prob of {input_dtype} raw parameters", density.log_prob(value).dtype, result_dtype
            )
            _require_possible(worst, f"log_prob of {input_dtype} raw parameters", density.log_prob(value))
            if value.is_floating_point():
                worst.same(f"samples of {input_dtype} raw parameters", density.sample().dtype, result_dtype)


def _require_possible(worst: Worst, label: str, log_prob: Tensor) -> None:
    """Check that log_prob is finite; the finding of a density of 0 says how to check a head of such densities."""
    hint = (
        "; the density is 0 for some targets: list targets for which it is not in HeadRow.values"
        if bool((log_prob == -math.inf).any())
        else ""
    )
    bad = ~log_prob.isfinite()
    worst.count(bad, f"{label}: {int(bad.sum())} of {log_prob.numel()} not finite{hint}")


def _refuses_non_finite(subject: HeadSubject, worst: Worst) -> None:
    """Check that NaN and infinity in the raw parameters raise a ValueError that names the first such batch row."""
    head = subject.make()
    for bad in (math.nan, math.inf, -math.inf):
        for column in range(0, head.size, max(1, head.size // 7)):
            raw = subject.raw_parameters(5)
            raw[3].view(-1)[column] = bad
            raw[4] = bad
            try:
                head(raw)
            except ValueError as error:
                worst.count(
                    "3" not in str(error), f"{bad} in row 3, column {column}: the error message is {error}"
                )
            else:
                worst.count(True, f"{bad} in row 3, column {column} is accepted, expected a ValueError")


def _repeatable(subject: HeadSubject, worst: Worst) -> None:
    """Check that results are equal for equal seeds, also after calls with other inputs and in training mode."""
    raw, value = subject.raw_parameters(4), subject.values(4)

    def compute_results(head: DensityHead) -> dict[str, Tensor]:
        seed(SEED)
        density = head.eval()(raw)
        return {
            "log_prob": density.log_prob(value),
            "sample": density.sample(torch.Size((3,))),
            "loss": head.train().loss(raw, value),
        }

    with torch.no_grad():
        head = subject.make()
        first = compute_results(head)
        density, many = head.eval()(raw), torch.Size((64,))
        seed(SEED)
        worst.count(torch.equal(density.sample(many), density.sample(many)), "two successive draws are equal")
        head.eval()(2 + 3 * raw).sample()
        head.train().loss(2 + 3 * raw, value)
        for comparison, other in {"two runs": head, "two heads": subject.build_anew()}.items():
            for name, again in compute_results(other).items():
                worst.same_bits(f"{name} of {comparison}", again, first[name])


def _not_random(subject: HeadSubject, worst: Worst) -> None:
    """Check that a log_prob without Monte Carlo error is the same for any seed: a model has one set of numbers."""
    raw, value = subject.raw_parameters(4), subject.values(4)
    head = subject.make().eval()
    results = []
    for number in (SEED, SEED + 1):
        seed(number)
        with torch.no_grad():
            results.append(estimate(head(raw), value))
    first, second = results
    worst.count(False, "log_prob is an estimate from random draws")
    exact = (first.standard_error == 0) & (second.standard_error == 0)
    worst.same_bits(
        "log_prob of a second call with another seed, which `estimate` states to be exact",
        second.log_mean[exact],
        first.log_mean[exact],
    )


def _side_effects(subject: HeadSubject, worst: Worst) -> None:
    """Check that no call changes its arguments, and that predictions change no parameters or buffers.

    Other members of an ensemble read the same features, and several metrics the same targets.
    """
    head = subject.make().eval()
    state = {name: part.clone() for name, part in head.state_dict().items()}
    raw, value = subject.raw_parameters(4), subject.values(4)
    arguments = {"the raw parameters": (raw, raw.clone()), "the targets": (value, value.clone())}

    def compare(call: str) -> None:
        for name, (actual, expected) in arguments.items():
            worst.same_bits(f"{name} after {call}", actual, expected)
            actual.copy_(expected)

    with torch.no_grad():
        density = head(raw)
        compare("forward")
        density.log_prob(value)
        compare("log_prob")
        head.train().loss(raw, value)
        compare("loss")
        head.eval()
        _ = density.sample(), density.entropy()
    for name, part in head.state_dict().items():
        worst.same_bits(f"{name} after a prediction and a loss", part, state[name])
    head.calibrate(raw, value)
    compare("calibrate")


def _rows_apart(subject: HeadSubject, worst: Worst) -> None:
    """Check that results for an item of the batch do not depend on other items.

    The loss of an item must have no gradient in the raw parameters of other items.

    If log_prob draws no random numbers, results must not depend on the number of items either.
    """
    results = []
    for factor in (1.0, -3.0):
        head, raw, value = subject.make(), subject.raw_parameters(4), subject.values(4)
        raw[[0, 1, 3]] *= factor
        with torch.no_grad():
            seed(SEED)
            density = head(raw)
            results.append({"log_prob": density.log_prob(value)[2], "mode": density.mode[2].float()})
            entropies = []
            for number in (0, 1):
                seed(number)
                entropies.append(density.entropy()[2])
            if torch.equal(*entropies):  # the entropy is not estimated from draws
                results[-1]["entropy"] = entropies[0]
            for name in ("mean", "variance"):
                with suppress(NotImplementedError, AttributeError):
                    results[-1][name] = getattr(density, name)[2].float()
            seed(SEED)
            results[-1]["loss"] = head.train().loss(raw, value)[2]
    if not subject.draws():
        head, raw, value = subject.make(), subject.raw_parameters(MANY_ROWS), subject.values(MANY_ROWS)
        with torch.no_grad():
            for start in (0, MANY_ROWS - 3):
                few = slice(start, start + 3)
                whole, part = head(raw), head(raw[few])
                where = f"of rows {start} to {start + 2} in a batch of {MANY_ROWS}"
                for name, big, small in (
                    ("log_prob", whole.log_prob(value)[few], part.log_prob(value[few])),
                    # not the modes themselves: around a flat peak, float32 does not tell one place from the next
                    ("log_prob at the mode", part.log_prob(whole.mode[few]), part.log_prob(part.mode)),
                ):
                    gap = (big - small).abs() > 1e-4 * small.abs().clamp(min=1)
                    worst.count(gap, f"{name} {where}")
            grid, line = head(raw[:6].unflatten(0, (3, 2))), head(raw[:6])
            value = value[:6]
            big, small = grid.log_prob(value.unflatten(0, (3, 2))).flatten(), line.log_prob(value)
            gap = (big - small).abs() > 1e-4 * small.abs().clamp(min=1)
            worst.count(gap, "log_prob of a batch (3, 2) and of a batch (6,)")
    for name in results[0].keys() & results[1].keys():
        alone = results[0][name]
        gap = (results[1][name] - alone).abs() > 1e-5 * alone.abs().clamp(min=1)
        worst.count(gap, f"{name} of row 2 when other rows change")
    raw = subject.raw_parameters(4).requires_grad_()
    subject.make().train().loss(raw, subject.values(4))[2].backward()
    if raw.grad is None:
        worst.record(math.inf, "the loss does not depend on the raw parameters")
        return
    worst.record(
        raw.grad[[0, 1, 3]].abs(), lambda at: f"gradient of the loss of row 2 in row {[0, 1, 3][at[0]]}"
    )


def _round_trip(subject: HeadSubject, worst: Worst) -> None:
    """Check that `calibrate` changes no parameters, and that a new head with the stored state has the same log_prob."""
    head, raw, value = subject.make(), subject.raw_parameters(32), subject.values(32)
    before = {name: parameter.clone() for name, parameter in head.named_parameters()}
    with torch.no_grad():
        head.calibrate(raw, value)
        for name, parameter in head.named_parameters():
            worst.same_bits(f"parameter {name} after calibrate", parameter, before[name])
        seed(SEED + 7)  # so that a parameter that is not stored has another value
        other = subject.build().eval()
        other.load_state_dict(head.state_dict())
        seed(SEED)
        first = head(raw).log_prob(value)
        seed(SEED)
        worst.same_bits("log_prob of a head with the stored state", other(raw).log_prob(value), first)


def _mixture_of_one(subject: HeadSubject, worst: Worst) -> None:
    """Check that a `Mixture` of one component equals the component to the last bit."""
    head, raw, value = subject.make(), subject.raw_parameters(4), subject.values(4)
    with torch.no_grad():
        results = {}
        for number in (1, 2):
            seed(SEED)
            density = head(raw) if number == 1 else Mixture(torch.zeros(4, 1), head(raw.unsqueeze(1)))
            results[number] = {"log_prob": density.log_prob(value), "mode": density.mode}
            seed(SEED)
            results[number]["entropy"] = density.entropy()
            seed(SEED)
            results[number]["sample"] = density.sample(torch.Size((3,)))
        for name, alone in results[1].items():
            worst.same_bits(name, results[2][name], alone)


def _knobs(subject: HeadSubject, worst: Worst) -> None:
    """Check that the values of each knob ascend, and that log_prob is finite for the two smallest values."""
    head = subject.make()
    worst.count(False, "the head has no knobs")
    check_knobs(head, lambda: head(subject.raw_parameters(3)).log_prob(subject.values(3)), worst)


def check_knobs(plugin: DensityHead | Uncertainty, log_prob: Callable[[], Tensor], worst: Worst) -> None:
    """Check that the values of each knob ascend, and that log_prob is finite for the two smallest values.

    A knob is a setting that trades error for run time after training.
    """
    for name, settings in plugin.knobs.items():
        worst.same(f"order of {name}", list(settings), sorted(settings))
        for setting in settings[:2]:
            setattr(plugin, name, setting)
            with torch.no_grad():
                worst.finite(f"log_prob with {name} = {setting}", log_prob())


def _finite_anywhere(subject: HeadSubject, worst: Worst) -> None:
    """Check that densities, losses and gradients are finite at raw parameters of any finite size."""
    for dtype in (torch.float32, torch.float64):
        head = subject.make().to(dtype)
        for size in (*SIZES, torch.finfo(dtype).max):
            raw = subject.raw_parameters(8).sign().to(dtype) * size
            raw[:2], raw[2:4] = size, -size
            value = as_type(subject.values(8), dtype)
            where = f"{str(dtype)[6:]}, raw parameters of size {size:.3g}"
            with torch.no_grad():
                density = head.eval()(raw)
                _require_possible(worst, f"log_prob: {where}", density.log_prob(value))
                worst.finite(f"mode: {where}", density.mode)
                worst.finite(f"samples: {where}", density.sample())
            raw.requires_grad_()
            loss = head.train().loss(raw, value)
            worst.finite(f"loss: {where}", loss)
            loss.sum().backward()
            worst.finite(f"gradient of the loss: {where}", torch.zeros(1) if raw.grad is None else raw.grad)


def _calibrate(subject: HeadSubject, worst: Worst) -> None:
    """Check that `calibrate` does not lower the mean log_prob of its data; the error is relative above 1 nat.

    The data are targets that are independent of the raw parameters, and draws from the head's own densities. The draws
    are used unchanged, moved to a third of their distance from the mode, and moved to three times this distance. For
    draws the error is divided by 1000.
    """
    if subject.draws():
        worst.count(False, "log_prob draws random numbers")
        return
    spreads = {
        "independent targets": None,
        "draws": 1.0,
        "draws near the mode": 1 / 3,
        "draws far from it": 3.0,
    }
    for target_kind, spread in spreads.items():
        head, raw, value = subject.make(), subject.raw_parameters(64), subject.values(64)
        if spread is not None and (head.direct or isinstance(head, Fitted)):  # it reads features
            break
        with torch.no_grad():
            if spread is not None:
                density = seeded(head, raw)
                value, mode = density.sample(), density.mode
                if value.is_floating_point() and subject.row.target.kind != "image":
                    angles = isinstance(density.support, Circular)
                    value = mode + spread * (wrap(value - mode) if angles else value - mode)
            before = head(raw).log_prob(value).double().mean()
            head.calibrate(raw, value)
            after = head(raw).log_prob(value).double().mean()
        loss = (before - after).clamp(min=0) / before.abs().clamp(min=1) if after.isfinite() else after
        # a calibration of intervals, for example, need not maximise the likelihood
        loss = loss if spread is None else 1e-3 * loss
        worst.record(
            loss, f"{target_kind}: {before.item():.6g} nats before calibrate, {after.item():.6g} after"
        )


def _calibrate_backwards(subject: HeadSubject, worst: Worst) -> None:
    """Check that the calibrated head does not depend on the order in which `calibrate` gets its samples."""
    if subject.draws():
        worst.count(False, "log_prob draws random numbers")
        return
    raw, value = subject.raw_parameters(64), subject.values(64)
    if value.is_floating_point() and subject.row.target.kind == "real" and subject.row.values is None:
        value[32:] = 2 * value[32:]
    log_probs = []
    with torch.no_grad():
        for order in (torch.arange(64), torch.arange(63, -1, -1)):
            head = subject.make()
            head.calibrate(raw[order], value[order])
            log_probs.append(head(raw).log_prob(value).double())
    gap = (log_probs[0] - log_probs[1]).abs() / log_probs[0].abs().clamp(min=1)
    worst.record(gap, "log_prob after calibrate on rows in reverse order")


def _reads_all_parameters(subject: HeadSubject, worst: Worst) -> None:
    """Check that each raw parameter has an effect: its change must change the loss of some target."""
    head = subject.make().double().train()
    if head.direct or isinstance(head, Fitted):
        worst.count(False, "the head reads features rather than raw parameters")
        return
    unread = set(range(head.size))
    for size in (0.3, 1.0, 3.0):
        raw, value = (size * subject.raw_parameters(8)).double(), as_type(subject.values(8), torch.float64)
        with torch.no_grad():
            seed(SEED)
            before = head.loss(raw, value)
            for column in sorted(unread)[:MOST_COLUMNS]:
                other = raw.flatten(1).clone()
                other[:, column] = 0.4 - 0.9 * other[:, column]
                seed(SEED)
                if not torch.equal(head.loss(other.view_as(raw), value), before):
                    unread.remove(column)
            if len(unread) > max(0, head.size - MOST_COLUMNS):
                continue
            unread = set()
            break
    worst.count(bool(unread), f"raw parameters that do not change the loss: {sorted(unread)[:8]}")


def _loss_in_nats(subject: HeadSubject, worst: Worst) -> None:
    """Check that the loss is in nats: if it is factor · -log_prob + constant, the factor must be 1.

    The error is relative to log_prob. Draws from the head's own densities decide whether the loss has this form. If it
    has, it must also agree with log_prob at values that are very unlikely. The loss of an image may also be the mean
    over the numbers of the image.
    """
    if subject.draws():
        worst.count(False, "log_prob draws random numbers, so the loss may be a bound on it")
        return
    head, raw = subject.make().double(), subject.raw_parameters(6).double()
    with torch.no_grad():
        density = head.eval()(raw)
        seed(SEED)
        draws = density.sample(torch.Size((24,)))
        seed(SEED)
        unlikely = as_type(subject.values(8, 6), draws.dtype)
        if subject.row.target.kind != "class":
            unlikely[:4], unlikely[4:] = 10 * unlikely[:4], 1e4 * unlikely[4:]
        value = torch.cat([draws, unlikely])
        log_prob = density.log_prob(value).double()
        loss = torch.stack([head.train().loss(raw, values) for values in value]).double()
    near, far = log_prob[:24], log_prob[24:]
    offset = near - near.mean(0)
    factor = -(offset * loss[:24]).sum(0) / offset.square().sum(0).clamp(min=1e-300)
    constant = (loss + factor * log_prob)[:24].mean(0)
    rest = (loss + factor * log_prob - constant).abs()
    size = 1 + log_prob.abs()
    fits = ((rest / size)[:24].amax(0) < 1e-9) & (offset.abs().amax(0) > 1e-3)
    worst.count(False, "the loss is not a multiple of log_prob")
    # the loss of an image may be the mean over its numbers
    share = density.event_shape.numel() if subject.row.target.kind == "image" else 1
    gap = torch.where(fits, torch.minimum((factor - 1).abs(), (share * factor - 1).abs()), 0.0)
    worst.record(gap, lambda at: f"the loss is {factor[at].item():.4g} times -log_prob, row {at[0]}")
    gap = torch.where(fits & far.isfinite(), (rest / size)[24:], 0.0)
    worst.record(
        gap, lambda at: f"the loss is {loss[24:][at].item():.6g} where log_prob is {far[at].item():.6g}"
    )


def _several_values(subject: HeadSubject, worst: Worst) -> None:
    """Check that log_prob of several values (5, *batch) equals log_prob of each value alone."""
    with torch.no_grad():
        density, value = subject.make()(subject.raw_parameters(4)), subject.values(5, 4)
        together = density.log_prob(value)
        if subject.draws():
            worst.count(False, "log_prob draws random numbers")
            return
        alone = torch.stack([density.log_prob(single_value) for single_value in value])
    gap = (together - alone).abs() / alone.abs().clamp(min=1)
    worst.record(gap, lambda at: f"value {at[0]} of row {at[1]}")
