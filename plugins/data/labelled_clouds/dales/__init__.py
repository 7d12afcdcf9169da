"""Objects from airborne laser scans (DALES) as point clouds."""
