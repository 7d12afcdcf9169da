"""A learned density about a mean that the encoder gives."""
