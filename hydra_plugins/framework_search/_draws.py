"""Reproducible random points of a search space, without Optuna."""

import math
from collections.abc import Mapping
from hashlib import sha256

from hydra_plugins.framework_search._space import Domain, overrides_of


def draw(space: Mapping[str, Domain], trials: int, seed: int) -> tuple[list[list[str]], int]:
    """Return the overrides of different trials, and the number of draws that repeated an earlier trial.

    There are `trials` trials or, if the space has fewer points, one for each point; the points are then drawn until all
    have occurred. So the trials of a shorter search are the first trials of a longer one.
    """
    count = min(trials, math.prod(domain.size for domain in space.values()))
    drawn_trials: dict[tuple[str, ...], None] = {}
    number = 0
    while len(drawn_trials) < count:
        values = {
            key: domain.at(quantile(seed, number, key.lstrip("+")) if domain.size > 1 else 0.0)
            for key, domain in space.items()
        }
        drawn_trials[tuple(overrides_of(values))] = None
        number += 1
    return [list(trial) for trial in drawn_trials], number - len(drawn_trials)


def quantile(seed: int, trial: int, key: str) -> float:
    """Return a pseudo-random number, uniform in [0, 1), that is the same on every machine.

    Args:
        seed: Seed of the search.
        trial: Number of the trial.
        key: Key of the override whose value is drawn.
    """
    digest = sha256(f"{seed}\0{trial}\0{key}".encode()).digest()
    return (int.from_bytes(digest[:8], "big") >> 11) * 2.0**-53  # the 53 bits a float can hold


def describe(space: Mapping[str, Domain], count: int, trials: int, repeated: int) -> str:
    """Return a line for the log that describes a random search.

    Args:
        space: Search space.
        count: Number of trials that are run.
        trials: Number of trials that were requested.
        repeated: Number of draws that repeated an earlier trial.
    """
    keys = [key.lstrip("+") for key, domain in space.items() if domain.size > 1]
    line = f"random search over {', '.join(keys) or 'a single point'}: {count} trials"
    if count < trials:
        line += f", which is all points of the space ({trials} were requested)"
    return line + (f"; {repeated} draws repeated an earlier trial and are not run again" if repeated else "")
