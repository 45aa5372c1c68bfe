"""Learning to score viewpoints."""
