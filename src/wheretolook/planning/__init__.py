"""Planning with viewpoints: the map a planner queries, a local search without it, and views along a path."""
