"""The best views at places of one's own map: `wheretolook select`, and in Python `WhereToLook`."""
