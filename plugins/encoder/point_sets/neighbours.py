"""Nearest neighbours in any number of dimensions; the choice of smallest distances is compiled when first called."""

from pathlib import Path
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.errors import ConfigError
from framework.storage.kernels import compiler, kernel_cache

compiled = compiler(kernel_cache("neighbours", [Path(__file__)]))


@torch.no_grad()
def nearest_rows(
    values: Float[Tensor, "point length"], counts: Int[Tensor, "batch"], neighbours: int
) -> Int[Tensor, "point neighbours"]:
    """Return the rows of the nearest points of the same cloud for each point, in any order.

    The squared distances are computed by a matrix product, relative to the mean of the cloud. In float32, points whose
    distances differ by less than rounding may therefore be exchanged.

    Args:
        values: points of all clouds, concatenated.
        counts: number of points of each cloud.
        neighbours: number of nearest points of each point, which include the point itself. In a cloud with fewer
            points, the rows of all its points are returned, and the point's own row is repeated. If every cloud has
            fewer points, the result has as many columns as the largest cloud has points.

    Raises:
        ConfigError: the network is exported.
    """
    if torch.compiler.is_exporting():
        raise ConfigError(
            "The search for nearest neighbours cannot be exported, because it depends on the number of points of each "
            "cloud. For an export, train a model with another encoder."
        )
    numbers = counts.tolist()
    most = min(neighbours, max(numbers, default=1))
    indices, start = [counts.new_zeros(0, most)], 0
    # a product in a lower precision would find other neighbours
    with torch.autocast(values.device.type, enabled=False):
        for part in values.to(torch.promote_types(values.dtype, torch.float32)).split(numbers):
            local = part - part.mean(0)
            # the square of the point's own length is the same for all its neighbours and is left out
            rows = smallest(torch.addmm(local.square().sum(1), local, local.mT, alpha=-2), most)
            if len(part) < most:
                own = torch.arange(len(part), device=rows.device).unsqueeze(1)
                rows = torch.cat([rows, own.expand(-1, most - len(part))], 1)
            indices.append(rows + start)
            start += len(part)
    return torch.cat(indices)


def smallest(table: Float[Tensor, "row column"], most: int) -> Int[Tensor, "row kept"]:
    """Return the indices of the `most` smallest numbers of each row, or of all numbers if there are fewer.

    On a CPU the indices are ordered by number, and of equal numbers the lower index comes first. NaN counts as
    infinity. Other devices use `torch.topk`, which takes longer on a CPU.
    """
    most = min(most, table.shape[1])
    if table.device.type != "cpu":
        return table.topk(most, largest=False, sorted=False).indices
    return torch.from_numpy(_smallest(table.numpy(), most))


@compiled
@no_type_check
def _smallest(table, most):
    rows, columns = table.shape
    chosen = np.empty((rows, most), dtype=np.int64)
    numbers = np.empty(most, dtype=table.dtype)
    for row in range(rows):
        filled = 0
        for column in range(columns):
            number = table[row, column]
            if np.isnan(number):
                number = table.dtype.type(np.inf)
            if filled == most and not number < numbers[most - 1]:
                continue
            place = filled if filled < most else most - 1
            while place > 0 and number < numbers[place - 1]:
                numbers[place] = numbers[place - 1]
                chosen[row, place] = chosen[row, place - 1]
                place -= 1
            numbers[place] = number
            chosen[row, place] = column
            filled = min(filled + 1, most)
    return chosen
