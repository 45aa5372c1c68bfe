"""Methods that score viewpoints: one module or folder each, with its record (`wheretolook.scorers.registry.Method`)."""
