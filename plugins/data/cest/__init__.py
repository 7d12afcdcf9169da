"""CEST brain imaging: Z-spectra of volumes, measured and generated."""
