"""Several looks from one place: what they see together, and which to take."""
