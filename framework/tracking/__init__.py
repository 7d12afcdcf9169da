"""Recording of a run: the local journal, and the store that receives a copy of it."""
