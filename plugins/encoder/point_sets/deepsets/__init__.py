"""Deep Sets: layers that commute with any reordering of a cloud's points."""
