"""A network over the set of landmarks in view."""
