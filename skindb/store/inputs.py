"""Inputs of a version must still exist when it is committed: a subject may be withdrawn during the work."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skindb.errors import Fault, InputError
from skindb.schema.consent import CONSENT, consent_scope, is_withdrawn
from skindb.store.kinds import CALIBRATION, RELEASE, STUDY
from skindb.store.log import Log
from skindb.store.paths import subject_of
from skindb.store.place import Place, UnavailableError

OF_NO_SUBJECT = (STUDY, RELEASE, CALIBRATION)
# kind -> what its subjects must consent to when it is committed; a record of consent itself needs nothing
NEEDED = {"capture": "fit", "model": "fit", "registration": "statistics", STUDY: "statistics", "edit": "statistics"}


def require_inputs(place: Place, provenance: Mapping[str, Any]) -> None:
    """Refuse to commit a result of a version that no longer exists, or whose subject is being withdrawn."""
    inputs = provenance.get("inputs")
    named = [one for one in inputs if "seal" in one] if isinstance(inputs, list) else []
    gone = [f"{one['kind']} {one['generation']} of {one['take']}" for one in named if not _is_there(place, one)]
    subjects = {subject_of(one["take"]) for one in named if one["kind"] not in OF_NO_SUBJECT}
    gone += [f"subject {subject}" for subject in sorted(subjects) if _is_being_withdrawn(place, subject)]
    if gone:
        rule, found = "what a version was made from must be there when it is committed", "it was removed meanwhile"
        raise InputError(Fault(what, rule, found, "run the command again") for what in gone)


def require_consents(place: Place, kind: str, take: str, provenance: Mapping[str, Any]) -> None:
    """Refuse to commit a result that the consent, which may have changed during the work, no longer covers."""
    scope = NEEDED.get(kind)
    if scope is None:
        return
    inputs = provenance.get("inputs")
    of_takes = [one for one in inputs if one.get("kind") not in OF_NO_SUBJECT] if isinstance(inputs, list) else []
    subjects = {subject_of(one["take"]) for one in of_takes if "take" in one}
    subjects |= set() if kind == STUDY else {subject_of(take)}
    faults = []
    for subject in sorted(subjects):
        log = Log(place, CONSENT, subject)
        if not log.is_empty() and scope not in consent_scope((record := log.read()).about):
            rule, found = f"its subject must consent to {scope} when it is committed", f"not since {record.created}"
            where = f"{kind} of {take}" if kind != STUDY else f"study {take}, {subject}"
            faults.append(Fault(where, rule, found, "nothing was committed"))
    if faults:
        raise InputError(faults)


def _is_there(place: Place, one: Mapping[str, Any]) -> bool:
    try:
        return str(one["seal"]) == Log(place, one["kind"], one["take"]).read(one["generation"]).seal
    except UnavailableError:
        raise
    except InputError:
        return False


def _is_being_withdrawn(place: Place, subject: str) -> bool:
    log = Log(place, CONSENT, subject)
    return not log.is_empty() and is_withdrawn(log.read().about)
