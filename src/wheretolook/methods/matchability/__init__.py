"""The chance that a landmark in view is found, and methods that weight landmarks by it."""
