"""Simulated flights in the layout of a user's own: a folder of CSV files, marked as synthetic."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field

from framework.errors import DataError
from framework.flights.physics import Constants, Positive
from framework.flights.trajectories import simulate
from framework.geometry.meshes import stream
from framework.storage import cache
from framework.storage.generated import draw_all, ensure_generated
from plugins.data.table_tennis.contact import Spring
from plugins.data.table_tennis.recordings import COLUMNS, TRUE
from plugins.data.table_tennis.solvers import SolverGaveUp, flight

VERSION = "1"
LONGEST = 1.15
"""Duration of a flight, seconds; it ends earlier where the ball is past the robot, or well below the table."""
PAST, BELOW = 0.4, 0.25
"""Limits at which a flight ends: y, m, and depth below the table, m."""
MEAN = (0.6, -4.1, -0.62, -0.4, 6.0, 1.6, 0.0, 0.0, 0.0)
SPREAD = (0.2, 0.08, 0.05, 0.4, 0.5, 0.25, 40.0, 40.0, 40.0)
"""Standard deviations of the normal state at the start: m, m/s, rad/s.

Flights recorded in the WAM laboratory start like this, with less variation.
"""
JITTER = 5e-5
"""Standard deviation of the time of a frame, s."""
Share = Annotated[float, Field(ge=0, lt=0.5, allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """Settings of the flights that are simulated where no root is given.

    Attributes:
        flights: number of flights.
        noise: standard deviation of the noise of each observed coordinate, m.
        outliers: share of the frames in which something else was taken for the ball.
        dropped: share of the frames that are missing.
        contact: "bounce" takes no time; "spring" is a stiff spring and damper, solved implicitly in 30 ms per flight.
        frequency: Ω of that spring, 1/s.
        damping: ζ of that spring (at 0.04, the ball bounces as high as with `restitution` 0.88).
        generator_seed: seed of everything that is drawn; it does not depend on the seed of the run.
    """

    flights: Annotated[int, Field(ge=4, le=100_000)] = 1000
    noise: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 0.003
    outliers: Share = 0.01
    dropped: Share = 0.03
    contact: Literal["bounce", "spring"] = "bounce"
    frequency: Positive = 3000.0
    damping: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 0.04
    generator_seed: Annotated[int, Field(ge=0, lt=2**31)] = 0


def simulated(what: Simulation, constants: Constants, step: float) -> Path:
    """Return the folder of simulated flights in the cache; it is written now if it is not there.

    Raises:
        DataError: the cache cannot be written, or a solver gave up.
    """
    mark = {"version": VERSION, "step": step, **asdict(what), **asdict(constants)}
    name = stream(what.generator_seed, repr(sorted(mark.items()))).integers(2**62)
    return ensure_generated(
        cache.folder("table_tennis") / f"seed_{what.generator_seed}_{name:016x}",
        mark,
        lambda root: write(root, what, constants, step),
    )


def write(root: Path, what: Simulation, constants: Constants, step: float) -> None:
    """Write flight_00000.csv and so on, with t, x, y, z as observed, and true_x, true_y, true_z."""
    starts = [drawn(stream(what.generator_seed, f"start {number}")) for number in range(what.flights)]
    times = np.arange(0, LONGEST, step)
    jitter = [
        stream(what.generator_seed, f"time {n}").normal(0, JITTER, len(times)) for n in range(what.flights)
    ]
    moments = times + np.clip(jitter, -step / 4, step / 4)
    moments -= moments[:, :1]
    truth = solved(np.stack(starts), moments, what, constants)

    def save(number: int) -> None:
        random = stream(what.generator_seed, f"noise {number}")
        places = truth[number]
        ended = (places[:, 1] > PAST) | (places[:, 2] < constants.surface - BELOW)
        count = int(ended.argmax()) if ended.any() else len(places)
        places = places[:count]
        seen = places + random.normal(0, what.noise, places.shape)
        strange = random.random(count) < what.outliers
        seen = seen + strange[:, None] * random.normal(0, 0.3, places.shape)
        there = random.random(count) >= what.dropped
        there[0] = True
        table = np.column_stack([moments[number, :count], seen, places])[there]
        np.savetxt(
            root / f"flight_{number:05}.csv",
            table,
            "%.6f",
            ",",
            header=",".join((*COLUMNS, *TRUE)),
            comments="",
        )

    draw_all(what.flights, save, "flights of a ball")


def drawn(random: np.random.Generator) -> Float[np.ndarray, "9"]:
    """Return the state at the start of a flight that lands on the table: position, velocity and spin."""
    return np.array(MEAN) + np.array(SPREAD) * np.clip(random.normal(size=9), -2.5, 2.5)


def solved(
    starts: Float[np.ndarray, "flight 9"],
    times: Float[np.ndarray, "flight time"],
    what: Simulation,
    constants: Constants,
) -> Float[np.ndarray, "flight time 3"]:
    """Return the positions without noise.

    Raises:
        DataError: the solver of the stiff contact gave up.
    """
    if what.contact == "bounce":
        found = simulate(torch.from_numpy(starts), torch.from_numpy(times), constants)
        return found[..., :3].numpy()
    spring = Spring(frequency=what.frequency, damping=what.damping)
    try:
        paths = [
            flight(start, moments, constants, spring, method="LSODA").states[:, :3]
            for start, moments in zip(starts, times, strict=True)
        ]
    except SolverGaveUp as error:
        raise DataError(f"A flight with data.contact=spring cannot be simulated: {error}") from error
    return np.stack(paths)
