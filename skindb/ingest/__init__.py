"""From a capture folder to a version of kind capture."""
