"""Colours, markers, titles and file formats of all figures."""

import textwrap
from pathlib import Path

from matplotlib import rc_context
from matplotlib.backend_bases import RendererBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter

from framework.errors import escape_unprintable
from framework.storage.text import BLANKS

# Okabe & Ito 2008, distinguishable by colour-blind people; without yellow, which is too pale for lines on white.
BLUE, RED, GREEN, PURPLE, ORANGE, SKY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"
COLOURS = (BLUE, RED, GREEN, PURPLE, ORANGE, SKY, "black")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "p", "h", "*")
GREY = "0.4"


class _PlainFigure(Figure):
    """Figure that draws every text as it is: names of users' methods and classes may hold the sign of TeX, $.

    Only characters that no font draws are escaped.
    """

    def draw(self, renderer: RendererBase) -> None:
        _escape_texts(self)
        for text in self.findobj(Text):
            text.set_parse_math(False)
        super().draw(renderer)


def titled_figure(size: tuple[float, float], title: str, synthetic: bool) -> Figure:
    """Return an empty figure of `size` in inches; its title says if the data are synthetic."""
    figure = _PlainFigure(figsize=size, dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    if synthetic and "synthetic" not in title.lower():
        title = f"{title} (synthetic data)"
    figure.suptitle(textwrap.fill(title, int(size[0] * 10)), fontsize=12, parse_math=False)
    return figure


def save_figure(figure: Figure, path: Path, pictures: bool | str) -> Path:
    """Write the figure to `path` with the suffix of its format, and return the path.

    The format is the one that the setting `pictures` names ("pdf", "svg" …), or PNG if `pictures` is true or false. The
    same figure gives the same bytes. Text in a PDF stays text (TrueType), text in an SVG becomes outlines.
    """
    kind = pictures if isinstance(pictures, str) else "png"
    path = path.with_name(f"{path.name}.{kind}")
    dated = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}
    _escape_texts(figure)
    with rc_context({"pdf.fonttype": 42, "svg.hashsalt": path.stem}):
        figure.savefig(path, dpi=110, metadata=dated.get(kind))
    return path


def _escape_texts(figure: Figure) -> None:
    """Escape control characters, and bytes that are not UTF-8, in all texts of a figure.

    The names of classes, methods and files may come from another person. Fonts do not draw these characters, and XML,
    of which an SVG consists, does not allow them.
    """
    for text in figure.findobj(Text):
        text.set_text(_escape(text.get_text()))
    for axis in (axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)):
        labels = [label.get_text() for label in axis.get_majorticklabels()]
        if any(_escape(label) != label for label in labels):  # the formatter would write these texts again
            written = axis.get_major_formatter()
            axis.set_major_formatter(
                FuncFormatter(lambda value, index, written=written: _escape(written(value, index)))
            )


def _escape(text: str) -> str:
    return escape_unprintable(text, allowed="\n\t" + BLANKS)
