"""From a capture folder to a version of kind capture."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from contextlib import suppress
from datetime import date
from pathlib import Path
from typing import Any

from skindb.errors import Fault, InputError, add_filename, require
from skindb.files import private_file
from skindb.format.fields import read_json
from skindb.ingest import (
    Capture,
    Crop,
    IngestParameters,
    ingest_capture,
    read_capture,
    scratch_name,
)
from skindb.ingest.spool import remove_stale
from skindb.schema.consent import CONSENT, require_consent
from skindb.store import Database, Record, WithdrawnError, subject_of
from skindb.threads import one_blas_thread
from skindb.types import Progress
from skindb.workflow.audit import logged_action
from skindb.workflow.calibration import calibrated_capture
from skindb.workflow.derive import groups_of

NOTE = "stage"  # file in the scratch folder: path of the data that this run writes


def ingest_take(
    db: Database,
    folder: str | Path,
    *,
    crop: Crop | None = None,
    new_consent: date | None = None,
    wait: float = 0.0,
    progress: Progress | None = None,
    **parameters: Any,
) -> Record:
    """Ingest a capture folder and commit it; killed at any point, the same call
    continues where it was.

    Parameters
    ----------
    db
        Database to write to.
    folder
        Capture folder, format version 1.
    crop
        What to keep of the scan: a box, the surroundings of the landmarks; None for all of it.
    new_consent
        Date on which a subject who was withdrawn consented again; the scopes are those
        of the capture.
    wait
        Seconds to wait for another run that ingests or fits the same take.
    progress
        Called with the stage, the number of finished steps and the total number of steps.
    **parameters
        Of `skindb.ingest.IngestParameters`: spacing_mm, photographs, soft, footprint,
        visibility, calibration.

    Returns
    -------
    Record
        Of the commit.

    Raises
    ------
    InputError
        With every fault of the folder, before anything is visible; also without the
        consent to fit, if another run ingests or fits the take, or if the subject was
        withdrawn and no new consent is given.
    """
    database = None if db.folder is None else db.folder.resolve()
    require(
        database is None or Path(folder).resolve() not in (database, *database.parents),
        db.url,
        "a database lies outside the captures it holds",
        f"the capture {folder} around it",
        "choose another folder for the database",
    )
    capture = calibrated_capture(db, read_capture(folder, crop=crop))
    record = IngestParameters(**parameters)
    scratch = db.scratch() / scratch_name(capture, record)
    with logged_action(
        db, "ingest", [capture.take], arguments={"new_consent": new_consent is not None}
    ):
        if new_consent is not None:
            require_consent(
                {"consent_scope": capture.consent_scope, "take": capture.take}, "fit"
            )
            db.readmit(subject_of(capture.take), new_consent)
        remove_stale(scratch)
        try:
            return _ingest(db, capture, record, scratch, wait, progress)
        except (OSError, InputError):
            _require_admitted(db, capture.take, scratch)
            raise


def captured_subjects(folders: Iterable[str | Path]) -> list[str]:
    """Subjects that the files capture.json of these folders name; those of unreadable
    ones are omitted.
    """
    subjects = []
    for folder in folders:
        record = read_json(Path(folder) / "capture.json", [])
        subject = record.get("subject") if isinstance(record, dict) else None
        if isinstance(subject, str):
            subjects.append(subject)
    return subjects


def _ingest(
    db: Database,
    capture: Capture,
    parameters: IngestParameters,
    scratch: Path,
    wait: float,
    progress: Progress | None,
) -> Record:
    lease = db.lease(
        capture.take, "capture", "model", wait=wait, command="skindb ingest"
    )
    # what is read names its file; what the disk refuses is written there
    with add_filename(str(scratch)), lease:
        # what was recorded since counts, not the folder
        if db.has(CONSENT, subject_of(capture.take)):
            require_consent(
                {"consent_scope": db.consent(capture.take), "take": capture.take}, "fit"
            )
        with (
            one_blas_thread(),
            ingest_capture(
                capture, parameters, scratch=scratch.parent, progress=progress
            ) as tree,
        ):
            _discard_left(db, capture.take, scratch / NOTE)
            with db.stage("capture", capture.take, lease) as stage:
                if scratch.is_dir():
                    private_file(scratch / NOTE).write_text(
                        stage.path, encoding="utf-8"
                    )
                stage.write(groups_of(tree))
                if progress is not None:
                    progress("write", 1, 1)
                return stage.commit(
                    {str(name): value for name, value in tree.attrs.items()}
                )


def _require_admitted(db: Database, take: str, scratch: Path) -> None:
    """Raise a `WithdrawnError` and remove the scratch folder if the subject of a take
    is withdrawn.
    """
    entry = db.withdrawal(subject_of(take))
    if entry is not None and entry.is_withdrawal:
        shutil.rmtree(scratch, ignore_errors=True)
        rule = "a withdrawn subject must consent again before a capture is ingested"
        cure = "if there is a new consent, state its date with --new-consent"
        raise WithdrawnError(
            Fault(subject_of(take), rule, f"a withdrawal on {entry.date}", cure)
        )


def _discard_left(db: Database, take: str, note: Path) -> None:
    """Remove the data that a killed run of this very ingest had begun to write."""
    # a damaged note or log: nothing is removed then
    with suppress(InputError, OSError, UnicodeDecodeError):
        if not note.is_symlink():
            db.discard("capture", take, note.read_text(encoding="utf-8"))
