"""Data set of CEST brain imaging: measured and generated Z-spectra of volumes."""
