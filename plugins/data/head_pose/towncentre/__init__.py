"""TownCentre: pan of pedestrians' heads; the published layout, and a generator that writes it."""
