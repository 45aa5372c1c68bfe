"""How well methods choose viewpoints: localization score, oracle, intervals, and the logged runs."""
