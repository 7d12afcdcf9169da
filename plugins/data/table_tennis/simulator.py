"""Simulated flights in the layout of a user's own data: a folder of CSV files, marked as synthetic."""

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
from plugins.data.table_tennis.recordings import COLUMNS, TRUE_COLUMNS
from plugins.data.table_tennis.solvers import SolverGaveUp, flight

VERSION = "1"
LONGEST = 1.15
"""Largest duration of a flight, seconds; a flight ends earlier when the ball passes one of the limits below."""
PAST, BELOW = 0.4, 0.25
"""Position y, m, and depth below the table, m, beyond which a flight ends."""
MEAN = (0.6, -4.1, -0.62, -0.4, 6.0, 1.6, 0.0, 0.0, 0.0)
SPREAD = (0.2, 0.08, 0.05, 0.4, 0.5, 0.25, 40.0, 40.0, 40.0)
"""Standard deviations of the normally distributed state at the start, with mean `MEAN`: m, m/s, rad/s.

Flights recorded in the WAM laboratory have similar starts, with less variation.
"""
JITTER = 5e-5
"""Standard deviation of the time of a frame, s."""
Share = Annotated[float, Field(ge=0, lt=0.5, allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """Settings of the flights that are simulated if no root is given.

    Attributes:
        flights: Number of flights.
        noise: Standard deviation of the noise of each observed coordinate, m.
        outliers: Share of the frames whose observed position is wrong.
        dropped: Share of the frames that are missing.
        contact: "bounce" takes no time; "spring" is a stiff spring and damper, solved implicitly in 30 ms per flight.
        frequency: Ω of the spring, 1/s.
        damping: ζ of the spring (at 0.04, the ball bounces as high as with `restitution` 0.88).
        generator_seed: Seed of all random numbers, independent of the seed of the run.
    """

    flights: Annotated[int, Field(ge=4, le=100_000)] = 1000
    noise: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 0.003
    outliers: Share = 0.01
    dropped: Share = 0.03
    contact: Literal["bounce", "spring"] = "bounce"
    frequency: Positive = 3000.0
    damping: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 0.04
    generator_seed: Annotated[int, Field(ge=0, lt=2**31)] = 0


def ensure_simulated(simulation: Simulation, constants: Constants, step: float) -> Path:
    """Return the folder of simulated flights in the cache, after simulating the flights if it does not exist.

    Args:
        simulation: Settings of the flights.
        constants: Constants of the ball and the table.
        step: Time from frame to frame, s.

    Raises:
        DataError: The cache cannot be written, or a solver gave up.
    """
    mark = {"version": VERSION, "step": step, **asdict(simulation), **asdict(constants)}
    name = stream(simulation.generator_seed, repr(sorted(mark.items()))).integers(2**62)
    return ensure_generated(
        cache.folder("table_tennis") / f"seed_{simulation.generator_seed}_{name:016x}",
        mark,
        lambda root: write(root, simulation, constants, step),
    )


def write(root: Path, simulation: Simulation, constants: Constants, step: float) -> None:
    """Write one CSV file per flight, with the observed t, x, y, z and the true positions true_x, true_y, true_z.

    `constants` are those of the ball and the table, and `step` is the time from frame to frame, s.
    """
    seed = simulation.generator_seed
    starts = [draw_start(stream(seed, f"start {number}")) for number in range(simulation.flights)]
    times = np.arange(0, LONGEST, step)
    jitter = [
        stream(seed, f"time {number}").normal(0, JITTER, len(times)) for number in range(simulation.flights)
    ]
    frame_times = times + np.clip(jitter, -step / 4, step / 4)
    frame_times -= frame_times[:, :1]
    truth = simulate_positions(np.stack(starts), frame_times, simulation, constants)

    def save(number: int) -> None:
        random = stream(seed, f"noise {number}")
        positions = truth[number]
        ended = (positions[:, 1] > PAST) | (positions[:, 2] < constants.surface - BELOW)
        count = int(ended.argmax()) if ended.any() else len(positions)
        positions = positions[:count]
        observed = positions + random.normal(0, simulation.noise, positions.shape)
        is_outlier = random.random(count) < simulation.outliers
        observed = observed + is_outlier[:, None] * random.normal(0, 0.3, positions.shape)
        present = random.random(count) >= simulation.dropped
        present[0] = True
        table = np.column_stack([frame_times[number, :count], observed, positions])[present]
        np.savetxt(
            root / f"flight_{number:05}.csv",
            table,
            "%.6f",
            ",",
            header=",".join((*COLUMNS, *TRUE_COLUMNS)),
            comments="",
        )

    draw_all(simulation.flights, save, "flights of a ball")


def draw_start(random: np.random.Generator) -> Float[np.ndarray, "9"]:
    """Return a random state at the start of a flight that lands on the table: position, velocity and spin."""
    return np.array(MEAN) + np.array(SPREAD) * np.clip(random.normal(size=9), -2.5, 2.5)


def simulate_positions(
    starts: Float[np.ndarray, "flight 9"],
    times: Float[np.ndarray, "flight time"],
    simulation: Simulation,
    constants: Constants,
) -> Float[np.ndarray, "flight time 3"]:
    """Return the positions of flights at given times, without noise.

    Args:
        starts: Position, velocity and spin of each flight at its first time.
        times: Increasing times of each flight, s.
        simulation: Settings of the contact with the table.
        constants: Constants of the ball and the table.

    Raises:
        DataError: The solver of the stiff contact gave up.
    """
    if simulation.contact == "bounce":
        states = simulate(torch.from_numpy(starts), torch.from_numpy(times), constants)
        return states[..., :3].numpy()
    spring = Spring(frequency=simulation.frequency, damping=simulation.damping)
    try:
        paths = [
            flight(start, flight_times, constants, spring, method="LSODA").states[:, :3]
            for start, flight_times in zip(starts, times, strict=True)
        ]
    except SolverGaveUp as error:
        raise DataError(f"A flight with data.contact=spring cannot be simulated: {error}") from error
    return np.stack(paths)
