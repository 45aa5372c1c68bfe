"""Style of figures, and floor plans."""

KINDS = ("png", "pdf", "svg")  # file formats of figures
