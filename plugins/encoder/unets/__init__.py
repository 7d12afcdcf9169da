"""U-Nets that fill pictures of projected points or rasterised meshes."""
