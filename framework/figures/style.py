"""Colours, markers and titles of every figure."""

import textwrap

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

# Okabe & Ito 2008, told apart by colour-blind people; without the yellow, too pale for lines on white.
BLUE, RED, GREEN, PURPLE, ORANGE, SKY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"
COLOURS = (BLUE, RED, GREEN, PURPLE, ORANGE, SKY, "black")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "p", "h", "*")
GREY = "0.4"


def titled_figure(size: tuple[float, float], title: str, synthetic: bool) -> Figure:
    """Empty, `size` in inches; the title says where data are synthetic."""
    figure = Figure(figsize=size, dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    if synthetic and "synthetic" not in title.lower():
        title = f"{title} (synthetic data)"
    figure.suptitle(textwrap.fill(title, int(size[0] * 10)), fontsize=12, parse_math=False)
    return figure
