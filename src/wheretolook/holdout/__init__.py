"""How well views of a map can be told apart, measured with the map's own photographs: `wheretolook check`."""
