"""Boosted trees on pooled statistics of the landmarks in view."""
