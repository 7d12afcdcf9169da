"""Many jobs on one machine, and their comparison."""
