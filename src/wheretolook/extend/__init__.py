"""How much of a place localizes from a map, and which photographs to add so that more of it does."""
