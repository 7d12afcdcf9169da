"""Colours of the object families: reflectances in [0, 1]."""

import colorsys

from numpy.random import Generator

from plugins.data.pascal3d.shapes import Color

GLASS: Color = (0.13, 0.17, 0.22)
RUBBER: Color = (0.08, 0.08, 0.09)
DARK: Color = (0.14, 0.14, 0.15)
METAL: Color = (0.68, 0.69, 0.71)
LAMP: Color = (1.0, 0.96, 0.75)
TAIL_LAMP: Color = (0.85, 0.08, 0.08)


def paint(random: Generator, *, vivid: bool = False) -> Color:
    """Return a random colour of lacquer, of any hue; unless `vivid`, sometimes white, silver or nearly black."""
    hue, saturation, value = random.random(), random.uniform(0.5, 0.9), random.uniform(0.45, 0.95)
    grey, level = random.random() < 0.4, random.random()
    if grey and not vivid:
        saturation, value = 0.04, (0.22, 0.62, 0.92)[int(3 * level)]
    return colorsys.hsv_to_rgb(hue, saturation, value)


def wood(random: Generator) -> Color:
    """Return the colour of a random kind of wood, from beech to wenge."""
    return colorsys.hsv_to_rgb(
        random.uniform(0.05, 0.1), random.uniform(0.35, 0.65), random.uniform(0.3, 0.85)
    )


def shade(color: Color, factor: float) -> Color:
    """Return a colour multiplied by a factor and clamped to [0, 1]; a factor above 1 makes it brighter."""
    red, green, blue = (min(1.0, max(0.0, factor * part)) for part in color)
    return red, green, blue
