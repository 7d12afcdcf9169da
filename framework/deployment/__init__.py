"""Deployment of trained models: as frozen models on one CPU core without gradients, and on MLflow's server."""
