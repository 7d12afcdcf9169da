"""Flights of a ball as features: by the differential equation, and by the parabola on which the last frames lie."""
