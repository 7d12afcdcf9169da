"""CEST brain imaging: Z-spectra, fitted by sums of Lorentzian lines or predicted by networks."""
