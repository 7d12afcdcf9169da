"""Data set COIL-20: 20 objects seen from all sides on a turntable."""
