"""Post-hoc scaling of densities, fitted by maximum likelihood to the validation set: temperature and Platt."""
