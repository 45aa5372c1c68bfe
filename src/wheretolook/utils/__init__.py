"""Shared by all packages: errors, files, limits on reading, processes, devices."""
