"""Takes whose capture was made with an earlier version of a calibration; only ingest
can update them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from skindb.errors import InputError
from skindb.store import CALIBRATION, Database, UnavailableError

MAX_NAMED = 8  # takes in one line


def superseded_calibrations(db: Database) -> dict[str, list[str]]:
    """Takes whose newest capture used an earlier version than the newest one of a calibration.

    Records of captures are read only if a calibration has more than one version.

    Parameters
    ----------
    db
        Database.

    Returns
    -------
    dict
        Name of a calibration -> takes, in order. A damaged record counts as none:
        `Database.verify` names it.
    """
    newest = dict[str, int]()
    for name in db.takes(CALIBRATION):
        try:
            newest[name] = db.record(CALIBRATION, name).generation
        except UnavailableError:
            raise
        except InputError:
            continue
    found = dict[str, list[str]]()
    for take in db.takes("capture") if max(newest.values(), default=1) > 1 else ():
        try:
            used = db.record("capture", take).provenance.get("calibrated_by") or {}
        except UnavailableError:
            raise
        except InputError:
            continue
        if used.get("generation", 0) < newest.get(str(used.get("take")), 0):
            found.setdefault(str(used["take"]), []).append(take)
    return {name: sorted(takes) for name, takes in sorted(found.items())}


def superseded_lines(found: Mapping[str, Sequence[str]]) -> list[str]:
    """What `superseded_calibrations` found in words, one line for each calibration:
    what happened and what to do.
    """
    lines = []
    for name, takes in found.items():
        count = "1 take was" if len(takes) == 1 else f"{len(takes)} takes were"
        named = (
            f"{', '.join(takes[:MAX_NAMED])}{', ...' if len(takes) > MAX_NAMED else ''}"
        )
        lines.append(
            f"{count} ingested with an earlier version of calibration {name}: "
            f"{named}; run skindb ingest again"
        )
    return lines
