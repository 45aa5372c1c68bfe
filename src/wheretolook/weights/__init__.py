"""Which weights score: a given file, those in a folder, a dataset's own, the release's, or the bundled ones."""
