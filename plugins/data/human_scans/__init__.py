"""Data set of photographs of people with registered meshes; commands that repose and animate people."""
