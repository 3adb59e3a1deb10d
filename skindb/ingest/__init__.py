"""From a capture folder to a version of kind capture."""

from skindb.ingest.folder import Capture, read_capture
from skindb.ingest.run import ingest_capture

__all__ = ["Capture", "ingest_capture", "read_capture"]
