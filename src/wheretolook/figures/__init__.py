"""Every figure, drawn from logged runs."""
