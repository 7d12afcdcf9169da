"""Post-hoc scaling: temperature and Platt."""
