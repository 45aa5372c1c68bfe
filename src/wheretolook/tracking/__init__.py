"""Logging of runs to an MLflow store."""
