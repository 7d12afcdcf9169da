"""Head pose from images: IDIAP, TownCentre and CAVIAR."""
