"""Version of the software that is recorded in the provenance."""

__version__ = "0.1.0"
