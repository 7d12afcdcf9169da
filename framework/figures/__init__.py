"""Style that the figures of metrics, data sets and reports share."""
