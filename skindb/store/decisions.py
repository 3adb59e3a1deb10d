"""Consents and releases: versions that record a decision and hold no data."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from skindb.errors import Fault, InputError, few_names, input_error, require
from skindb.schema.consent import CONSENT, SCOPES, consent_scope
from skindb.store.markers import note_consents
from skindb.store.place import RELEASE, TAKE, Place, require_text, subject_of
from skindb.store.record import Record
from skindb.store.snapshot import PINNED, Snapshot
from skindb.store.stage import Stage

MAX_NAMED = 8  # subjects in a message


def record_consent(place: Place, subject: str, scope: Iterable[str]) -> Record:
    """See `Database.record_consent`."""
    scopes = list(dict.fromkeys(scope))
    unknown = ", ".join(repr(name) for name in scopes if name not in SCOPES)
    rule = f"a scope must be one of {', '.join(SCOPES)}"
    require(not unknown, "scope", rule, unknown, "choose from these")
    require_subject(place, subject)
    with Stage(place, CONSENT, subject) as stage:
        record = stage.commit({"subject": subject, "consent_scope": scopes})
    note_consents(place, [record])
    return record


def consent_history(place: Place, subject: str) -> list[dict[str, Any]]:
    """See `Database.consent_history`."""
    snapshot = Snapshot(place)
    takes = [take for take in snapshot.takes("capture") if subject_of(take) == subject]
    sources = [(snapshot.record("capture", t), f"capture of {t}") for t in takes]
    if snapshot.has(CONSENT, subject):
        sources += [(one, "record") for one in snapshot.history(CONSENT, subject)]
    if not sources:
        require_subject(place, subject)
    return [
        {
            "created": record.created,
            "scope": list(consent_scope(record.provenance)),
            "source": source,
        }
        for record, source in sources
    ]


def create_release(place: Place, name: str, takes: Sequence[str] | None) -> Record:
    """See `Database.create_release`."""
    require_text(name, TAKE, "name of a release")
    snapshot = Snapshot(place)
    if snapshot.has(RELEASE, name):
        raise input_error(
            name,
            "a release must have a new name",
            f"a release of {snapshot.record(RELEASE, name).created}",
            "choose another name",
        )
    fitted = snapshot.takes("model")
    names = fitted if takes is None else list(dict.fromkeys(takes))
    if unknown := [take for take in names if take not in fitted]:
        rule = "a release must consist of takes with a model"
        cure = f"takes with a model: {', '.join(fitted) or 'none'}"
        raise InputError(Fault(take, rule, "no model", cure) for take in unknown)
    require(
        names, name, "a release needs fitted takes", "no model", "run skindb fit first"
    )
    pins = [
        snapshot.record(kind, take).as_input()
        for take in names
        for kind in PINNED
        if snapshot.has(kind, take)
    ]
    return commit_release(place, name, pins)


def commit_release(
    place: Place, name: str, pins: Iterable[Mapping[str, Any]]
) -> Record:
    """Commit a release, or a new revision of it."""
    inputs = [dict(pin) for pin in pins]
    with Stage(place, RELEASE, name, names={pin["take"] for pin in inputs}) as stage:
        return stage.commit({"command": "release", "release": name, "inputs": inputs})


def require_subject(place: Place, subject: str) -> None:
    """Raise an `InputError` if the database holds no version of a subject."""
    subjects = Snapshot(place).subjects()
    if subject in subjects:
        return
    finding = f"subjects: {few_names(subjects, MAX_NAMED) or 'none'}"
    cure = "see skindb info"
    if subject_of(subject) in subjects:
        cure = f"the subject of that take is {subject_of(subject)}"
    raise input_error(subject, "the database must hold the subject", finding, cure)
