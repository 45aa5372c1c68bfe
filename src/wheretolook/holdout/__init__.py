"""Measures how well scores separate good from bad views of a map, by its own photographs: `wheretolook check`."""
