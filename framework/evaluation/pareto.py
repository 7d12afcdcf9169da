"""The Pareto front of error and run time."""

import math
from collections.abc import Sequence


def front(errors: Sequence[float], times: Sequence[float]) -> list[bool]:
    """Pareto front, the points that no other beats: none has less error in no more time, or the reverse.

    Equal pairs are both on it, what is not finite is not.
    """
    finite = [
        index for index, pair in enumerate(zip(errors, times, strict=True)) if all(map(math.isfinite, pair))
    ]
    kept = [False] * len(errors)
    least, when = math.inf, math.nan
    for index in sorted(finite, key=lambda index: (times[index], errors[index])):
        error, time = errors[index], times[index]
        if error < least or (error == least and time == when):
            kept[index] = True
            least, when = error, time
    return kept
