"""Scenes in files: readers, cameras around a subject, light at the camera, and files of images."""
