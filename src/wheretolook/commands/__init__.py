"""Commands: one module each, with a frozen dataclass of its options whose `run()` does the work."""
