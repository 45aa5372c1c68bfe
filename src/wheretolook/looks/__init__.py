"""Several views from one location: what they detect jointly, and which to take."""
