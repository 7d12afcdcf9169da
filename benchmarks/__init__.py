"""Speed and accuracy of parts of the project, with committed results: `benchmarks/README.md`."""
