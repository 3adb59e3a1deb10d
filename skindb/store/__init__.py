"""Versions of takes: immutable zarr roots, and the log that says which one is current. The only importer of zarr."""

from skindb.store.cohort import SUMMARY, Asked, frame_of, lacking
from skindb.store.database import Database
from skindb.store.log import Conflict
from skindb.store.record import Record

__all__ = ["SUMMARY", "Asked", "Conflict", "Database", "Record", "frame_of", "lacking"]
