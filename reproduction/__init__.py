"""The tables, figures and claims of the thesis, run again: `reproduction/README.md`."""
