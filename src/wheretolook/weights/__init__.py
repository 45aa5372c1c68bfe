"""Resolution of weights: a given file, a folder, a dataset's own, the release's, or the bundled ones."""
