"""How a model behaves on data that belongs to nothing it was trained on."""
