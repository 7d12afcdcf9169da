"""Figure of the contrast maps of a slice, with standard deviations below them."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from framework.figures.style import titled_figure

SHOWN = {
    "amide_amplitude": "amide, 3.5 ppm",
    "noe_amplitude": "NOE, -3.5 ppm",
    "mt_amplitude": "MT, -2.5 ppm",
    "amine_amplitude": "amine, 2 ppm",
    "water_amplitude": "water",
}
"""Names of the predicted numbers in the figure, and their headings; the figure also shows the asymmetry."""
Maps = Mapping[str, tuple[Float[np.ndarray, "row column"], Float[np.ndarray, "row column"] | None]]
"""Maps of a slice by the name of the mapped number, NaN outside the brain.

Each entry is the map of the number and the map of its standard deviation, or None if the number has none.
"""
SIZE = 2.1
"""Side of a map, inches."""


def maps_figure(methods: Mapping[str, Maps], title: str) -> Figure:
    """Return a figure: two rows for each method, predictions and standard deviations, in % of the unsaturated signal.

    `methods` holds the maps of each method by its name. Amplitudes use the rainbow colours that are usual in the field,
    the asymmetry uses a scale centred on 0, and standard deviations use a sequential scale that begins at 0. In a
    column, the predictions of all methods share one scale, and so do the standard deviations. The 1 % and 99 %
    quantiles of the first method's map determine the scale.
    """
    columns = list(next(iter(methods.values())))
    figure = titled_figure((SIZE * len(columns) + 0.8, (SIZE + 0.35) * 2 * len(methods) + 0.4), title, False)
    axes = figure.subplots(2 * len(methods), len(columns), squeeze=False)
    first = next(iter(methods.values()))
    for place, name in enumerate(columns):
        for number, (method, maps) in enumerate(methods.items()):
            for row, (values, scale) in enumerate(zip(maps[name], first[name], strict=True)):
                axis = axes[2 * number + row, place]
                axis.set(xticks=[], yticks=[])
                axis.set_frame_on(False)
                if place == 0:
                    quantity = ("predicted", "standard deviation")[row]
                    axis.set_ylabel(f"{method}\n{quantity}" if method else quantity, fontsize=8)
                if values is None or scale is None:
                    axis.set_axis_off()
                    continue
                drawing = axis.imshow(100 * values, **_scale(name in SHOWN, row, 100 * scale))
                figure.colorbar(drawing, ax=axis, shrink=0.8, pad=0.02).ax.tick_params(labelsize=6)
        axes[0, place].set_title(f"{SHOWN.get(name, 'asymmetry, 3.5 ppm')}, %", fontsize=8)
    return figure


def _scale(contrast: bool, row: int, values: np.ndarray) -> dict[str, object]:
    """Return the colour map and the limits of a map for `imshow`.

    Args:
        contrast: Whether the map shows an amplitude; otherwise it shows the asymmetry, whose scale is centred on 0.
        row: 0 for predictions, 1 for standard deviations.
        values: Numbers of the map.
    """
    low, high = np.nanquantile(values, (0.01, 0.99))
    if row:
        return {"cmap": "magma", "vmin": 0.0, "vmax": high}
    if contrast:
        return {"cmap": "turbo", "vmin": low, "vmax": high}
    most = max(abs(low), abs(high))
    return {"cmap": "RdBu_r", "vmin": -most, "vmax": most}
