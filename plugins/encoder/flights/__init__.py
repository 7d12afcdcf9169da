"""Flights of a ball as features: by the differential equation, and by parabolas through the last frames."""
