"""Data sets of a user's labelled images: classes, and images that are turned by a random angle."""
