"""The release: its compact copy of a dataset, card and runs, and the catalog of figures."""
