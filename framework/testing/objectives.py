"""Contract tests of an objective: one function for each property; each records its largest error."""

import copy
from collections.abc import Callable, Iterable, Iterator

import torch
from torch import Tensor, nn
from torch.distributions import Distribution
from torch.nn.functional import softplus

from framework.data import Batch
from framework.distributions.batch_shapes import Stacked
from framework.errors import ConfigError, UserError
from framework.model import Predictor, independent_penalty
from framework.objective import Objective
from framework.target import Target
from framework.testing.devices import Calls, OneDevice, check_devices
from framework.testing.finding import SEED, Finding, Worst, run_check
from framework.testing.head_subject import values
from framework.testing.metrics import place_size, simplest_density
from framework.testing.plain import LENGTH
from framework.testing.rows import ObjectiveRow

Make = Callable[[float], Objective]
"""Function that builds the contract row's objective, with its weight multiplied by the given factor."""
SAMPLES = 12
"""Number of samples of a batch."""
STEPS = (1e-5, 1e-6, 1e-7, 1e-8)
"""Step lengths of central differences."""
MANY = 130
"""Number of samples of a large batch."""
MEMBERS = "combine the penalties of members, (batch, member), by framework.model.independent_penalty"
"""Advice for an objective with wrong gradients of members."""
SECOND_PASS = (
    "put a further pass through the predictor into a block of "
    "framework.calibration.module_flags.set_flag(predictor, BATCH_NORM, 'track_running_stats', False)"
)
"""Advice for an objective that changes the running moments of batch norm."""
DRAWS = 8
"""Number of seeds over which the penalty of an objective that draws random numbers is averaged."""


class Network(nn.Module):
    """Small network with batch norm, which has state, and dropout, which draws random numbers.

    It returns the `simplest_density` for the target. Its last layer computes the location (of classes: the logits) and
    the breadth of this density.

    Attributes:
        gain: Factor on the raw parameters, which can make them extreme.
    """

    def __init__(self, target: Target) -> None:
        super().__init__()
        self.target = target
        self.first = nn.Linear(LENGTH, 8)
        self.norm = nn.BatchNorm1d(8)
        self.dropout = nn.Dropout(0.2)
        self.last = nn.Linear(8, place_size(target) + 1)
        self.gain = 1.0

    def forward(self, inputs: Tensor) -> Distribution:
        numbers = inputs / 255 if inputs.dtype == torch.uint8 else inputs
        hidden = self.norm(self.first(numbers.to(self.first.weight.dtype)).tanh())
        raw = self.gain * self.last(self.dropout(hidden))
        return simplest_density(self.target, raw[..., :-1], 1 + softplus(raw[..., -1]))


class Members(Predictor):
    """Predictor for checks of an objective: an ensemble of `count` networks, or one network if `count` is None."""

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
        densities = [network(inputs) for network in self.networks]
        return Stacked(densities) if self.several else densities[0]

    def calibrate(self, batches: Iterable[Batch]) -> None:
        pass

    def amplify(self, gain: float) -> None:
        """Set the factor on the raw parameters of every network."""
        for network in self.networks:
            assert isinstance(network, Network)
            network.gain = gain


def examine_objective(row: ObjectiveRow, build: Make) -> Iterator[Finding]:
    """Yield one finding for each property of an objective, checked on small predictors of the row's target.

    Args:
        row: Contract row of the objective.
        build: Function that builds the objective with its weight multiplied by a given factor.
    """
    checks: dict[str, tuple[float, Callable[[Worst], None]]] = {
        "on the device of its inputs": (0.0, lambda worst: _on_one_device(build, row, worst)),
        "a finite scalar": (0.0, lambda worst: _scalar(build, row, worst)),
        "gradient": (1e-5, lambda worst: _gradient(build, row, worst)),
        "weight is a factor": (1e-6, lambda worst: _weight(build, row, worst)),
        "same seed, same bits": (0.0, lambda worst: _repeatable(build, row, worst)),
        "no side effects": (0.0, lambda worst: _side_effects(build, row, worst)),
        "order does not matter": (1e-5, lambda worst: _order(build, row, worst)),
        "every sample counts": (0.0, lambda worst: _each_sample(build, row, worst)),
        "a mean over samples": (1e-5, lambda worst: _mean(build, row, worst)),
        "equal members train like one model": (1e-5, lambda worst: _members(build, row, worst)),
        "different members train separately": (1e-5, lambda worst: _different_members(build, row, worst)),
        "terms to be logged": (0.0, lambda worst: _logged_terms(build, row, worst)),
        "later random numbers follow the seed": (0.0, lambda worst: _generator(build, row, worst)),
        "NaN is not hidden": (0.0, lambda worst: _nan(build, row, worst)),
        "number types": (0.0, lambda worst: _number_types(build, row, worst)),
        "extreme raw parameters": (0.0, lambda worst: _extreme(build, row, worst)),
        "empty and single batches": (0.0, lambda worst: _small(build, row, worst)),
    }
    for name, (limit, check) in checks.items():
        if name not in row.leave_out:
            yield run_check(name, row.limits.get(name, limit), check)


def predictor_of(row: ObjectiveRow, count: int | None = None) -> Members:
    """Return `Members` in training mode, with the same parameters at each call.

    Args:
        row: row of the objective.
        count: number of networks of an ensemble; None for a predictor that is one network.
    """
    torch.manual_seed(SEED)
    predictor = Members(row.target, count)
    predictor(batch_of(row, 32)["input"])  # sets the running moments of batch norm
    return predictor


def batch_of(row: ObjectiveRow, count: int) -> Batch:
    """Return a seeded batch of `count` samples, with the further fields that the objective reads."""
    generator = torch.Generator().manual_seed(SEED + 2)
    return {
        "input": torch.randn(count, LENGTH, generator=generator),
        "target": values(row.target, (count,)),
        "index": torch.arange(count),
        "group": torch.zeros(count, dtype=torch.int64),
        **{name: make(count) for name, make in row.fields.items()},
    }


def in_float64(batch: Batch) -> Batch:
    """Return the batch with floating-point fields converted to float64."""
    return {name: field.double() if field.is_floating_point() else field for name, field in batch.items()}


def penalty(objective: Objective, predictor: Predictor, batch: Batch) -> Tensor:
    """Return the penalty of an objective on a batch, with a fixed random seed."""
    torch.manual_seed(SEED)
    return objective(predictor, batch)


def gradients(objective: Objective, predictor: Predictor, batch: Batch) -> dict[str, Tensor]:
    """Return name → gradient of the penalty, for every parameter with a gradient."""
    predictor.zero_grad()
    value = penalty(objective, predictor, batch)
    if value.requires_grad:
        value.backward()
    return {
        name: parameter.grad.clone()
        for name, parameter in predictor.named_parameters()
        if parameter.grad is not None
    }


def _on_one_device(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check that the penalties of one model and of three members mix no devices."""

    def calls(mode: OneDevice) -> Calls:
        for count in (None, 3):
            objective, predictor = build(1.0), predictor_of(row, count)
            mode.label_module(predictor)
            mode.label_module(objective)
            batch = mode.label_device(batch_of(row, SAMPLES))

            @torch.enable_grad()
            def train(
                objective: Objective = objective, predictor: Members = predictor, batch: Batch = batch
            ) -> None:
                penalty(objective, predictor, batch)

            yield "one model" if count is None else f"{count} members", train

    check_devices(calls, worst)


def _scalar(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    for count in (None, 3):
        predictor = predictor_of(row, count)
        value = penalty(build(1.0), predictor, batch_of(row, SAMPLES))
        predictor_name = "one model" if count is None else f"{count} members"
        worst.same(f"shape of the penalty of {predictor_name}", tuple(value.shape), ())
        worst.finite(f"penalty of {predictor_name}", value)
        worst.count(not value.requires_grad, f"the penalty of {predictor_name} has no gradient")
        gradients_by_name = gradients(build(1.0), predictor, batch_of(row, SAMPLES))
        for name, gradient in gradients_by_name.items():
            worst.finite(f"gradient of {name}", gradient)
        worst.count(
            not any(gradient.abs().sum() > 0 for gradient in gradients_by_name.values()),
            f"every gradient of {predictor_name} is 0",
        )


def _gradient(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Compare a directional derivative in all parameters with central differences, in evaluation mode and float64.

    Of several step lengths, the one with the smallest error counts: a longer step may cross a kink or be too coarse for
    a narrow density, and a shorter one loses digits to rounding.
    """
    objective, predictor = build(1.0), predictor_of(row).eval().double()
    batch = in_float64(batch_of(row, SAMPLES))
    analytic_gradients = gradients(objective, predictor, batch)
    generator = torch.Generator().manual_seed(SEED)
    parameters = dict(predictor.named_parameters())
    direction = {
        name: torch.randn(parameter.shape, dtype=torch.float64, generator=generator)
        for name, parameter in parameters.items()
    }
    analytic = sum(
        ((analytic_gradients[name] * direction[name]).sum().item() for name in analytic_gradients), 0.0
    )

    def penalty_at(amount: float) -> float:
        other = copy.deepcopy(predictor)
        with torch.no_grad():
            for name, parameter in other.named_parameters():
                parameter.add_(amount * direction[name])
        return penalty(objective, other, batch).item()

    numeric_by_step = [(penalty_at(step) - penalty_at(-step)) / (2 * step) for step in STEPS]
    numeric = min(numeric_by_step, key=lambda derivative: abs(analytic - derivative))
    worst.record(
        abs(analytic - numeric) / max(abs(numeric), 1e-3),
        f"directional derivative {analytic:.9g}, by differences {numeric:.9g}",
    )


def _weight(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    batch = batch_of(row, SAMPLES)
    unit_penalty = penalty(build(1.0), predictor_of(row), batch).item()
    for factor in (0.25, 3.0, 1e6):
        value = penalty(build(factor), predictor_of(row), batch).item()
        worst.record(
            abs(value - factor * unit_penalty) / max(abs(factor * unit_penalty), 1e-12),
            f"penalty with {factor:g} times the weight: {value:.9g}, expected {factor * unit_penalty:.9g}",
        )
    try:
        weightless = build(0.0)
    except ConfigError:
        worst.count(False, "a weight of 0 is refused")
        return
    value = penalty(weightless, predictor_of(row), batch).item()
    worst.count(value != 0, f"penalty with weight 0: {value:g}")


def _repeatable(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    batch, objective = batch_of(row, SAMPLES), build(1.0)
    penalties = [
        penalty(used_objective, predictor_of(row), batch)
        for used_objective in (objective, objective, build(1.0))
    ]
    worst.same_bits("penalty of two calls", penalties[1], penalties[0])
    worst.same_bits("penalty of two equal objectives", penalties[2], penalties[0])


def _side_effects(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check that a penalty changes no training modes, buffers, parameters, gradients or fields of the batch."""
    for training in (True, False):
        predictor, batch = predictor_of(row), batch_of(row, SAMPLES)
        predictor.train(training)
        first = predictor.networks[0]
        assert isinstance(first, Network)
        first.norm.train(not training)  # a module in another mode than the predictor, as a user may set it
        modes = {name: module.training for name, module in predictor.named_modules()}
        state = copy.deepcopy(predictor.state_dict())
        before = {name: field.clone() for name, field in batch.items()}
        penalty(build(1.0), predictor, batch)
        after = {name: module.training for name, module in predictor.named_modules()}
        changed = [name for name in modes if after[name] != modes[name]]
        worst.count(bool(changed), f"training modes changed: {', '.join(changed) or 'none'}")
        for name, value in predictor.state_dict().items():
            worst.same_bits(
                f"{name} after a penalty, {'training' if training else 'evaluation'} mode"
                + (f"; {SECOND_PASS}" if ".norm." in name else ""),
                value,
                state[name],
            )
        for name, parameter in predictor.named_parameters():
            worst.count(parameter.grad is not None, f"{name} has a gradient after a penalty")
            worst.count(not parameter.requires_grad, f"{name} no longer requires a gradient")
        worst.same("fields of the batch", sorted(batch), sorted(before))
        for name, field in before.items():
            worst.same_bits(f"{name} of the batch", batch[name], field)
            worst.count(batch[name].requires_grad, f"{name} of the batch requires a gradient after a penalty")


def _order(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check in evaluation mode that the order of samples does not matter; in training, dropout depends on it."""
    predictor, batch = predictor_of(row).eval(), batch_of(row, SAMPLES)
    backwards = {name: field.flip(0) for name, field in batch.items()}
    expected = penalty(build(1.0), predictor, batch).item()
    backwards_penalty = penalty(build(1.0), predictor, backwards).item()
    worst.record(
        abs(backwards_penalty - expected) / max(abs(expected), 1e-6),
        f"penalty in reverse order {backwards_penalty:.9g}, in order {expected:.9g}",
    )


def _each_sample(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check in evaluation mode that the first, middle and last of MANY samples each affect the penalty."""
    objective, predictor, batch = build(1.0), predictor_of(row).eval(), batch_of(row, MANY)
    expected = penalty(objective, predictor, batch).item()

    def changed(at: slice) -> bool:
        other = {**batch, "input": batch["input"].clone(), "target": batch["target"].clone()}
        other["input"][at] = 1.5 - 2 * batch["input"].flip(0)[at]
        other["target"][at] = (1 + batch["target"][at]) % max(2, len(row.target.names))
        return penalty(objective, predictor, other).item() != expected

    if not changed(slice(None)):
        worst.count(False, "the objective does not read the batch")
        return
    for at in (0, MANY // 2, MANY - 1):
        worst.count(not changed(slice(at, at + 1)), f"sample {at} of {MANY} does not affect the penalty")


def _mean(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check that a batch that contains every sample twice has the same penalty as with every sample once.

    For an objective that draws random numbers, penalties are averaged over DRAWS seeds, and an error of 0.4 is
    tolerated.
    """
    objective, predictor, batch = build(1.0), predictor_of(row).eval(), batch_of(row, SAMPLES)
    twice = {name: torch.cat([field, field]) for name, field in batch.items()}
    penalties = []
    for repeated in (batch, twice):
        values = []
        for number in range(DRAWS):
            torch.manual_seed(number)
            values.append(objective(predictor, repeated).item())
        penalties.append(values)
    expected, doubled = (sum(values) / DRAWS for values in penalties)
    error = abs(doubled - expected) / max(abs(expected), 1e-6)
    if len(set(penalties[0])) > 1:
        error = max(0.0, error - 0.4)
    worst.record(error, f"penalty with every sample twice {doubled:.9g}, once {expected:.9g}")


def _different_members(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check without dropout that the penalty of an ensemble is the mean of its members' penalties.

    The gradient in the parameters of each member must be that of the member's own penalty.
    """
    objective, together, batch = build(1.0), predictor_of(row, 3).eval(), batch_of(row, SAMPLES)
    whole = gradients(objective, together, batch)
    joint_penalty, member_penalties = penalty(objective, together, batch).item(), []
    for index, network in enumerate(together.networks):
        alone = predictor_of(row).eval()
        alone.networks[0].load_state_dict(network.state_dict())
        member_penalties.append(penalty(objective, alone, batch).item())
        for name, gradient in gradients(objective, alone, batch).items():
            other = whole.get(name.replace("networks.0", f"networks.{index}"), torch.zeros_like(gradient))
            scale = gradient.abs().max().clamp(min=1e-6)
            worst.record(
                (other - gradient).abs().max() / scale, f"gradient of member {index}, {name}; {MEMBERS}"
            )
    expected = sum(member_penalties) / len(member_penalties)
    worst.record(
        abs(joint_penalty - expected) / max(abs(expected), 1e-6),
        f"penalty of three members {joint_penalty:.9g}, mean of their penalties {expected:.9g}",
    )


def _logged_terms(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check that logged terms are finite scalars without a graph."""
    objective = build(1.0)
    penalty(objective, predictor_of(row), batch_of(row, SAMPLES))
    worst.count(False, "the objective logs no terms")
    for name, term in objective.logged_terms.items():
        worst.same(f"shape of {name}", tuple(term.shape), ())
        worst.count(term.requires_grad, f"{name} is not detached from the graph")
        worst.finite(name, term)


def _generator(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check that random numbers drawn after a penalty depend on the seed that was set before the penalty."""
    objective, predictor, batch = build(1.0), predictor_of(row).eval(), batch_of(row, SAMPLES)
    random_numbers = []
    for number in (0, 1):
        torch.manual_seed(number)
        objective(predictor, batch)
        random_numbers.append(torch.rand(4))
    worst.count(torch.equal(*random_numbers), "random numbers after a penalty are equal for two seeds")


def _nan(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check that a network that returns NaN gets a non-finite penalty or is refused."""
    predictor = predictor_of(row).eval()
    with torch.no_grad():
        for network in predictor.networks:
            assert isinstance(network, Network)
            network.last.weight.fill_(float("nan"))
    try:
        value = penalty(build(1.0), predictor, batch_of(row, SAMPLES))
    except (ValueError, UserError):
        worst.count(False, "NaN is refused")
        return
    worst.count(
        bool(value.isfinite()),
        f"penalty {value.item():g} for a network that returns NaN, expected NaN or an error",
    )


def _members(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check without dropout an ensemble of equal members: its penalty must be that of a single member.

    The gradient in the parameters of each member must also be that of a single member.
    """
    alone = predictor_of(row).eval()
    together = predictor_of(row, 3).eval()
    for network in together.networks:
        network.load_state_dict(alone.networks[0].state_dict())
    batch, objective = batch_of(row, SAMPLES), build(1.0)
    expected, joint_penalty = (
        penalty(objective, alone, batch).item(),
        penalty(objective, together, batch).item(),
    )
    worst.record(
        abs(joint_penalty - expected) / max(abs(expected), 1e-6),
        f"penalty of three equal members {joint_penalty:.9g}, of one {expected:.9g}",
    )
    alone_gradients, joint_gradients = (
        gradients(objective, alone, batch),
        gradients(objective, together, batch),
    )
    for name, gradient in alone_gradients.items():
        for index in range(3):
            other = joint_gradients.get(
                name.replace("networks.0", f"networks.{index}"), torch.zeros_like(gradient)
            )
            scale = gradient.abs().max().clamp(min=1e-6)
            worst.record(
                (other - gradient).abs().max() / scale, f"gradient of member {index}, {name}; {MEMBERS}"
            )


def _number_types(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check that the penalty has the predictor's dtype, and that it is finite for inputs as bytes."""
    objective = build(1.0)
    for kind in (torch.float32, torch.float64):
        predictor = predictor_of(row).to(kind)
        batch = batch_of(row, SAMPLES)
        typed = {
            name: field.to(kind) if field.is_floating_point() else field for name, field in batch.items()
        }
        value = penalty(objective, predictor, typed)
        worst.same(f"dtype of the penalty for a predictor of {kind}", value.dtype, kind)
        worst.finite(f"penalty for a predictor of {kind}", value)
        bytes_ = torch.randint(0, 256, typed["input"].shape, dtype=torch.uint8)
        worst.finite(
            f"penalty for inputs as bytes, {kind}", penalty(objective, predictor, {**typed, "input": bytes_})
        )


def _extreme(build: Make, row: ObjectiveRow, worst: Worst) -> None:
    """Check that penalty and gradients are finite if the raw parameters are multiplied by up to 1e4."""
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
    """Check that penalties of an empty batch and of a single sample are finite scalars.

    The check runs in evaluation mode, since batch norm cannot train on one sample.
    """
    for count in (0, 1):
        predictor = predictor_of(row).eval()
        value = penalty(build(1.0), predictor, batch_of(row, count))
        worst.same(f"shape of the penalty of {count} samples", tuple(value.shape), ())
        worst.count(
            not bool(value.isfinite()),
            f"penalty of {count} samples: {value.item():g}, expected a finite number",
        )
