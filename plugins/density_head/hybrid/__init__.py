"""A learned density around a mean that the encoder gives."""
