"""Folders and files of a dataset, and opening its scenes."""
