"""A third-party package: it knows the framework, the framework does not know it."""
