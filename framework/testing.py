"""The contract of density heads and densities as checks: a row of parameters buys every one of them.

`check_head(make, target)` runs everything that needs no reference; the others take one. A check raises an
AssertionError that names the worst case and the limit it broke, and seeds torch's generator if it draws.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.circular import angular_distance
from framework.density import circular, marginal, median
from framework.density_head import DensityHead
from framework.target import Target

SEED = 20260
BATCH_SHAPES = ((), (4,), (3, 2), (0,))


def check_head(make: Callable[[], DensityHead], target: Target) -> None:
    """Every check of a head that needs no reference, on seeded normal raw numbers."""
    torch.manual_seed(SEED)
    check_knobs(make(), target)
    check_shapes(make(), target)
    check_dtypes(make, target)
    check_extremes(make(), target)
    check_refuses_non_finite(make())
    check_repeatable(make(), target)
    check_rows_are_apart(make(), target)
    check_round_trip(make, target)
    check_gradient(make(), target)


def check_shapes(head: DensityHead, target: Target) -> None:
    """Batches of any shape, also empty, give densities of that shape and losses with finite gradients."""
    event = () if target.kind == "class" else (len(target.names),)
    for batch in BATCH_SHAPES:
        raw, value = raws(head, batch), values(target, batch)
        raw.requires_grad_()
        loss = head.train().loss(raw, value)
        _same("shape of the loss", tuple(loss.shape), batch)
        loss.sum().backward()
        assert raw.grad is not None, "the loss does not depend on the raw numbers"
        _finite("gradient of the loss", raw.grad, f"batch shape {batch}")
        with torch.no_grad():
            density = head.eval()(raw)
            _same("batch_shape", tuple(density.batch_shape), batch)
            _same("event_shape", tuple(density.event_shape), event)
            several = values(target, (5, *batch))
            _same("shape of log_prob", tuple(density.log_prob(value).shape), batch)
            _same("shape of log_prob of several values", tuple(density.log_prob(several).shape), (5, *batch))
            _same("shape of sample()", tuple(density.sample().shape), (*batch, *event))
            _same("shape of sample((2, 3))", tuple(density.sample((2, 3)).shape), (2, 3, *batch, *event))
            if 0 not in batch:
                _same("shape of mode", tuple(density.mode.shape), (*batch, *event))
                _same("shape of entropy", tuple(density.entropy().shape), batch)
                _finite("entropy", density.entropy(), f"batch shape {batch}")
                _same("shape of the median", tuple(_median(density).shape), (*batch, *event))


def check_dtypes(make: Callable[[], DensityHead], target: Target) -> None:
    """float64 stays float64, half precision is upcast to float32."""
    expected = {
        torch.float64: torch.float64,
        torch.float32: torch.float32,
        torch.float16: torch.float32,
        torch.bfloat16: torch.float32,
    }
    for given, wanted in expected.items():
        head = make().eval()
        if given == torch.float64:
            head = head.double()
        value = values(target, (4,))
        value = value.to(wanted) if value.is_floating_point() else value
        with torch.no_grad():
            log_prob = head(raws(head, (4,)).to(given)).log_prob(value)
        _same(f"dtype of log_prob for {given} raw numbers", log_prob.dtype, wanted)
        _finite("log_prob", log_prob, f"{given}")


def check_extremes(head: DensityHead, target: Target) -> None:
    """Raw numbers of any finite size give finite log-densities and losses with finite gradients."""
    for dtype in (torch.float32, torch.float64):
        head = head.to(dtype)
        for size in (0.0, 1e-38, 1e-20, 1e-3, 30.0, 1e3, 1e10, 1e20, 1e30, torch.finfo(dtype).max):
            raw = raws(head, (16,)).sign().to(dtype) * size
            raw[:4] = size
            value = values(target, (16,))
            value = value.to(dtype) if value.is_floating_point() else value
            where = f"{dtype}, raw numbers of size {size:g}"
            with torch.no_grad():
                _finite("log_prob", head.eval()(raw).log_prob(value), where)
            raw.requires_grad_()
            loss = head.train().loss(raw, value)
            _finite("loss", loss, where)
            loss.sum().backward()
            assert raw.grad is not None
            _finite("gradient of the loss", raw.grad, where)


def check_refuses_non_finite(head: DensityHead) -> None:
    """NaN and infinity are refused with a ValueError that names the first bad batch row."""
    for bad in (math.nan, math.inf, -math.inf):
        for column in range(0, head.size, max(1, head.size // 7)):
            raw = raws(head, (5,))
            raw[3, column] = bad
            raw[4] = bad
            try:
                head.eval()(raw)
            except ValueError as error:
                assert "3" in str(error), f"wanted the bad row, 3, in the message, got: {error}"
            else:
                raise AssertionError(f"raw numbers with {bad} in row 3, column {column} were accepted")


def check_repeatable(head: DensityHead, target: Target) -> None:
    """The same seed gives the same bits: log_prob, samples and loss."""
    raw, value = raws(head, (4,)), values(target, (4,))

    def everything() -> list[Tensor]:
        torch.manual_seed(SEED)
        density = head.eval()(raw)
        return [density.log_prob(value), density.sample((3,)), head.train().loss(raw, value)]

    with torch.no_grad():
        for name, first, second in zip(
            ("log_prob", "sample", "loss"), everything(), everything(), strict=True
        ):
            assert torch.equal(first, second), f"{name} differs between two runs of one seed"


def check_rows_are_apart(head: DensityHead, target: Target) -> None:
    """A row's gradient stays in its row: no density depends on its neighbours in the batch."""
    raw, value = raws(head, (4,)).requires_grad_(), values(target, (4,))
    head.train().loss(raw, value)[2].backward()
    assert raw.grad is not None
    leaked = raw.grad[[0, 1, 3]].abs().max().item()
    assert leaked == 0, f"the loss of row 2 has a gradient of {leaked:g} in another row; wanted 0"


def check_round_trip(make: Callable[[], DensityHead], target: Target) -> None:
    """calibrate changes buffers only; a fresh head with the stored state gives the same bits."""
    head = make().eval()
    raw, value = raws(head, (32,)), values(target, (32,))
    before = {name: parameter.clone() for name, parameter in head.named_parameters()}
    with torch.no_grad():
        head.calibrate(raw, value)
        changed = [
            name for name, parameter in head.named_parameters() if not torch.equal(parameter, before[name])
        ]
        assert not changed, f"calibrate changed the parameters {changed}; wanted buffers only"
        other = make().eval()
        other.load_state_dict(head.state_dict())
        torch.manual_seed(SEED)
        first = head(raw).log_prob(value)
        torch.manual_seed(SEED)
        second = other(raw).log_prob(value)
    assert torch.equal(first, second), (
        f"log_prob after a round trip differs by {(first - second).abs().max():g}"
    )


def check_knobs(head: DensityHead, target: Target) -> None:
    """Every knob is an attribute that may be set at any time, its values ascending; the smallest two work."""
    for name, dial in head.knobs.items():
        _same(f"order of knob {name}", list(dial), sorted(dial))
        kept = getattr(head, name)
        for setting in dial[:2]:
            setattr(head, name, setting)
            with torch.no_grad():
                log_prob = head.eval()(raws(head, (3,))).log_prob(values(target, (3,)))
            _finite("log_prob", log_prob, f"{name} = {setting}")
        setattr(head, name, kept)


def check_gradient(head: DensityHead, target: Target, *, step: float = 1e-5, limit: float = 1e-6) -> None:
    """The loss's directional derivatives in raw numbers and parameters against central differences."""
    head = head.double().train()
    raw, value = raws(head, (3,)).double(), values(target, (3,))
    value = value.double() if value.is_floating_point() else value
    raw.requires_grad_()
    arguments = [raw, *(parameter for parameter in head.parameters() if parameter.requires_grad)]

    def loss() -> Tensor:
        torch.manual_seed(SEED)
        return head.loss(raw, value).sum()

    gradients = torch.autograd.grad(loss(), arguments, allow_unused=True)
    for number, (argument, gradient) in enumerate(zip(arguments, gradients, strict=True)):
        torch.manual_seed(number)
        direction = torch.randn_like(argument)
        direction = direction / direction.norm()
        analytic = 0.0 if gradient is None else (gradient * direction).sum().item()
        ends = []
        with torch.no_grad():
            for sign in (1, -1):
                argument += sign * step * direction
                ends.append(loss().item())
                argument -= sign * step * direction
        numeric = (ends[0] - ends[1]) / (2 * step)
        error = abs(analytic - numeric) / max(1.0, abs(numeric))
        what = "raw numbers" if number == 0 else f"parameter {number}"
        assert error <= limit, (
            f"gradient in {what} {analytic:.9g}, by differences {numeric:.9g}: {error:.2g} > limit {limit:g}"
        )


def check_log_prob(density: Distribution, value: Tensor, reference: Tensor, *, limit: float) -> None:
    """log_prob against an independent reference; error relative to max(1, |reference|)."""
    found = density.log_prob(value)
    _same("shape of log_prob", tuple(found.shape), tuple(reference.shape))
    error = (found.double() - reference).abs() / reference.abs().clamp(min=1)
    _worst(
        "log_prob", error, limit, lambda at: f"{found[at].item():.9g}, reference {reference[at].item():.9g}"
    )


def check_normalised(density: Distribution, *, points: int = 1024, limit: float = 1e-5) -> None:
    """The density integrates to 1: over one or two angles, one real, or all classes."""
    _, mass = _cells(density, points, 1)
    error = (mass.sum(0) - 1).abs()
    _worst("integral of the density - 1", error, limit, lambda at: f"batch row {at}")


def check_periodic(density: Distribution, value: Tensor, *, limit: float) -> None:
    """Angles are read modulo a turn: log_prob is the same up to a thousand turns on."""
    here = density.log_prob(value)
    for turns in (1, -1, 7, -1000):
        error = (density.log_prob(value + turns * 2 * math.pi) - here).abs() / here.abs().clamp(min=1)
        _worst(f"log_prob {turns} turns on", error, limit, lambda at: f"batch row {at}")


def check_samples(
    density: Distribution, *, draws: int = 20_000, cells: int = 12, points: int = 1020, limit: float = 5.0
) -> None:
    """Samples fall as log_prob says: Pearson's χ² over cells of one or two numbers, in standard deviations.

    Each cell's mass is integrated on points/cells points a side; cells expecting below five draws are one.
    """
    torch.manual_seed(SEED)
    sampled = density.sample(torch.Size((draws,)))
    borders, mass = _cells(density, points, points // cells)
    where = torch.zeros(sampled.shape[: 1 + len(density.batch_shape)], dtype=torch.int64)
    for number, border in enumerate(borders):
        inside = sampled[..., number] if density.event_shape else sampled
        if density.support is circular:
            inside = torch.remainder(inside.double() + math.pi, 2 * math.pi) - math.pi
        found = torch.bucketize(inside.double(), border[1:-1].double(), right=True)
        where = where * (len(border) - 1) + found
    expected = (draws * mass).flatten(1)
    counted = torch.stack([(where == cell).double().sum(0) for cell in range(len(mass))]).flatten(1)
    rare = expected < 5
    chi_square = ((counted - expected).square() / expected).where(~rare, 0).sum(0)
    rest, rest_counted = expected.where(rare, 0).sum(0), counted.where(rare, 0).sum(0)
    chi_square = chi_square + (rest_counted - rest).square() / rest.clamp(min=5)
    freedom = (~rare).sum(0).clamp(min=1)
    score = (chi_square - freedom) / (2 * freedom).sqrt()
    _worst("χ² of the samples", score, limit, lambda at: f"standard deviations, batch row {at}")


def check_marginal(density: Distribution, *, points: int = 512, limit: float = 1e-5) -> None:
    """marginal(density, i) of two angles is the joint density integrated over the other angle."""
    axis = _angles(points)
    first, second = torch.meshgrid(axis, axis, indexing="ij")
    grid = torch.stack([first, second], -1).reshape(points, points, *(1,) * len(density.batch_shape), 2)
    joint = density.log_prob(grid.expand(points, points, *density.batch_shape, 2)).double().exp()
    alone = axis.reshape(points, *(1,) * len(density.batch_shape), 1).expand(points, *density.batch_shape, 1)
    for index in (0, 1):
        wanted = joint.sum(1 - index) * (2 * math.pi / points)
        found = marginal(density, index).log_prob(alone).double().exp()
        error = (found - wanted).abs() / wanted.amax(0).clamp(min=1)
        _worst(f"marginal {index}", error, limit, lambda at: f"grid point and batch row {at}")


def check_median(density: Distribution, *, points: int = 2048, limit: float = 1e-3) -> None:
    """median() of one angle: none on a grid has an expected deviation smaller by `limit` radians."""
    torch.manual_seed(SEED)
    axis = _angles(points)
    shape = (points, *(1,) * len(density.batch_shape))
    mass = density.log_prob(axis.reshape(*shape, 1).expand(points, *density.batch_shape, 1)).double().exp()
    mass = mass / mass.sum(0)
    chosen = (angular_distance(_median(density).double()[..., 0], axis.double().reshape(shape)) * mass).sum(0)
    best = torch.stack(
        [
            (angular_distance(angle, axis).double().reshape(shape) * mass).sum(0)
            for angle in axis[:: points // 256]
        ]
    ).amin(0)
    _worst("deviation of the median above the best", chosen - best, limit, lambda at: f"batch row {at}")


def raws(head: DensityHead, batch: tuple[int, ...]) -> Tensor:
    """Seeded normal raw numbers for a head, (*batch, size)."""
    generator = torch.Generator().manual_seed(SEED)
    return torch.randn(*batch, head.size, generator=generator)


def values(target: Target, batch: tuple[int, ...]) -> Tensor:
    """Seeded targets: angles over several turns, reals of size 1, labels."""
    generator = torch.Generator().manual_seed(SEED + 1)
    if target.kind == "class":
        return torch.randint(len(target.names), batch, generator=generator)
    scale = 6.0 if target.kind == "angle" else 1.0
    return scale * torch.randn(*batch, len(target.names), generator=generator)


def _cells(density: Distribution, points: int, inside: int) -> tuple[list[Tensor], Tensor]:
    """Borders per number, and the mass (cell, *batch) of every cell of `inside` points a side."""
    batch = density.batch_shape
    if density.event_shape == ():
        classes = density.enumerate_support()
        return [torch.arange(len(classes) + 1) - 0.5], density.log_prob(classes).double().exp()
    numbers = density.event_shape[0]
    middle = (torch.arange(points, dtype=torch.float64) + 0.5) / points
    ends = torch.arange(points // inside + 1, dtype=torch.float64) * inside / points
    if density.support is circular:
        if numbers > 2:
            raise ValueError(f"quadrature covers one or two angles, got {numbers}; pass a marginal.")
        axis, slope, borders = (
            (middle * 2 - 1) * math.pi,
            torch.full_like(middle, 2 * math.pi),
            (ends * 2 - 1) * math.pi,
        )
    elif numbers == 1:
        # the real line as a circle: x = scale tan(πt) around zero
        scale = 3.0
        axis = scale * torch.tan(math.pi * (middle - 0.5))
        slope = scale * math.pi * (1 + (axis / scale).square())
        borders = scale * torch.tan(math.pi * (ends - 0.5))
    else:
        raise ValueError(f"quadrature covers one real number, got {numbers}; pass a marginal.")
    axes = torch.meshgrid(*[axis] * numbers, indexing="ij")
    weight = torch.stack(torch.meshgrid(*[slope / points] * numbers, indexing="ij")).prod(0)
    grid = torch.stack(axes, -1).reshape(-1, *(1,) * len(batch), numbers)
    log_density = density.log_prob(grid.expand(-1, *batch, numbers)).double()
    mass = log_density.exp() * weight.reshape(-1, *(1,) * len(batch))
    side = points // inside
    mass = mass.reshape(*(side, inside) * numbers, *batch)
    mass = mass.sum(tuple(range(1, 2 * numbers, 2)))
    return [borders] * numbers, mass.reshape(side**numbers, *batch)


def _angles(points: int) -> Tensor:
    return -math.pi + 2 * math.pi / points * torch.arange(points)


def _median(density: Distribution) -> Tensor:
    return median(density, 2000)


def _same(what: str, found: object, wanted: object) -> None:
    assert found == wanted, f"{what} is {found}, wanted {wanted}"


def _finite(what: str, found: Tensor, where: str) -> None:
    bad = (~found.isfinite()).sum().item()
    assert bad == 0, f"{what} is not finite in {bad} of {found.numel()} numbers ({where})"


def _worst(what: str, error: Tensor, limit: float, describe: Callable[[tuple[int, ...]], str]) -> None:
    if error.numel() == 0:
        return
    flat = error.flatten()
    worst = (flat.where(flat.isfinite(), torch.inf)).argmax()
    at = tuple(int(index) for index in torch.unravel_index(worst, error.shape))
    assert flat[worst] <= limit, f"{what}: worst {flat[worst].item():.3g} > limit {limit:g} ({describe(at)})"
