"""Expected calibration error and reliability curve of class probabilities."""
