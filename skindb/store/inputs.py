"""Checks that the inputs of a version exist and are covered by consent when it is committed.

A subject may be withdrawn, or change the consent, while the version is computed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skindb.errors import Fault, InputError
from skindb.schema.consent import CONSENT, consent_scope, is_withdrawn
from skindb.store.kinds import CALIBRATION, RELEASE, STUDY
from skindb.store.log import Log
from skindb.store.paths import subject_of
from skindb.store.place import Place, UnavailableError

KINDS_WITHOUT_SUBJECT = (STUDY, RELEASE, CALIBRATION)
# kind -> scope that its subjects must consent to when it is committed; a record of consent needs none
REQUIRED_SCOPES = {
    "capture": "fit",
    "model": "fit",
    "registration": "statistics",
    STUDY: "statistics",
    "edit": "statistics",
}


def require_inputs(place: Place, provenance: Mapping[str, Any]) -> None:
    """Raise an `InputError` if an input no longer exists, or if its subject is being withdrawn."""
    inputs = provenance.get("inputs")
    named = [one for one in inputs if "seal" in one] if isinstance(inputs, list) else []
    gone = [f"{one['kind']} {one['generation']} of {one['take']}" for one in named if not _exists(place, one)]
    subjects = {subject_of(one["take"]) for one in named if one["kind"] not in KINDS_WITHOUT_SUBJECT}
    gone += [f"subject {subject}" for subject in sorted(subjects) if _is_being_withdrawn(place, subject)]
    if gone:
        rule, found = "the inputs of a version must exist when it is committed", "it was removed during the run"
        raise InputError(Fault(where, rule, found, "run the command again") for where in gone)


def require_consents(place: Place, kind: str, take: str, provenance: Mapping[str, Any]) -> None:
    """Raise an `InputError` if the present consent of a subject does not cover the version."""
    scope = REQUIRED_SCOPES.get(kind)
    if scope is None:
        return
    inputs = provenance.get("inputs")
    named = inputs if isinstance(inputs, list) else []
    of_takes = [one for one in named if one.get("kind") not in KINDS_WITHOUT_SUBJECT]
    subjects = {subject_of(one["take"]) for one in of_takes if "take" in one}
    subjects |= set() if kind == STUDY else {subject_of(take)}
    faults = []
    for subject in sorted(subjects):
        log = Log(place, CONSENT, subject)
        if not log.is_empty() and scope not in consent_scope((record := log.read()).about):
            rule = f"its subject must consent to {scope} when it is committed"
            found = f"no such consent since {record.created}"
            where = f"{kind} of {take}" if kind != STUDY else f"study {take}, {subject}"
            faults.append(Fault(where, rule, found, "nothing was committed; see skindb consent"))
    if faults:
        raise InputError(faults)


def _exists(place: Place, one: Mapping[str, Any]) -> bool:
    try:
        return str(one["seal"]) == Log(place, one["kind"], one["take"]).read(one["generation"]).seal
    except UnavailableError:
        raise
    except InputError:
        return False


def _is_being_withdrawn(place: Place, subject: str) -> bool:
    log = Log(place, CONSENT, subject)
    return not log.is_empty() and is_withdrawn(log.read().about)
