"""The table of viewpoints: rows, sampling, and what a label is."""
