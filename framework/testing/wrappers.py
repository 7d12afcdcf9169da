"""Contract tests of an uncertainty wrapper: one function for each property; each reports its worst case.

The properties of its calibration are checked in framework.testing.calibration.
"""

import copy
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from framework.data import Batch
from framework.distributions.circular import Circular
from framework.model import Predictor
from framework.target import Target
from framework.testing import densities as asked
from framework.testing.devices import OneDevice, Questions, on_one_device
from framework.testing.finding import SEED, Finding, Worst, examined, seed
from framework.testing.heads import values
from framework.testing.metrics import density_about, numbers_about
from framework.testing.rows import WrapperRow
from framework.uncertainty import Uncertainty

Make = Callable[[], Uncertainty]
Build = Callable[[Target], Uncertainty]
"""Function that builds the row's wrapper around `Plain`, for the row's target in any unit."""
LENGTH = 6
UNITS = ((200.0, 50.0), (-3.0, 1e-3))
"""Locations and scales of real targets, beside 0 and 1."""


class Plain(Predictor):
    """Model to wrap: one linear layer to place and breadth of the simplest density of the target's kind.

    The effect of `calibrate` does not depend on the samples. A wrapper around this model can therefore be compared with
    a wrapper around a model that was calibrated before.

    Attributes:
        calibrated: Buffer that is 1 after `calibrate`, else 0.
    """

    calibrated: Tensor

    def __init__(self, target: Target) -> None:
        super().__init__()
        self.target = target
        self.dropout = nn.Dropout(0.1)  # for wrappers that need a dropout layer
        self.layer = nn.Linear(LENGTH, numbers_about(target) + 1)
        self.register_buffer("calibrated", torch.zeros(()))

    def forward(self, inputs: Tensor) -> Distribution:
        numbers = self.layer(self.dropout(inputs))
        place, breadth = numbers[..., :-1], (1 + numbers[..., -1].sigmoid()) * (1 + self.calibrated / 2)
        if self.target.scale:
            location, scale = (
                torch.tensor(part).to(place) for part in (self.target.location, self.target.scale)
            )
            place, breadth = location + scale * place, scale[0] * breadth
        return density_about(self.target, place, breadth)

    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        return -self(inputs).log_prob(target)

    def training_densities(self, inputs: Tensor) -> Distribution:
        return self(inputs)

    def calibrate(self, batches: Iterable[Batch]) -> None:
        rows = sum(
            len(batch["target"]) for batch in batches
        )  # an iterator that was read before yields no rows
        self.calibrated.fill_(float(rows > 0))


def wrapped(wrapper: Uncertainty) -> list[Plain]:
    """Return the models inside the wrapper; none where it keeps their parameters in another form."""
    return [module for module in wrapper.modules() if isinstance(module, Plain)]


def examine_wrapper(
    row: WrapperRow, build: Build, build_identity: Callable[[Callable[[], Predictor]], Uncertainty] | None
) -> Iterator[Finding]:
    """Yield one finding for each property of a wrapper around `Plain`, new for each check.

    Args:
        row: Row of the contract.
        build: Function that builds the row's wrapper for a target.
        build_identity: Function that builds the wrapper around a given model such that it must equal that model; None
            where it cannot.
    """
    from framework.testing.calibration import Calibration

    def make() -> Uncertainty:
        seed(SEED)
        return build(row.target).eval()

    checks: dict[str, tuple[float, Callable[[Worst], None]]] = {
        "on the device of its inputs": (0.0, lambda worst: _on_one_device(make, row, worst)),
        "densities": (0.0, lambda worst: _densities(make, row, worst)),
        "number types": (0.0, lambda worst: _number_types(make, row, worst)),
        "same seed, same bits": (0.0, lambda worst: _repeatable(make, row, worst)),
        "rows of a batch apart": (1e-5, lambda worst: _rows_apart(make, row, worst)),
        "leaves no trace": (0.0, lambda worst: _traces(make, row, worst)),
        "knobs turn": (0.0, lambda worst: _knobs(make, row, worst)),
        "loss and its gradient": (0.0, lambda worst: _loss(make, row, worst)),
        "loss trains all it wraps": (0.0, lambda worst: _trains(make, row, worst)),
        "training densities": (1e-5, lambda worst: _training_densities(make, row, worst)),
        "state-dict round trip": (
            0.0,
            lambda worst: _round_trip(make, lambda: build(row.target), row, worst),
        ),
        "calibration": (0.0, lambda worst: _calibration(make, row, worst)),
    }
    calibration = Calibration(row, build)
    checks |= {name: (limit, check) for name, limit, check in calibration.checks()}
    # the mode of a mixture of densities is the best of some candidates
    limit = 1e-6 if row.target.kind == "class" else 0.2
    checks["mode"] = (limit, lambda worst: _of_densities(calibration.many, asked.mode_is_highest, worst))
    for name, limit, check in questions(row.target):
        checks[name] = (limit, lambda worst, check=check: _of_densities(calibration.densities, check, worst))
    if build_identity is not None:
        checks["one member is the member"] = (0.0, lambda worst: _identity(build_identity, row, worst))
    for name, (limit, check) in checks.items():
        if name not in row.leave_out:
            yield examined(name, row.limits.get(name, limit), check)


def questions(target: Target) -> Iterator[tuple[str, float, asked.Check]]:
    """Yield name, limit and check of each property in framework.testing.densities that suits the target."""
    numbers = 0 if target.kind == "class" else len(target.names)
    yield "integral", 1e-5, asked.integral
    yield "samples follow log_prob", 5.0, asked.samples_follow_log_prob if numbers != 2 else _drawn_on_a_grid
    if numbers == 2:
        yield "samples follow marginals", 5.0, asked.samples_follow_marginals
    yield "entropy", 5.0, asked.entropy
    if target.kind == "angle":
        yield "2π-periodic", 1e-12, asked.periodic
    if numbers == 1:
        yield "median", 5.0, asked.median_is_best
        yield "cdf", 1e-6, asked.masses
    if target.kind == "real" and numbers <= 2:
        yield "mean and variance", 1e-5, asked.moments


def _drawn_on_a_grid(density: Distribution, worst: Worst) -> None:
    """Check that draws follow log_prob; for reals only where the grid resolves the density."""
    broad = bool((density.mode.abs() < 10).all() and (density.entropy() > 0).all())
    if isinstance(density.support, Circular) or broad:
        asked.samples_follow_log_prob(density, worst)
    else:
        worst.count(False, "the grid is too coarse; draws of each number are compared with its marginal")


def in_units(target: Target) -> list[Target]:
    """Return the target; for reals also the same target in other units."""
    if target.kind != "real":
        return [target]
    many = len(target.names)
    others = [replace(target, location=(at,) * many, scale=(scale,) * many) for at, scale in UNITS]
    return [target, *others]


def inputs(count: int, number: int = 0) -> Tensor:
    """Return seeded inputs (count, LENGTH), which differ for each `number`."""
    return torch.randn(count, LENGTH, generator=torch.Generator().manual_seed(SEED + 100 * number))


def batches(row: WrapperRow) -> list[Batch]:
    """Return a small labelled validation set as batches."""
    target = values(row.target, (40,))
    parts = zip(inputs(40).split(16), target.split(16), strict=True)
    return [{"input": some, "target": labels} for some, labels in parts]


def _on_one_device(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Check losses, calibration and every function of the densities after it for mixed devices."""
    from framework.testing.questions import every_question

    def questions(mode: OneDevice) -> Questions:
        wrapper = make()
        mode.move(wrapper)
        given, labels = mode.receive((inputs(4), values(row.target, (4,))))
        labelled = mode.receive(batches(row))
        index = mode.receive(torch.zeros(3, 1, dtype=torch.int64))
        temperature = mode.receive(torch.tensor(1.7, dtype=torch.float64))

        @torch.enable_grad()
        def trained() -> None:
            wrapper.train().loss(given, labels)
            density = wrapper.training_densities(given)
            density.log_prob(density.sample())

        yield "loss", trained
        wrapper.eval()
        yield "log_prob of targets", lambda: wrapper(given).log_prob(labels)
        yield "calibrate", lambda: wrapper.calibrate(labelled)
        yield from every_question(wrapper(given), index, temperature)

    on_one_device(questions, worst)


def _densities(make: Make, row: WrapperRow, worst: Worst) -> None:
    event = row.target.event_shape
    wrapper = make()
    with torch.no_grad():
        for count in (0, 1, 5):
            density = wrapper(inputs(count))
            target = values(row.target, (count,))
            worst.same(f"batch_shape of {count}", tuple(density.batch_shape), (count,))
            worst.same(f"event_shape of {count}", tuple(density.event_shape), event)
            log_prob = density.log_prob(target)
            worst.same(f"log_prob of {count}", tuple(log_prob.shape), (count,))
            worst.finite(f"log_prob of {count}", log_prob)
            if row.target.kind == "angle":
                worst.count(
                    not isinstance(density.support, Circular), f"support: {density.support}, wanted angles"
                )
            if count:
                worst.same(f"sample of {count}", tuple(density.sample().shape), (count, *event))
                worst.same(f"entropy of {count}", tuple(density.entropy().shape), (count,))
                worst.same(f"mode of {count}", tuple(density.mode.shape), (count, *event))


def _number_types(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Check that float64 stays float64, before and after `calibrate`."""
    for kind in (torch.float32, torch.float64):
        wrapper = make().to(kind)
        typed = [
            {name: field.to(kind) if field.is_floating_point() else field for name, field in batch.items()}
            for batch in batches(row)
        ]
        for what in ("as built", "calibrated"):
            if what == "calibrated":
                wrapper.calibrate(typed)
            with torch.no_grad():
                found = wrapper(typed[0]["input"]).log_prob(typed[0]["target"])
            worst.same(f"log_prob of {kind}, {what}", found.dtype, kind)


def _repeatable(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Check that results repeat, also after other inputs and between two wrappers after the same calibration."""
    target = values(row.target, (5,))

    def everything(wrapper: Uncertainty) -> dict[str, Tensor]:
        seed(SEED)
        density = wrapper(inputs(5))
        found = {"log_prob": density.log_prob(target), "mode": density.mode}
        seed(SEED)
        return {**found, "sample": density.sample(), "loss": wrapper.loss(inputs(5), target)}

    with torch.no_grad():
        first, second = make(), make()
        wanted = everything(first)
        first(3 * inputs(7, 1)).sample()
        first.loss(3 * inputs(5, 1), target)
        for what, other in {"after other inputs": first, "of two wrappers": second}.items():
            for name, found in everything(other).items():
                worst.same_bits(f"{name} {what}", found, wanted[name])
    for wrapper in (first, second):
        seed(SEED)
        wrapper.calibrate(batches(row))
    with torch.no_grad():
        wanted = everything(first)
        for name, found in everything(second).items():
            worst.same_bits(f"{name} of two calibrated", found, wanted[name])


def _rows_apart(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Check that results of row 2 do not change with other rows, and that its loss has no gradient in their inputs."""
    wrapper, target, given = make(), values(row.target, (5,)), inputs(5)
    other = torch.where(torch.arange(5).unsqueeze(-1) == 2, given, 1 - 3 * given)
    for what in ("as built", "calibrated"):
        if what == "calibrated":
            wrapper.calibrate(batches(row))
        found: list[dict[str, Tensor]] = []
        with torch.no_grad():
            for some in (given, other):
                seed(SEED)
                density = wrapper(some)
                answers = {"log_prob": density.log_prob(target), "mode": density.mode}
                seed(SEED)
                answers["entropy"] = density.entropy()
                seed(SEED)
                answers["loss"] = wrapper.loss(some, target)
                found.append({name: answer[2].double() for name, answer in answers.items()})
        for name, alone in found[0].items():
            # quadratures of a batch share their nodes, and an entropy may be estimated by draws
            least = 10.0 if name == "entropy" else 1.0
            error = (found[1][name] - alone).abs() / alone.abs().clamp(min=least)
            worst.see(error, f"{name} of row 2 where the others change, {what}")
    reached = inputs(5).requires_grad_()
    seed(SEED)
    wrapper.loss(reached, target)[2].backward()
    if reached.grad is not None:
        worst.see(reached.grad[[0, 1, 3, 4]].abs().max(), "gradient of row 2's loss in the others' inputs")


def _traces(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Check that predictions change no training modes, buffers or parameters, and calibrate no modes."""
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
            worst.same_bits(f"{name} after an answer, training {training}", value, state[name])
        for what in ("an answer", "calibrate"):
            if what == "calibrate":
                wrapper.calibrate(batches(row))
            after = {name: module.training for name, module in wrapper.named_modules()}
            changed = [name or "the wrapper" for name in modes if after.get(name) != modes[name]]
            worst.count(bool(changed), f"modes changed by {what}: {', '.join(changed) or 'none'}")


def _knobs(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Check that values of the knobs are in ascending order and that the smallest two can be set and work."""
    wrapper = make()
    worst.count(False, "none declared")
    for name, dial in wrapper.knobs.items():
        worst.same(f"order of {name}", list(dial), sorted(dial))
        for setting in dial[:2]:
            setattr(wrapper, name, setting)
            with torch.no_grad():
                found = wrapper(inputs(3)).log_prob(values(row.target, (3,)))
            worst.finite(f"log_prob with {name} = {setting}", found)


def _loss(make: Make, row: WrapperRow, worst: Worst) -> None:
    wrapper = make().train()
    loss = wrapper.loss(inputs(8), values(row.target, (8,)))
    worst.same("shape of the loss of 8", tuple(loss.shape), (8,))
    worst.finite("loss", loss)
    loss.sum().backward()
    found = [parameter.grad for parameter in wrapper.parameters() if parameter.grad is not None]
    worst.count(not found, "no parameter has a gradient")
    for gradient in found:
        worst.finite("gradient", gradient)


def _trains(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Check that a small step down the loss improves every model inside, in evaluation mode without dropout."""
    wrapper = make().double()
    given, target = inputs(64).double(), values(row.target, (64,))
    target = target.double() if target.is_floating_point() else target
    models = wrapped(wrapper)

    def lost() -> list[float]:
        with torch.no_grad():
            return [model.loss(given, target).mean().item() for model in models]

    before = lost()
    wrapper.loss(given, target).mean().backward()
    with torch.no_grad():
        for model in models:
            slopes = [part.grad for part in model.parameters() if part.grad is not None]
            length = torch.stack([slope.norm() for slope in slopes]).norm() if slopes else torch.zeros(())
            for part in model.parameters():
                if part.grad is not None:
                    part -= 1e-4 * part.grad / length.clamp(min=1e-12)
    worst.count(False, "keeps no model as it is")
    for number, (first, then) in enumerate(zip(before, lost(), strict=True)):
        worst.count(not then < first, f"loss of model {number}: {first:.9g}, after a step {then:.9g}")


def _training_densities(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Check that training densities are of one model or of every member, and pass gradients to all models inside.

    The log-density of a mixture must lie between those of its members at every value.
    """
    wrapper, target = make(), values(row.target, (5,))
    density = wrapper.training_densities(inputs(5))
    worst.count(
        density.batch_shape[:1] != (5,) or len(density.batch_shape) > 2,
        f"batch_shape {tuple(density.batch_shape)} of 5, wanted (5,) or (5, members)",
    )
    several = len(density.batch_shape) == 2
    value = torch.stack([values(row.target, (5,)), wrapper(inputs(5)).mode, 0 * target])
    parts = density.log_prob(value.unsqueeze(2) if several else value)
    worst.count(not parts.requires_grad, "an objective gets no gradient")
    parts.sum().backward()
    for number, model in enumerate(wrapped(wrapper)):
        reached = any(part.grad is not None and bool(part.grad.any()) for part in model.parameters())
        worst.count(not reached, f"an objective does not reach model {number}")
    if several:
        with torch.no_grad():
            whole, parts = wrapper(inputs(5)).log_prob(value), parts.detach()
        outside = (whole - parts.amax(-1)).maximum(parts.amin(-1) - whole)
        worst.see(outside, lambda at: f"a mixture of what is trained, value {at[0]}, row {at[1]}")


def _round_trip(make: Make, build: Make, row: WrapperRow, worst: Worst) -> None:
    """Check that a stored wrapper gives the same bits, with all that `calibrate` fitted."""
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
        worst.same_bits("log_prob of the stored state", other(inputs(5)).log_prob(target), first)


def _calibration(make: Make, row: WrapperRow, worst: Worst) -> None:
    """Check that `calibrate` keeps parameters and yields finite densities, for ordinary and identical labels."""
    for what, labelled in {"ordinary": batches(row), "all alike": _alike(row)}.items():
        wrapper = make()
        before = {name: parameter.clone() for name, parameter in wrapper.named_parameters()}
        wrapper.calibrate(labelled)
        for name, parameter in wrapper.named_parameters():
            worst.same_bits(f"parameter {name} after calibrate, labels {what}", parameter, before[name])
        with torch.no_grad():
            found = wrapper(inputs(5)).log_prob(values(row.target, (5,)))
        worst.finite(f"log_prob after calibrate, labels {what}", found)


def _alike(row: WrapperRow) -> list[Batch]:
    return [{**batch, "target": torch.zeros_like(batch["target"])} for batch in batches(row)]


def _of_densities(
    found: dict[str, Distribution], check: Callable[[Distribution, Worst], None], worst: Worst
) -> None:
    for what, density in found.items():
        worst.rows = [f"{what}, row {number}" for number in range(*density.batch_shape)]
        with torch.no_grad():
            check(density, worst)


def _identity(
    build_identity: Callable[[Callable[[], Predictor]], Uncertainty], row: WrapperRow, worst: Worst
) -> None:
    """Check that a wrapper with the row's `identity` parameters equals the model that it wraps, to the last bit."""
    seed(SEED)
    member = Plain(row.target).eval()
    wrapper = build_identity(lambda: member).eval()
    target, given = values(row.target, (64,)), 4 * inputs(64)  # places several turns apart
    with torch.no_grad():
        whole, alone = wrapper(given), member(given)
        worst.same_bits("log_prob", whole.log_prob(target), alone.log_prob(target))
        worst.same_bits("mode", whole.mode, alone.mode)
        worst.same_bits("loss", wrapper.loss(given, target), member.loss(given, target))
