"""How often prediction sets hold the target, and how large they are."""
