"""Figures of labels, scores, calibration, scenes and paths."""

KINDS = ("png", "pdf", "svg")  # file formats of figures
