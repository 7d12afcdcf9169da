"""Similarity of predicted and true images: colours, silhouettes and depths."""
