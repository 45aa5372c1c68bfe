"""A network that scores all directions at a location at once, in the manner of ActLoc."""
