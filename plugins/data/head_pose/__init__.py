"""Head pose from images: IDIAP, TownCentre and CAVIAR as published, and generators that write their layouts."""
