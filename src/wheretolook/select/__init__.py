"""The best views at locations of a COLMAP map: `wheretolook select`, and in Python `WhereToLook`."""
