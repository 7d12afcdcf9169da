"""Data sets of scans whose target is a registered mesh: synthetic people, and FAUST."""
