"""Style that all figures share, drawn by metrics, data sets or reports."""
