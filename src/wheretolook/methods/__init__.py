"""Methods that score viewpoints, all with the same interface (`Scorer`)."""
