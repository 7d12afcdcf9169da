"""Contract tests of a density head: one function for each property; each reports its worst case.

The properties of the head's densities are checked in framework.testing.densities.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.density_head import DensityHead, Fitted
from framework.distributions.circular import Circular, wrap
from framework.distributions.density import Mixture
from framework.distributions.protocol import images, median, pick
from framework.geometry.srgb import linear_from_srgb
from framework.target import Target
from framework.testing.devices import OneDevice, Questions, on_one_device
from framework.testing.finding import SEED, Finding, Worst, examined, seed
from framework.testing.rows import HeadRow

BATCH_SHAPES = ((), (4,), (3, 2), (0,))
SIZES = (0.0, 1e-38, 1e-20, 1e-8, 1e-3, 1.0, 30.0, 1e3, 1e10, 1e20, 1e30)
"""Sizes of distribution parameters, beside the largest of the dtype, as a diverging network may produce them."""


MANY_ROWS = 300
"""Number of rows of a batch whose first and last rows are also predicted alone."""
MOST_COLUMNS = 24
"""Largest number of distribution parameters that are each changed alone."""
PATIENCE = 20.0
"""Limit of processor time for one check, seconds."""


@dataclass
class HeadSubject:
    """Row of a density head, and how to build the head; every head that is built has the same parameters.

    Attributes:
        row: Row of the contract.
        build: Function that builds the head for the row's target.
        seconds: Limit of processor time for a check; 1 s after one check has not ended in time.
        of: Function that builds the head for another target; None where the target's unit is not checked.
        only: Name of the one property to check; "" for all.
    """

    row: HeadRow
    build: Callable[[], DensityHead]
    seconds: float = PATIENCE
    of: Callable[[Target], DensityHead] | None = None
    only: str = ""

    def examined(self, name: str, limit: float, look: Callable[[Worst], None]) -> Finding:
        """Run one check, with the row's limit where it has its own, and return the finding."""
        found = examined(name, self.row.limits.get(name, limit), look, seconds=self.seconds)
        if found.worst.startswith("TooSlow"):
            self.seconds = 1.0
        return found

    def wants(self, name: str) -> bool:
        """Return whether a property is to be checked."""
        return name not in self.row.leave_out and self.only in ("", name)

    def make(self) -> DensityHead:
        """Return a new head in evaluation mode."""
        seed(SEED)
        return self.build().eval()

    @cached_property
    def size(self) -> int:
        """Number of distribution parameters that the head reads."""
        with torch.random.fork_rng(devices=[]):
            return self.make().size

    def raws(self, *batch: int) -> Tensor:
        """Return seeded normal distribution parameters (*batch, size), float32."""
        generator = torch.Generator().manual_seed(SEED)
        return torch.randn(*batch, self.size, generator=generator)

    def values(self, *batch: int) -> Tensor:
        """Return seeded targets: angles over several turns, reals of size 1, labels."""
        return values(self.row.target, batch)

    def draws(self) -> bool:
        """Return whether log_prob draws random numbers: it differs between seeds at the same inputs."""
        try:
            with torch.no_grad():
                head, raw, value = self.make(), self.raws(4), self.values(4)
                found = []
                for number in (0, 1):
                    seed(number)
                    found.append(head(raw).log_prob(value))
            return not torch.equal(*found)
        except Exception:  # the checks themselves report the error
            return False


def ready(head: DensityHead, target: Target) -> DensityHead:
    """Return the head, after `fit` on seeded features and targets where it needs one.

    A head without a fixed number of features is fitted to four.
    """
    if isinstance(head, Fitted):
        features = torch.randn(200, head.size or 4, generator=torch.Generator().manual_seed(SEED))
        head.fit(features, values(target, (200,)), SEED)
    return head


def values(target: Target, batch: tuple[int, ...]) -> Tensor:
    """Return seeded targets: angles over several turns, labels, or reals of size 1 in the target's unit."""
    generator = torch.Generator().manual_seed(SEED + 1)
    if target.kind == "class":
        return torch.randint(len(target.names), batch, generator=generator)
    scale = 6.0 if target.kind == "angle" else 1.0
    found = scale * torch.randn(*batch, *target.event_shape, generator=generator)
    if target.scale:
        found = torch.tensor(target.location).double() + torch.tensor(target.scale).double() * found
    return found


def examine_head(subject: HeadSubject) -> Iterator[Finding]:
    """Yield one finding for each property of the head itself, cheapest first."""
    from framework.testing.gradients import gradient, proper
    from framework.testing.precision import precision, reference
    from framework.testing.units import TOLERANCE, units

    checks = (
        ("on the device of its inputs", 0.0, _on_one_device),
        ("batch shapes", 0.0, _shapes),
        ("number types", 0.0, _number_types),
        ("NaN and infinity refused", 0.0, _refuses_non_finite),
        ("same seed, same bits", 0.0, _repeatable),
        ("rows of a batch apart", 0.0, _rows_apart),
        ("state-dict round trip", 0.0, _round_trip),
        ("mixture of one is the component", 0.0, _mixture_of_one),
        ("knobs turn", 0.0, _knobs),
        ("finite for any raw numbers", 0.0, _finite_anywhere),
        ("calibrate does not harm", 1e-5, _calibrated),
        ("calibrate reads every row alike", 1e-5, _calibrated_backwards),
        ("every raw number counts", 0.0, _all_read),
        ("loss is in nats", 1e-5, _loss_in_nats),
        ("several values at once", 1e-5, _several_values),
        ("target's unit", TOLERANCE, units),
        ("loss gradient", 1e-6, gradient),
        ("loss is least for its own density", 6.0, proper),
        ("float32 against float64", 32.0, precision),
        ("log_prob, float64", 1e-12, lambda subject, worst: reference(subject, worst, torch.float64)),
        ("log_prob, float32", 2e-6, lambda subject, worst: reference(subject, worst, torch.float32)),
    )
    for name, limit, check in checks:
        if not subject.wants(name) or (name.startswith("log_prob") and subject.row.cases is None):
            continue
        if name == "target's unit" and (subject.of is None or subject.row.target.kind != "real"):
            continue
        yield subject.examined(name, limit, lambda worst, check=check: check(subject, worst))


def _on_one_device(subject: HeadSubject, worst: Worst) -> None:
    """Check losses, calibration and every function of the densities for mixed devices."""
    from framework.testing.questions import every_question

    def make(mode: OneDevice) -> Questions:
        head = subject.make()
        mode.move(head)
        raw, value = mode.receive((subject.raws(2), subject.values(2)))
        pairs = mode.receive(subject.raws(1, 2))
        index = mode.receive(torch.tensor([[0], [1], [0]]))
        temperature = mode.receive(torch.tensor(1.7, dtype=torch.float64))

        @torch.enable_grad()
        def trained() -> None:
            head.train().loss(raw.clone().requires_grad_(), value)

        yield "loss", trained
        head.eval()
        yield "calibrate", lambda: head.calibrate(raw, value)
        yield "log_prob of targets", lambda: head(raw).log_prob(value)
        yield "pick", lambda: pick(head(pairs), index).sample()
        yield from every_question(head(raw), index, temperature)

    on_one_device(make, worst)


def _shapes(subject: HeadSubject, worst: Worst) -> None:
    """Check batches of any shape, also empty ones, and finite gradients of losses in the distribution parameters."""
    target = subject.row.target
    event = target.event_shape
    for batch in BATCH_SHAPES:
        head, raw, value = subject.make(), subject.raws(*batch).requires_grad_(), subject.values(*batch)
        loss = head.train().loss(raw, value)
        worst.same(f"shape of the loss of a batch {batch}", tuple(loss.shape), batch)
        loss.sum().backward()
        if raw.grad is None:
            worst.see(math.inf, "the loss does not depend on the raw numbers")
            return
        worst.finite(f"gradient of the loss, batch {batch}", raw.grad)
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
            worst.count(angles != (target.kind == "angle"), f"support: {density.support} of {target.kind}")
            if target.kind == "image":
                shapes["color"] = (images(density, {"color"})["color"].shape, (*batch, *event))
                light = linear_from_srgb(density.mean)
                worst.same_bits("color: light of the mean", images(density, {"color"})["color"], light)
            if target.kind == "class":
                labels = density.enumerate_support(expand=False).flatten().tolist()
                worst.same("labels", labels, list(range(len(target.names))))
            for what, (found, wanted) in shapes.items():
                worst.same(f"{what} of a batch {batch}", tuple(found), wanted)


def _number_types(subject: HeadSubject, worst: Worst) -> None:
    """Check that float64 stays float64 and that half precision is converted to float32."""
    float32, float64 = torch.float32, torch.float64
    wanted = {float64: float64, float32: float32, torch.float16: float32, torch.bfloat16: float32}
    for given, computed in wanted.items():
        head = subject.make().to(computed)
        value = as_type(subject.values(4), computed)
        with torch.no_grad():
            density = head(subject.raws(4).to(given))
            worst.same(f"log_prob of {given} raw numbers", density.log_prob(value).dtype, computed)
            worst.finite(f"log_prob of {given} raw numbers", density.log_prob(value))
            if value.is_floating_point():
                worst.same(f"samples of {given} raw numbers", density.sample().dtype, computed)


def _refuses_non_finite(subject: HeadSubject, worst: Worst) -> None:
    """Check that NaN and infinity raise a ValueError that names the first bad batch row."""
    head = subject.make()
    for bad in (math.nan, math.inf, -math.inf):
        for column in range(0, head.size, max(1, head.size // 7)):
            raw = subject.raws(5)
            raw[3, column] = bad
            raw[4] = bad
            try:
                head(raw)
            except ValueError as error:
                worst.count("3" not in str(error), f"{bad} in row 3, column {column}: {error}")
            else:
                worst.count(True, f"{bad} in row 3, column {column} was accepted")


def _repeatable(subject: HeadSubject, worst: Worst) -> None:
    """Check that results repeat, also after calls with other inputs, in training and in evaluation mode."""
    raw, value = subject.raws(4), subject.values(4)

    def everything(head: DensityHead) -> dict[str, Tensor]:
        seed(SEED)
        density = head.eval()(raw)
        return {
            "log_prob": density.log_prob(value),
            "sample": density.sample(torch.Size((3,))),
            "loss": head.train().loss(raw, value),
        }

    with torch.no_grad():
        head = subject.make()
        first = everything(head)
        density, many = head.eval()(raw), torch.Size((64,))
        seed(SEED)
        worst.count(torch.equal(density.sample(many), density.sample(many)), "two draws are the same")
        head.eval()(2 + 3 * raw).sample()
        head.train().loss(2 + 3 * raw, value)
        for what, other in {"two runs": head, "two heads": subject.make()}.items():
            for name, again in everything(other).items():
                worst.same_bits(f"{name} of {what}", again, first[name])


def _rows_apart(subject: HeadSubject, worst: Worst) -> None:
    """Check that a row's results do not depend on other rows, and that its loss has no gradient in them.

    Where nothing is drawn, results must not depend on the number of rows either.
    """
    found = []
    for factor in (1.0, -3.0):
        head, raw, value = subject.make(), subject.raws(4), subject.values(4)
        raw[[0, 1, 3]] *= factor
        with torch.no_grad():
            seed(SEED)
            density = head(raw)
            found.append({"log_prob": density.log_prob(value)[2], "mode": density.mode[2].float()})
            entropies = []
            for number in (0, 1):
                seed(number)
                entropies.append(density.entropy()[2])
            if torch.equal(*entropies):  # nothing is drawn
                found[-1]["entropy"] = entropies[0]
            for name in ("mean", "variance"):
                with suppress(NotImplementedError, AttributeError):
                    found[-1][name] = getattr(density, name)[2].float()
            seed(SEED)
            found[-1]["loss"] = head.train().loss(raw, value)[2]
    if not subject.draws():
        head, raw, value = subject.make(), subject.raws(MANY_ROWS), subject.values(MANY_ROWS)
        with torch.no_grad():
            for start in (0, MANY_ROWS - 3):
                few = slice(start, start + 3)
                whole, part = head(raw), head(raw[few])
                where = f"of rows {start} to {start + 2} among {MANY_ROWS}"
                for name, big, small in (
                    ("log_prob", whole.log_prob(value)[few], part.log_prob(value[few])),
                    ("mode", whole.mode[few].float(), part.mode.float()),
                ):
                    gap = (big - small).abs() > 1e-4 * small.abs().clamp(min=1)
                    worst.count(gap, f"{name} {where}")
            grid, line = head(raw[:6].unflatten(0, (3, 2))), head(raw[:6])
            value = value[:6]
            big, small = grid.log_prob(value.unflatten(0, (3, 2))).flatten(), line.log_prob(value)
            gap = (big - small).abs() > 1e-4 * small.abs().clamp(min=1)
            worst.count(gap, "log_prob of a batch (3, 2), of one (6,)")
    for name in found[0].keys() & found[1].keys():
        alone = found[0][name]
        gap = (found[1][name] - alone).abs() > 1e-5 * alone.abs().clamp(min=1)
        worst.count(gap, f"{name} of row 2 where the others change")
    raw = subject.raws(4).requires_grad_()
    subject.make().train().loss(raw, subject.values(4))[2].backward()
    if raw.grad is None:
        worst.see(math.inf, "the loss does not depend on the raw numbers")
        return
    worst.see(raw.grad[[0, 1, 3]].abs(), lambda at: f"gradient of row 2's loss in row {[0, 1, 3][at[0]]}")


def _round_trip(subject: HeadSubject, worst: Worst) -> None:
    """Check that `calibrate` changes buffers only, and that a new head with the stored state gives the same bits."""
    head, raw, value = subject.make(), subject.raws(32), subject.values(32)
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
        worst.same_bits("log_prob of the stored state", other(raw).log_prob(value), first)


def _mixture_of_one(subject: HeadSubject, worst: Worst) -> None:
    """Check that framework.distributions.density.Mixture of one component equals the component, to the last bit."""
    head, raw, value = subject.make(), subject.raws(4), subject.values(4)
    with torch.no_grad():
        found = {}
        for number in (1, 2):
            seed(SEED)
            density = head(raw) if number == 1 else Mixture(torch.zeros(4, 1), head(raw.unsqueeze(-2)))
            found[number] = {"log_prob": density.log_prob(value), "mode": density.mode}
            seed(SEED)
            found[number]["entropy"] = density.entropy()
            seed(SEED)
            found[number]["sample"] = density.sample(torch.Size((3,)))
        for name, alone in found[1].items():
            worst.same_bits(name, found[2][name], alone)


def _knobs(subject: HeadSubject, worst: Worst) -> None:
    """Check that values of the knobs are in ascending order and that the smallest two can be set and work."""
    head = subject.make()
    worst.count(False, "none declared")
    for name, dial in head.knobs.items():
        worst.same(f"order of {name}", list(dial), sorted(dial))
        for setting in dial[:2]:
            setattr(head, name, setting)
            with torch.no_grad():
                worst.finite(
                    f"log_prob with {name} = {setting}", head(subject.raws(3)).log_prob(subject.values(3))
                )


def _finite_anywhere(subject: HeadSubject, worst: Worst) -> None:
    """Check that densities, losses and gradients are finite at distribution parameters of any finite size."""
    for dtype in (torch.float32, torch.float64):
        head = subject.make().to(dtype)
        for size in (*SIZES, torch.finfo(dtype).max):
            raw = subject.raws(8).sign().to(dtype) * size
            raw[:2], raw[2:4] = size, -size
            value = as_type(subject.values(8), dtype)
            where = f"{str(dtype)[6:]}, raw numbers of size {size:.3g}"
            with torch.no_grad():
                density = head.eval()(raw)
                worst.finite(f"log_prob: {where}", density.log_prob(value))
                worst.finite(f"mode: {where}", density.mode)
                worst.finite(f"samples: {where}", density.sample())
            raw.requires_grad_()
            loss = head.train().loss(raw, value)
            worst.finite(f"loss: {where}", loss)
            loss.sum().backward()
            worst.finite(f"gradient of the loss: {where}", torch.zeros(1) if raw.grad is None else raw.grad)


def _calibrated(subject: HeadSubject, worst: Worst) -> None:
    """Check that `calibrate` does not lower the mean log_prob of its data; relative above 1 nat.

    Its data are targets that are independent of the distribution parameters, and draws from the head's own densities:
    as drawn, three times nearer to the mode, and three times farther. For the draws a loss of a hundredth is allowed.
    """
    if subject.draws():
        worst.count(False, "draws in log_prob")
        return
    sets = {"any targets": None, "its draws": 1.0, "near ones": 1 / 3, "far ones": 3.0}
    for what, spread in sets.items():
        head, raw, value = subject.make(), subject.raws(64), subject.values(64)
        if spread is not None and (head.direct or isinstance(head, Fitted)):  # random numbers are no features
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
        # a calibration that fits, for example, intervals need not maximise the likelihood
        loss = loss if spread is None else 1e-3 * loss
        worst.see(loss, f"{what}: {before.item():.6g} before, {after.item():.6g} after")


def _calibrated_backwards(subject: HeadSubject, worst: Worst) -> None:
    """Check that `calibrate` does not depend on the order of rows.

    Real targets of the second half of the rows are doubled.
    """
    if subject.draws():
        worst.count(False, "draws in log_prob")
        return
    raw, value = subject.raws(64), subject.values(64)
    if value.is_floating_point() and subject.row.target.kind == "real":
        value[32:] = 2 * value[32:]
    found = []
    with torch.no_grad():
        for order in (torch.arange(64), torch.arange(63, -1, -1)):
            head = subject.make()
            head.calibrate(raw[order], value[order])
            found.append(head(raw).log_prob(value).double())
    gap = (found[0] - found[1]).abs() / found[0].abs().clamp(min=1)
    worst.see(gap, "log_prob after rows in reversed order")


def _all_read(subject: HeadSubject, worst: Worst) -> None:
    """Check that each distribution parameter changes the loss of some target at some size."""
    head, columns = subject.make().double().train(), range(subject.size)
    if head.direct or isinstance(head, Fitted):
        worst.count(False, "it reads features, which are not made for it")
        return
    unread = set(columns)
    for size in (0.3, 1.0, 3.0):
        raw, value = (size * subject.raws(8)).double(), as_type(subject.values(8), torch.float64)
        with torch.no_grad():
            seed(SEED)
            before = head.loss(raw, value)
            for column in sorted(unread)[:MOST_COLUMNS]:
                other = raw.clone()
                other[:, column] = 0.4 - 0.9 * raw[:, column]
                seed(SEED)
                if not torch.equal(head.loss(other, value), before):
                    unread.remove(column)
            if len(unread) > max(0, subject.size - MOST_COLUMNS):
                continue
            unread = set()
            break
    worst.count(bool(unread), f"raw numbers that change no loss: {sorted(unread)[:8]}")


def _loss_in_nats(subject: HeadSubject, worst: Worst) -> None:
    """Check that a loss that is a multiple of -log_prob plus a constant has the factor 1; relative to log_prob.

    Whether the loss is such a multiple is decided at draws of the head's own densities. Such a loss must fit log_prob
    also at values that are hardly ever drawn.
    """
    if subject.draws():
        worst.count(False, "draws in log_prob, of which the loss may be a bound")
        return
    head, raw = subject.make().double(), subject.raws(6).double()
    with torch.no_grad():
        density = head.eval()(raw)
        seed(SEED)
        drawn = density.sample(torch.Size((24,)))
        seed(SEED)
        others = as_type(subject.values(8, 6), drawn.dtype)
        if subject.row.target.kind != "class":
            others[:4], others[4:] = 10 * others[:4], 1e4 * others[4:]
        value = torch.cat([drawn, others])
        log_prob = density.log_prob(value).double()
        loss = torch.stack([head.train().loss(raw, one) for one in value]).double()
    near, far = log_prob[:24], log_prob[24:]
    offset = near - near.mean(0)
    factor = -(offset * loss[:24]).sum(0) / offset.square().sum(0).clamp(min=1e-300)
    constant = (loss + factor * log_prob)[:24].mean(0)
    rest = (loss + factor * log_prob - constant).abs()
    size = 1 + log_prob.abs()
    fits = ((rest / size)[:24].amax(0) < 1e-9) & (offset.abs().amax(0) > 1e-3)
    worst.count(False, "another loss than log_prob")
    # the loss of an image may be the mean over its numbers
    share = density.event_shape.numel() if subject.row.target.kind == "image" else 1
    gap = torch.where(fits, torch.minimum((factor - 1).abs(), (share * factor - 1).abs()), 0.0)
    worst.see(gap, lambda at: f"{factor[at].item():.4g} times -log_prob, row {at[0]}")
    gap = torch.where(fits & far.isfinite(), (rest / size)[24:], 0.0)
    worst.see(gap, lambda at: f"loss is {loss[24:][at].item():.6g} where log_prob is {far[at].item():.6g}")


def _several_values(subject: HeadSubject, worst: Worst) -> None:
    """Check that log_prob of values (5, *batch) equals that of each value alone."""
    with torch.no_grad():
        density, value = subject.make()(subject.raws(4)), subject.values(5, 4)
        found = density.log_prob(value)
        if subject.draws():
            worst.count(False, "draws in log_prob")
            return
        alone = torch.stack([density.log_prob(one) for one in value])
    gap = (found - alone).abs() / alone.abs().clamp(min=1)
    worst.see(gap, lambda at: f"value {at[0]} of row {at[1]}")


def seeded(head: DensityHead, raw: Tensor) -> Distribution:
    """Return the density of distribution parameters, with the same random numbers at each call if it draws any."""
    seed(SEED)
    return head(raw)


def as_type(value: Tensor, dtype: torch.dtype) -> Tensor:
    """Convert a floating-point tensor to the dtype; return any other tensor as it is."""
    return value.to(dtype) if value.is_floating_point() else value
