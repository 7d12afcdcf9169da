"""Recording a run: the local journal, and the store that gets a copy of it."""
