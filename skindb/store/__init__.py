"""Versions of takes: immutable zarr stores, and the log of current versions. Only this
package imports zarr.
"""

from skindb.errors import UnavailableError
from skindb.store.archive import State, backup_states
from skindb.store.audit import AuditEntry
from skindb.store.backup import BackupReport
from skindb.store.catalogue import MissingWarning
from skindb.store.cohort import CohortRequest, frame_of, lacking
from skindb.store.database import Database
from skindb.store.erasure import Holdings
from skindb.store.garbage import Garbage
from skindb.store.lease import LEASE_SECONDS, Lease, LeaseLost
from skindb.store.log import Conflict
from skindb.store.markers import MarkerFileWarning, WithdrawnError
from skindb.store.place import (
    CALIBRATION,
    RELEASE,
    STUDY,
    SUMMARY,
    require_text,
    subject_of,
)
from skindb.store.record import Record, intact_or_none, seal_of
from skindb.store.restoring import Restored, restore
from skindb.store.snapshot import Lookup
from skindb.store.stale import (
    Request,
    Staleness,
    StaleWarning,
    require_fresh,
    stale_versions,
)

__all__ = [
    "CALIBRATION",
    "LEASE_SECONDS",
    "RELEASE",
    "STUDY",
    "SUMMARY",
    "AuditEntry",
    "BackupReport",
    "CohortRequest",
    "Conflict",
    "Database",
    "Garbage",
    "Holdings",
    "Lease",
    "LeaseLost",
    "Lookup",
    "MarkerFileWarning",
    "MissingWarning",
    "Record",
    "Request",
    "Restored",
    "StaleWarning",
    "Staleness",
    "State",
    "UnavailableError",
    "WithdrawnError",
    "backup_states",
    "frame_of",
    "intact_or_none",
    "lacking",
    "require_fresh",
    "require_text",
    "restore",
    "seal_of",
    "stale_versions",
    "subject_of",
]
