"""Z-spectra of CEST imaging: sums of Lorentzian lines, their fit to measured spectra, and the offsets of models."""
