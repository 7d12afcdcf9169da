"""Contract tests of an objective: one function for each property; each reports its worst case."""

import copy
from collections.abc import Callable, Iterable, Iterator

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from framework.data import Batch
from framework.distributions.batch_shapes import Stacked
from framework.errors import ConfigError, UserError
from framework.model import Predictor, independent_penalty
from framework.objective import Objective
from framework.target import Target
from framework.testing.devices import OneDevice, Questions, on_one_device
from framework.testing.finding import SEED, Finding, Worst, examined
from framework.testing.heads import values
from framework.testing.metrics import density_about, numbers_about
from framework.testing.rows import ObjectiveRow
from framework.testing.wrappers import LENGTH

Make = Callable[[float], Objective]
"""Function that builds the row's objective with its weight multiplied by a factor."""
SAMPLES = 12
STEPS = (1e-5, 1e-6, 1e-7, 1e-8)
MANY = 130
DRAWS = 8


class Network(nn.Module):
    """Small network with a layer that keeps state and a layer that draws noise: batch norm and dropout."""

    def __init__(self, target: Target) -> None:
        super().__init__()
        self.target = target
        self.first = nn.Linear(LENGTH, 8)
        self.norm = nn.BatchNorm1d(8)
        self.dropout = nn.Dropout(0.2)
        self.last = nn.Linear(8, numbers_about(target))
        self.gain = 1.0
        """Factor on the distribution parameters, which makes them extreme."""

    def forward(self, inputs: Tensor) -> Distribution:
        numbers = inputs / 255 if inputs.dtype == torch.uint8 else inputs
        hidden = self.norm(self.first(numbers.to(self.first.weight.dtype)).tanh())
        return density_about(self.target, self.gain * self.last(self.dropout(hidden)))


class Members(Predictor):
    """Predictor that an objective is checked on: `count` networks that train together, or a single one if None."""

    def __init__(self, target: Target, count: int | None = None) -> None:
        super().__init__()
        self.networks = nn.ModuleList(Network(target) for _ in range(count or 1))
        self.several = count is not None

    def forward(self, inputs: Tensor) -> Distribution:
        return self.training_densities(inputs)

    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        return independent_penalty(
            torch.stack([-network(inputs).log_prob(target) for network in self.networks], 1)
        )

    def training_densities(self, inputs: Tensor) -> Distribution:
        found = [network(inputs) for network in self.networks]
        return Stacked(found) if self.several else found[0]

    def calibrate(self, batches: Iterable[Batch]) -> None:
        pass

    def amplify(self, gain: float) -> None:
        """Set the factor on the distribution parameters of every network."""
        for network in self.networks:
            assert isinstance(network, Network)
            network.gain = gain


def examine_objective(row: ObjectiveRow, build: Make) -> Iterator[Finding]:
    """Yield one finding for each property of an objective on small predictors of `row.target`, new for each check."""
    checks: dict[str, tuple[float, Callable[[Worst], None]]] = {
        "on the device of its inputs": (0.0, lambda worst: _on_one_device(build, row, worst)),
        "a finite scalar": (0.0, lambda worst: _scalar(build, row, worst)),
        "gradient": (1e-5, lambda worst: _gradient(build, row, worst)),
        "weight is a factor": (1e-6, lambda worst: _weight(build, row, worst)),
        "same seed, same bits": (0.0, lambda worst: _repeatable(build, row, worst)),
        "leaves no trace": (0.0, lambda worst: _traces(build, row, worst)),
        "order does not matter": (1e-5, lambda worst: _order(build, row, worst)),
        "every sample counts": (0.0, lambda worst: _each_sample(build, row, worst)),
        "a mean over samples": (1e-5, lambda worst: _mean(build, row, worst)),
        "members train as if alone": (1e-5, lambda worst: _members(build, row, worst)),
        "members that differ": (1e-5, lambda worst: _different_members(build, row, worst)),
        "terms to be logged": (0.0, lambda worst: _told(build, row, worst)),
        "random numbers of others": (0.0, lambda worst: _generator(build, row, worst)),
        "NaN is not hidden": (0.0, lambda worst: _nan(build, row, worst)),
        "number types": (0.0, lambda worst: _number_types(build, row, worst)),
        "extreme raw numbers": (0.0, lambda worst: _extreme(build, row, worst)),
        "empty and single batches": (0.0, lambda worst: _small(build, row, worst)),
    }
    for name, (limit, check) in checks.items():
        if name not in row.leave_out:
            yield examined(name, row.limits.get(name, limit), check)


def predictor_of(row: ObjectiveRow, count: int | None = None) -> Members:
    """Return a predictor in training mode; its initial parameters are the same each time."""
    torch.manual_seed(SEED)
    predictor = Members(row.target, count)
    predictor(batch_of(row, 32)["input"])  # sets the running moments of batch norm
    return predictor


def batch_of(row: ObjectiveRow, count: int) -> Batch:
    """Return a seeded batch: inputs, targets, and the other fields that the row's objective reads."""
    generator = torch.Generator().manual_seed(SEED + 2)
    return {
        "input": torch.randn(count, LENGTH, generator=generator),
        "target": values(row.target, (count,)),
        "index": torch.arange(count),
        "group": torch.zeros(count, dtype=torch.int64),
        **{name: make(count) for name, make in row.fields.items()},
    }


def in_float64(batch: Batch) -> Batch:
    """Convert the floating-point fields of a batch to float64."""
    return {name: field.double() if field.is_floating_point() else field for name, field in batch.items()}


def penalty(objective: Objective, predictor: Predictor, batch: Batch) -> Tensor:
    """Return the penalty after seeding, as the framework seeds every step."""
    torch.manual_seed(SEED)
    return objective(predictor, batch)


def gradients(objective: Objective, predictor: Predictor, batch: Batch) -> dict[str, Tensor]:
    """Return the gradient of every parameter that has one, by name."""
    predictor.zero_grad()
    penalty(objective, predictor, batch).backward()
    return {
        name: parameter.grad.clone()
        for name, parameter in predictor.named_parameters()
        if parameter.grad is not None
    }


def _on_one_device(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check the penalty of one model and of three members for mixed devices."""

    def questions(mode: OneDevice) -> Questions:
        for count in (None, 3):
            objective, predictor = build(1.0), predictor_of(row, count)
            mode.move(predictor)
            mode.move(objective)
            batch = mode.receive(batch_of(row, SAMPLES))

            @torch.enable_grad()
            def trained(
                objective: Objective = objective, predictor: Members = predictor, batch: Batch = batch
            ) -> None:
                penalty(objective, predictor, batch)

            yield "one model" if count is None else f"{count} members", trained

    on_one_device(questions, worst)


def _scalar(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    for count in (None, 3):
        predictor = predictor_of(row, count)
        found = penalty(build(1.0), predictor, batch_of(row, SAMPLES))
        what = "one model" if count is None else f"{count} members"
        worst.same(f"shape of the penalty of {what}", tuple(found.shape), ())
        worst.finite(f"penalty of {what}", found)
        worst.count(not found.requires_grad, f"the penalty of {what} has no gradient")
        seen = gradients(build(1.0), predictor, batch_of(row, SAMPLES))
        for name, gradient in seen.items():
            worst.finite(f"gradient of {name}", gradient)
        worst.count(
            not any(gradient.abs().sum() > 0 for gradient in seen.values()), f"every gradient of {what} is 0"
        )


def _gradient(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check the directional derivative in all parameters against central differences, in evaluation mode and float64.

    Of several steps the one that agrees best counts, as for density heads: a larger step may be too coarse for a narrow
    density or cross a kink, and a smaller one is lost in rounding.
    """
    objective, predictor = build(1.0), predictor_of(row).eval().double()
    batch = in_float64(batch_of(row, SAMPLES))
    found = gradients(objective, predictor, batch)
    generator = torch.Generator().manual_seed(SEED)
    parameters = dict(predictor.named_parameters())
    direction = {
        name: torch.randn(parameter.shape, dtype=torch.float64, generator=generator)
        for name, parameter in parameters.items()
    }
    analytic = sum((found[name] * direction[name]).sum().item() for name in found)

    def moved(amount: float) -> float:
        other = copy.deepcopy(predictor)
        with torch.no_grad():
            for name, parameter in other.named_parameters():
                parameter.add_(amount * direction[name])
        return penalty(objective, other, batch).item()

    found_by = [(moved(step) - moved(-step)) / (2 * step) for step in STEPS]
    numeric = min(found_by, key=lambda one: abs(analytic - one))
    worst.see(
        abs(analytic - numeric) / max(abs(numeric), 1e-3),
        f"directional derivative {analytic:.9g}, by differences {numeric:.9g}",
    )


def _weight(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    batch = batch_of(row, SAMPLES)
    one = penalty(build(1.0), predictor_of(row), batch).item()
    for factor in (0.25, 3.0, 1e6):
        found = penalty(build(factor), predictor_of(row), batch).item()
        worst.see(
            abs(found - factor * one) / max(abs(factor * one), 1e-12),
            f"{factor:g} times the weight: {found:.9g}, wanted {factor * one:.9g}",
        )
    try:
        none = build(0.0)
    except ConfigError:
        worst.count(False, "weight 0 is refused")
        return
    found = penalty(none, predictor_of(row), batch).item()
    worst.count(found != 0, f"weight 0: penalty {found:g}")


def _repeatable(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    batch, objective = batch_of(row, SAMPLES), build(1.0)
    found = [penalty(one, predictor_of(row), batch) for one in (objective, objective, build(1.0))]
    worst.same_bits("penalty of two calls", found[1], found[0])
    worst.same_bits("penalty of two objectives", found[2], found[0])


def _traces(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check that a penalty leaves training modes, buffers, parameters, their gradients and the batch as they are."""
    for training in (True, False):
        predictor, batch = predictor_of(row), batch_of(row, SAMPLES)
        predictor.train(training)
        first = predictor.networks[0]
        assert isinstance(first, Network)
        first.norm.train(not training)  # a mode that differs from the predictor's, as a user may set it
        modes = {name: module.training for name, module in predictor.named_modules()}
        state = copy.deepcopy(predictor.state_dict())
        before = {name: field.clone() for name, field in batch.items()}
        penalty(build(1.0), predictor, batch)
        after = {name: module.training for name, module in predictor.named_modules()}
        changed = [name for name in modes if after[name] != modes[name]]
        worst.count(bool(changed), f"modes changed of {', '.join(changed) or 'none'}")
        for name, value in predictor.state_dict().items():
            worst.same_bits(f"{name} after a penalty, training {training}", value, state[name])
        for name, parameter in predictor.named_parameters():
            worst.count(parameter.grad is not None, f"a gradient is left in {name}")
            worst.count(not parameter.requires_grad, f"{name} needs no gradient any more")
        worst.same("fields of the batch", sorted(batch), sorted(before))
        for name, field in before.items():
            worst.same_bits(f"{name} of the batch", batch[name], field)
            worst.count(batch[name].requires_grad, f"{name} of the batch needs a gradient now")


def _order(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check that the order of samples does not matter; without dropout, whose masks follow batch positions."""
    predictor, batch = predictor_of(row).eval(), batch_of(row, SAMPLES)
    backwards = {name: field.flip(0) for name, field in batch.items()}
    wanted = penalty(build(1.0), predictor, batch).item()
    found = penalty(build(1.0), predictor, backwards).item()
    worst.see(abs(found - wanted) / max(abs(wanted), 1e-6), f"backwards {found:.9g}, forwards {wanted:.9g}")


def _each_sample(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check that the first, middle and last of MANY samples each change the penalty, in evaluation mode."""
    objective, predictor, batch = build(1.0), predictor_of(row).eval(), batch_of(row, MANY)
    wanted = penalty(objective, predictor, batch).item()

    def changed(at: slice) -> bool:
        other = {**batch, "input": batch["input"].clone(), "target": batch["target"].clone()}
        other["input"][at] = 1.5 - 2 * batch["input"].flip(0)[at]
        other["target"][at] = (1 + batch["target"][at]) % max(2, len(row.target.names))
        return penalty(objective, predictor, other).item() != wanted

    if not changed(slice(None)):
        worst.count(False, "reads no sample of the batch")
        return
    for at in (0, MANY // 2, MANY - 1):
        worst.count(not changed(slice(at, at + 1)), f"sample {at} of {MANY} changes nothing")


def _mean(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check that a batch that holds every sample twice has the same penalty, so that the batch size does not scale it.

    The penalty of an objective that draws random numbers is a mean over DRAWS seeds, and a tolerance is added.
    """
    objective, predictor, batch = build(1.0), predictor_of(row).eval(), batch_of(row, SAMPLES)
    twice = {name: torch.cat([field, field]) for name, field in batch.items()}
    found = []
    for some in (batch, twice):
        values = []
        for number in range(DRAWS):
            torch.manual_seed(number)
            values.append(objective(predictor, some).item())
        found.append(values)
    wanted, doubled = (sum(values) / DRAWS for values in found)
    error = abs(doubled - wanted) / max(abs(wanted), 1e-6)
    if len(set(found[0])) > 1:
        error = max(0.0, error - 0.4)
    worst.see(error, f"every sample twice {doubled:.9g}, once {wanted:.9g}")


def _different_members(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check that the penalty of different members is the mean of their penalties; without dropout.

    The gradient of each member must be that of its own penalty.
    """
    objective, together, batch = build(1.0), predictor_of(row, 3).eval(), batch_of(row, SAMPLES)
    whole = gradients(objective, together, batch)
    found, each = penalty(objective, together, batch).item(), []
    for index, network in enumerate(together.networks):
        alone = predictor_of(row).eval()
        alone.networks[0].load_state_dict(network.state_dict())
        each.append(penalty(objective, alone, batch).item())
        for name, gradient in gradients(objective, alone, batch).items():
            other = whole.get(name.replace("networks.0", f"networks.{index}"), torch.zeros_like(gradient))
            scale = gradient.abs().max().clamp(min=1e-6)
            worst.see((other - gradient).abs().max() / scale, f"gradient of member {index}, {name}")
    wanted = sum(each) / len(each)
    worst.see(
        abs(found - wanted) / max(abs(wanted), 1e-6), f"penalty of three {found:.9g}, their mean {wanted:.9g}"
    )


def _told(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check that the terms to be logged are finite scalars of the last batch without a graph."""
    objective = build(1.0)
    penalty(objective, predictor_of(row), batch_of(row, SAMPLES))
    worst.count(False, "none")
    for name, term in objective.logged_terms.items():
        worst.same(f"shape of {name}", tuple(term.shape), ())
        worst.count(term.requires_grad, f"{name} holds the graph of the batch")
        worst.finite(name, term)


def _generator(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check that random numbers drawn after a penalty still depend on the seed set before it."""
    objective, predictor, batch = build(1.0), predictor_of(row).eval(), batch_of(row, SAMPLES)
    drawn = []
    for number in (0, 1):
        torch.manual_seed(number)
        objective(predictor, batch)
        drawn.append(torch.rand(4))
    worst.count(torch.equal(*drawn), "two seeds, and the same random numbers after the penalty")


def _nan(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check that a network that returns NaN has a penalty of NaN or is refused."""
    predictor = predictor_of(row).eval()
    with torch.no_grad():
        for network in predictor.networks:
            assert isinstance(network, Network)
            network.last.weight.fill_(float("nan"))
    try:
        found = penalty(build(1.0), predictor, batch_of(row, SAMPLES))
    except (ValueError, UserError):
        worst.count(False, "refused")
        return
    worst.count(bool(found.isfinite()), f"penalty {found.item():g} of a network that gives NaN")


def _members(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check that equal members have the penalty, and each the gradient, of one alone; without dropout."""
    alone = predictor_of(row).eval()
    together = predictor_of(row, 3).eval()
    for network in together.networks:
        network.load_state_dict(alone.networks[0].state_dict())
    batch, objective = batch_of(row, SAMPLES), build(1.0)
    wanted, found = penalty(objective, alone, batch).item(), penalty(objective, together, batch).item()
    worst.see(
        abs(found - wanted) / max(abs(wanted), 1e-6), f"penalty of three {found:.9g}, of one {wanted:.9g}"
    )
    own, each = gradients(objective, alone, batch), gradients(objective, together, batch)
    for name, gradient in own.items():
        for index in range(3):
            other = each.get(name.replace("networks.0", f"networks.{index}"), torch.zeros_like(gradient))
            scale = gradient.abs().max().clamp(min=1e-6)
            worst.see((other - gradient).abs().max() / scale, f"gradient of member {index}, {name}")


def _number_types(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check that the penalty has the predictor's dtype, and that inputs may be images as bytes."""
    objective = build(1.0)
    for kind in (torch.float32, torch.float64):
        predictor = predictor_of(row).to(kind)
        batch = batch_of(row, SAMPLES)
        typed = {
            name: field.to(kind) if field.is_floating_point() else field for name, field in batch.items()
        }
        found = penalty(objective, predictor, typed)
        worst.same(f"penalty of a predictor of {kind}", found.dtype, kind)
        worst.finite(f"penalty of a predictor of {kind}", found)
        bytes_ = torch.randint(0, 256, typed["input"].shape, dtype=torch.uint8)
        worst.finite(f"penalty of bytes, {kind}", penalty(objective, predictor, {**typed, "input": bytes_}))


def _extreme(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check that penalty and gradients are finite at parameters up to ±1e4, as of an overconfident network."""
    for kind in (torch.float32, torch.float64):
        for size in (1e2, 1e4):
            predictor = predictor_of(row).to(kind)
            predictor.amplify(size)
            batch = batch_of(row, SAMPLES)
            batch = in_float64(batch) if kind == torch.float64 else batch
            worst.finite(f"penalty at ±{size:g}, {kind}", penalty(build(1.0), predictor, batch))
            for name, gradient in gradients(build(1.0), predictor, batch).items():
                worst.finite(f"gradient of {name} at ±{size:g}, {kind}", gradient)


def _small(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check batches of no sample and of one, in evaluation mode, as batch norm cannot train on one sample.

    A batch without samples must not make the loss NaN.
    """
    for count in (0, 1):
        predictor = predictor_of(row).eval()
        found = penalty(build(1.0), predictor, batch_of(row, count))
        worst.same(f"shape of the penalty of {count}", tuple(found.shape), ())
        worst.finite(f"penalty of {count}", found)
