"""FAUST: real scans of ten people with registered meshes."""
