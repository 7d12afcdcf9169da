"""Z-spectra of CEST imaging: sums of Lorentzian lines, their fit to measured spectra, the offsets that models read."""
