"""The methods: one self-contained folder each, found by entry points, never imported by the core."""
