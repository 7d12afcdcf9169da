"""Blocks of fully connected layers whose outputs are concatenated to their inputs."""
