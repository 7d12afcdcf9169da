"""Files that `mode=export` copies beside an exported network; they import only NumPy, ONNX Runtime and FastAPI."""
