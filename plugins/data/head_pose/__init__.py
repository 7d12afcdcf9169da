"""Data sets of head pose: IDIAP, TownCentre and CAVIAR as published, and generators that write their layouts."""
