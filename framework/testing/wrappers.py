"""Contract tests of an uncertainty wrapper: one function for each property; each records its largest error.

Calibration is checked in framework.testing.calibration.
"""

import copy
from collections.abc import Callable, Iterator

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.data import Batch
from framework.distributions.circular import Circular
from framework.model import Predictor
from framework.target import Target
from framework.testing import densities
from framework.testing.calibration import Calibration
from framework.testing.devices import Calls, OneDevice, check_devices
from framework.testing.finding import SEED, Finding, Worst, run_check, seed
from framework.testing.head_subject import values
from framework.testing.heads import check_knobs
from framework.testing.plain import Build, Plain, inputs, wrapped_models
from framework.testing.protocol_checks import protocol_calls
from framework.testing.rows import WrapperRow
from framework.uncertainty import SelfTraining, Uncertainty, held_out

Make = Callable[[], Uncertainty]


def examine_wrapper(
    row: WrapperRow, build: Build, build_identity: Callable[[Callable[[], Predictor]], Uncertainty] | None
) -> Iterator[Finding]:
    """Yield one finding for each property of an uncertainty wrapper, built around `Plain` anew for each check.

    Args:
        row: Contract row of the wrapper.
        build: Function that builds the wrapper for a target.
        build_identity: Function that builds the wrapper around a given model, with parameters for which it must equal
            the model; None if there are no such parameters.
    """

    def make() -> Uncertainty:
        seed(SEED)
        return build(row.target).eval()

    checks: dict[str, tuple[float, Callable[[Worst], None]]] = {
        "on the device of its inputs": (0.0, lambda worst: _on_one_device(make, row, worst)),
        "densities": (0.0, lambda worst: _densities(make, row, worst)),
        "number types": (0.0, lambda worst: _number_types(make, row, worst)),
        "same seed, same bits": (0.0, lambda worst: _repeatable(make, row, worst)),
        "batch rows are independent": (1e-5, lambda worst: _rows_apart(make, row, worst)),
        "no side effects": (0.0, lambda worst: _side_effects(make, row, worst)),
        "knobs can be set": (0.0, lambda worst: _knobs(make, row, worst)),
        "loss and its gradient": (0.0, lambda worst: _loss(make, row, worst)),
        "loss trains all wrapped models": (0.0, lambda worst: _loss_improves_models(make, row, worst)),
        "training densities": (1e-5, lambda worst: _training_densities(make, row, worst)),
        "state-dict round trip": (
            0.0,
            lambda worst: _round_trip(make, lambda: build(row.target), row, worst),
        ),
        "calibration": (0.0, lambda worst: _calibration(make, row, worst)),
        "trains its models itself": (0.0, lambda worst: _trains_itself(make, row, worst)),
    }
    calibration = Calibration(row, build)
    checks |= {name: (limit, check) for name, limit, check in calibration.checks()}
    # the mode of a mixture is the highest of some candidates, not exact
    limit = 1e-6 if row.target.kind == "class" else 0.2
    checks["mode"] = (
        limit,
        lambda worst: _check_densities(calibration.many, densities.mode_is_highest, worst),
    )
    for name, limit, check in density_checks(row.target):
        checks[name] = (
            limit,
            lambda worst, check=check: _check_densities(calibration.densities, check, worst),
        )
    if build_identity is not None:
        checks["one member equals the model"] = (0.0, lambda worst: _identity(build_identity, row, worst))
    for name, (limit, check) in checks.items():
        if name not in row.leave_out:
            yield run_check(name, row.limits.get(name, limit), check)


def density_checks(target: Target) -> Iterator[tuple[str, float, densities.Check]]:
    """Yield name, limit and check of each property in framework.testing.densities that applies to the target."""
    numbers = 0 if target.kind == "class" else len(target.names)
    yield "integral", 1e-5, densities.integral
    yield (
        "samples follow log_prob",
        5.0,
        densities.samples_follow_log_prob if numbers != 2 else _compare_on_grid,
    )
    if numbers == 2:
        yield "samples follow marginals", 5.0, densities.samples_follow_marginals
    yield "entropy", 5.0, densities.entropy
    if target.kind == "angle":
        yield "2π-periodic", 1e-12, densities.periodic
    if numbers == 1:
        yield "median", 5.0, densities.median_is_best
        yield "cdf", 1e-6, densities.masses
    if target.kind == "real" and numbers <= 2:
        yield "mean and variance", 1e-5, densities.moments


def _compare_on_grid(density: Distribution, worst: Worst) -> None:
    """Check that draws follow log_prob; for real numbers, only if the grid resolves the density."""
    broad = bool((density.mode.abs() < 10).all() and (density.entropy() > 0).all())
    if isinstance(density.support, Circular) or broad:
        densities.samples_follow_log_prob(density, worst)
    else:
        worst.count(False, "left to the check of the marginals, since the grid is too coarse")


def batches(row: WrapperRow) -> list[Batch]:
    """Return 40 validation samples for the wrapper of a contract row, as batches."""
    target = values(row.target, (40,))
    parts = zip(inputs(40).split(16), target.split(16), strict=True)
    return [{"input": batch_inputs, "target": target_values} for batch_inputs, target_values in parts]


def _on_one_device(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Check that losses, calibration and all functions of the calibrated densities mix no devices."""

    def calls(mode: OneDevice) -> Calls:
        wrapper = make()
        mode.label_module(wrapper)
        features, labels = mode.label_device((inputs(4), values(row.target, (4,))))
        labelled = mode.label_device(batches(row))
        index = mode.label_device(torch.zeros(3, 1, dtype=torch.int64))
        temperature = mode.label_device(torch.tensor(1.7, dtype=torch.float64))

        @torch.enable_grad()
        def train() -> None:
            wrapper.train().loss(features, labels)
            density = wrapper.training_densities(features)
            density.log_prob(density.sample())

        yield "loss", train
        wrapper.eval()
        yield "log_prob of targets", lambda: wrapper(features).log_prob(labels)
        yield "calibrate", lambda: wrapper.calibrate(labelled)
        yield from protocol_calls(wrapper(features), index, temperature)

    check_devices(calls, worst)


def _densities(make: Make, row: WrapperRow, worst: Worst) -> None:
    event = row.target.event_shape
    wrapper = make()
    with torch.no_grad():
        for count in (0, 1, 5):
            density = wrapper(inputs(count))
            target = values(row.target, (count,))
            worst.same(f"batch_shape for {count} samples", tuple(density.batch_shape), (count,))
            worst.same(f"event_shape for {count} samples", tuple(density.event_shape), event)
            log_prob = density.log_prob(target)
            worst.same(f"shape of log_prob for {count} samples", tuple(log_prob.shape), (count,))
            worst.finite(f"log_prob for {count} samples", log_prob)
            if row.target.kind == "angle":
                worst.count(
                    not isinstance(density.support, Circular),
                    f"support is {density.support}, expected that of angles",
                )
            if count:
                worst.same(
                    f"shape of sample for {count} samples", tuple(density.sample().shape), (count, *event)
                )
                worst.same(f"shape of entropy for {count} samples", tuple(density.entropy().shape), (count,))
                worst.same(f"shape of mode for {count} samples", tuple(density.mode.shape), (count, *event))


def _number_types(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Check that log_prob has the dtype of model and inputs, before and after `calibrate`."""
    for kind in (torch.float32, torch.float64):
        wrapper = make().to(kind)
        typed = [
            {name: field.to(kind) if field.is_floating_point() else field for name, field in batch.items()}
            for batch in batches(row)
        ]
        for state in ("as built", "calibrated"):
            if state == "calibrated":
                wrapper.calibrate(typed)
            with torch.no_grad():
                log_prob = wrapper(typed[0]["input"]).log_prob(typed[0]["target"])
            worst.same(f"log_prob of {kind}, {state}", log_prob.dtype, kind)


def _repeatable(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Check that results are equal for equal seeds, also after other inputs and for a second wrapper.

    Two wrappers that are calibrated on the same data must have equal results too.
    """
    target = values(row.target, (5,))

    def compute_results(wrapper: Uncertainty) -> dict[str, Tensor]:
        seed(SEED)
        density = wrapper(inputs(5))
        results = {"log_prob": density.log_prob(target), "mode": density.mode}
        seed(SEED)
        return {**results, "sample": density.sample(), "loss": wrapper.loss(inputs(5), target)}

    with torch.no_grad():
        first, second = make(), make()
        expected = compute_results(first)
        first(3 * inputs(7, 1)).sample()
        first.loss(3 * inputs(5, 1), target)
        for comparison, other in {"after other inputs": first, "of two wrappers": second}.items():
            for name, results in compute_results(other).items():
                worst.same_bits(f"{name} {comparison}", results, expected[name])
    for wrapper in (first, second):
        seed(SEED)
        wrapper.calibrate(batches(row))
    with torch.no_grad():
        expected = compute_results(first)
        for name, results in compute_results(second).items():
            worst.same_bits(f"{name} of two calibrated wrappers", results, expected[name])


def _rows_apart(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Check that results for an item of a batch do not depend on other items.

    The loss of an item must have no gradient in the inputs of other items.
    """
    wrapper, target, features = make(), values(row.target, (5,)), inputs(5)
    other = torch.where(torch.arange(5).unsqueeze(-1) == 2, features, 1 - 3 * features)
    for state in ("as built", "calibrated"):
        if state == "calibrated":
            wrapper.calibrate(batches(row))
        results: list[dict[str, Tensor]] = []
        with torch.no_grad():
            for rows in (features, other):
                seed(SEED)
                density = wrapper(rows)
                quantities = {"log_prob": density.log_prob(target), "mode": density.mode}
                seed(SEED)
                quantities["entropy"] = density.entropy()
                seed(SEED)
                quantities["loss"] = wrapper.loss(rows, target)
                results.append({name: quantity[2].double() for name, quantity in quantities.items()})
        for name, alone in results[0].items():
            # an entropy may be estimated from draws, or by a quadrature whose nodes all rows share
            least = 10.0 if name == "entropy" else 1.0
            error = (results[1][name] - alone).abs() / alone.abs().clamp(min=least)
            worst.record(error, f"{name} of row 2 when other rows change, {state}")
    leaf = inputs(5).requires_grad_()
    seed(SEED)
    wrapper.loss(leaf, target)[2].backward()
    if leaf.grad is not None:
        worst.record(leaf.grad[[0, 1, 3, 4]].abs().max(), "gradient of the loss of row 2 in other inputs")


def _side_effects(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Check that predictions change no training modes, buffers or parameters, and that calibrate changes no modes."""
    target = values(row.target, (5,))
    for training in (True, False):
        wrapper = make().train(training)
        modes = {name: module.training for name, module in wrapper.named_modules()}
        state = copy.deepcopy(wrapper.state_dict())
        with torch.no_grad():
            density = wrapper(inputs(5))
            _ = density.log_prob(target), density.sample(), density.entropy(), density.mode
            wrapper.loss(inputs(5), target)
            wrapper.training_densities(inputs(5)).sample()
        for name, value in wrapper.state_dict().items():
            worst.same_bits(
                f"{name} after a prediction, {'training' if training else 'evaluation'} mode",
                value,
                state[name],
            )
        for call in ("a prediction", "calibrate"):
            if call == "calibrate":
                wrapper.calibrate(batches(row))
            after = {name: module.training for name, module in wrapper.named_modules()}
            changed = [name or "the wrapper" for name in modes if after.get(name) != modes[name]]
            worst.count(bool(changed), f"training modes changed by {call}: {', '.join(changed) or 'none'}")


def _knobs(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Check that the values of each knob ascend, and that log_prob is finite for the two smallest values."""
    wrapper = make()
    worst.count(False, "the wrapper has no knobs")
    check_knobs(wrapper, lambda: wrapper(inputs(3)).log_prob(values(row.target, (3,))), worst)


def _loss(make: Make, row: WrapperRow, worst: Worst) -> None:
    wrapper = make().train()
    loss = wrapper.loss(inputs(8), values(row.target, (8,)))
    worst.same("shape of the loss of 8 samples", tuple(loss.shape), (8,))
    worst.finite("loss", loss)
    loss.sum().backward()
    gradients = [parameter.grad for parameter in wrapper.parameters() if parameter.grad is not None]
    worst.count(not gradients, "no parameter has a gradient")
    for gradient in gradients:
        worst.finite("gradient", gradient)


def _loss_improves_models(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Check in evaluation mode that a small step against the gradient of the loss improves every wrapped model."""
    wrapper = make().double()
    features, target = inputs(64).double(), values(row.target, (64,))
    target = target.double() if target.is_floating_point() else target
    models = wrapped_models(wrapper)

    def model_losses() -> list[float]:
        with torch.no_grad():
            return [model.loss(features, target).mean().item() for model in models]

    before = model_losses()
    wrapper.loss(features, target).mean().backward()
    with torch.no_grad():
        for model in models:
            slopes = [part.grad for part in model.parameters() if part.grad is not None]
            length = torch.stack([slope.norm() for slope in slopes]).norm() if slopes else torch.zeros(())
            for part in model.parameters():
                if part.grad is not None:
                    part -= 1e-4 * part.grad / length.clamp(min=1e-12)
    worst.count(False, "the wrapper stores no models as modules")
    for number, (first, then) in enumerate(zip(before, model_losses(), strict=True)):
        worst.count(not then < first, f"loss of wrapped model {number}: {first:.9g}, after a step {then:.9g}")


def _training_densities(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Check that training densities are those of one model or of every member, with gradients in all wrapped models.

    The log-density of the wrapper must lie between the smallest and the largest of its members at every value.
    """
    wrapper, target = make(), values(row.target, (5,))
    density = wrapper.training_densities(inputs(5))
    worst.count(
        density.batch_shape[:1] != (5,) or len(density.batch_shape) > 2,
        f"batch_shape is {tuple(density.batch_shape)} for 5 samples, expected (5,) or (5, members)",
    )
    several = len(density.batch_shape) == 2
    value = torch.stack([values(row.target, (5,)), wrapper(inputs(5)).mode, 0 * target])
    parts = density.log_prob(value.unsqueeze(2) if several else value)
    worst.count(not parts.requires_grad, "the training densities have no gradient")
    parts.sum().backward()
    for number, model in enumerate(wrapped_models(wrapper)):
        has_gradient = any(part.grad is not None and bool(part.grad.any()) for part in model.parameters())
        worst.count(not has_gradient, f"the training densities have no gradient in wrapped model {number}")
    if several:
        with torch.no_grad():
            whole, parts = wrapper(inputs(5)).log_prob(value), parts.detach()
        outside = (whole - parts.amax(-1)).maximum(parts.amin(-1) - whole)
        worst.record(
            outside, lambda at: f"log-density outside the range of the members, value {at[0]}, row {at[1]}"
        )


def _round_trip(make: Make, build: Make, row: WrapperRow, worst: Worst) -> None:
    """Check that a wrapper with the stored state has the same log_prob, including what `calibrate` fitted."""
    wrapper = make()
    wrapper.calibrate(batches(row))
    seed(SEED + 7)  # so that a parameter that is not stored has another value
    other = build().eval()
    other.load_state_dict(wrapper.state_dict())
    target = values(row.target, (5,))
    with torch.no_grad():
        seed(SEED)
        first = wrapper(inputs(5)).log_prob(target)
        seed(SEED)
        worst.same_bits(
            "log_prob of a wrapper with the stored state", other(inputs(5)).log_prob(target), first
        )


def _calibration(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Check that `calibrate` changes no parameters, and that log_prob is finite after it, also for equal targets."""
    for label_kind, labelled in {"ordinary": batches(row), "all equal": _equal_targets(row)}.items():
        wrapper = make()
        before = {name: parameter.clone() for name, parameter in wrapper.named_parameters()}
        wrapper.calibrate(labelled)
        for name, parameter in wrapper.named_parameters():
            worst.same_bits(
                f"parameter {name} after calibrate, targets {label_kind}", parameter, before[name]
            )
        with torch.no_grad():
            log_prob = wrapper(inputs(5)).log_prob(values(row.target, (5,)))
        worst.finite(f"log_prob after calibrate, targets {label_kind}", log_prob)


def _trains_itself(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Check a wrapper that trains its models itself (`SelfTraining`): repeatable training, and held-out predictions.

    The training must change the parameters and no global random state. The mean loss that it returns must be finite,
    and held-out predictions must exist for every sample that is tried.
    """
    features, target = inputs(60), values(row.target, (60,))
    losses, log_probs = [], []
    for _ in range(2):
        wrapper = make()
        if not isinstance(wrapper, SelfTraining):
            worst.count(False, "the wrapper does not train its models itself")
            return
        before = [parameter.detach().clone() for parameter in wrapper.parameters()]
        state = torch.get_rng_state()
        losses.append(
            torch.tensor(wrapper.train_models(features, target, seed=SEED, batch_size=16, most_steps=20))
        )
        worst.count(not torch.equal(torch.get_rng_state(), state), "training changes torch's random state")
        same = [torch.equal(old, new) for old, new in zip(before, wrapper.parameters(), strict=True)]
        worst.count(all(same), "training changes no parameter")
        wrapper.eval()
        with torch.no_grad(), held_out(wrapper, {"row": torch.arange(50, 60)}):
            log_probs.append(wrapper(features[50:]).log_prob(target[50:]))
        worst.same("shape of held-out log_prob of 10 samples", tuple(log_probs[-1].shape), (10,))
    worst.finite("mean loss of samples that a model did not see", losses[0])
    worst.same_bits("mean loss of a second training with the same seed", losses[1], losses[0])
    worst.finite("held-out log_prob", log_probs[0])
    worst.same_bits("held-out log_prob after a second training", log_probs[1], log_probs[0])


def _equal_targets(row: WrapperRow) -> list[Batch]:
    return [{**batch, "target": torch.zeros_like(batch["target"])} for batch in batches(row)]


def _check_densities(
    densities_by_name: dict[str, Distribution], check: Callable[[Distribution, Worst], None], worst: Worst
) -> None:
    for description, density in densities_by_name.items():
        worst.rows = [f"{description}, row {number}" for number in range(*density.batch_shape)]
        with torch.no_grad():
            check(density, worst)


def _identity(
    build_identity: Callable[[Callable[[], Predictor]], Uncertainty], row: WrapperRow, worst: Worst
) -> None:
    """Check that a wrapper with the row's `identity` parameters equals the wrapped model to the last bit."""
    seed(SEED)
    member = Plain(row.target).eval()
    wrapper = build_identity(lambda: member).eval()
    target, features = values(row.target, (64,)), 4 * inputs(64)  # locations several turns from each other
    with torch.no_grad():
        whole, alone = wrapper(features), member(features)
        worst.same_bits("log_prob", whole.log_prob(target), alone.log_prob(target))
        worst.same_bits("mode", whole.mode, alone.mode)
        worst.same_bits("loss", wrapper.loss(features, target), member.loss(features, target))
