"""Capture folders: the fields, files and limits of the format, checked with all faults at once."""
