"""Blocks of fully connected layers whose outputs are joined to their inputs."""
