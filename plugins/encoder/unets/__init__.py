"""U-Nets that turn images of projected points or rasterised meshes into complete images."""
