"""Baselines and learners that do not ship, registered by entry points."""
