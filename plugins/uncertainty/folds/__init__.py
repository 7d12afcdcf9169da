"""Cross-fitted ensembles: each model leaves out one fold of the training data, and all samples calibrate the whole."""
