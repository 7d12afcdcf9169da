"""Tables and figures at the end of a run."""
