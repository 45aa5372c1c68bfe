"""Visibility as the paper's released code counts it."""
