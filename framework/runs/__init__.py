"""The run: its folder, its session, its provenance, and the files that it reads."""
