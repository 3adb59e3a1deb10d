"""Ingest: from a capture folder to reflectance samples at the surfels of the scan."""

from skindb.format.folder import Capture, read_capture
from skindb.geometry.scan import Crop
from skindb.ingest.capture import ingest_capture
from skindb.ingest.pictures import import_images, import_olat
from skindb.ingest.report import (
    calibration_lines,
    calibration_table,
    cleaning_lines,
    sample_lines,
    sample_table,
)
from skindb.parameters import IngestParameters

__all__ = [
    "Capture",
    "Crop",
    "IngestParameters",
    "calibration_lines",
    "calibration_table",
    "cleaning_lines",
    "import_images",
    "import_olat",
    "ingest_capture",
    "read_capture",
    "sample_lines",
    "sample_table",
]
