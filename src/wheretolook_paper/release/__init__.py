"""What ships and what shows it: the compact copy, its card and runs, the catalog of figures."""
