"""Images of coloured points: the nearest point of each pixel, and the surface between the points."""
