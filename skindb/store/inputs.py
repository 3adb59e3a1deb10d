"""Checks of the inputs of a version when it is committed: that they exist and are
covered by consent.

A subject may be withdrawn, or change the consent, while the version is computed.
"""

from collections.abc import Iterable
from functools import partial

from skindb.errors import Fault, require, require_none
from skindb.files import Attributes
from skindb.schema.consent import CONSENT, consent_scope
from skindb.store.log import Log
from skindb.store.place import (
    CALIBRATION,
    KINDS_OF_ONE_SUBJECT,
    KINDS_WITHOUT_SUBJECT,
    RELEASE,
    STUDY,
    Place,
    subject_of,
)
from skindb.store.record import (
    Record,
    inputs_in,
    intact_or_none,
    own_takes,
    subjects_of,
)

# kind -> scope that its subjects must consent to when it is committed; a record of
# consent needs none
REQUIRED_SCOPES = {
    "capture": "fit",
    "model": "fit",
    "registration": "statistics",
    STUDY: "statistics",
    "edit": "statistics",
    CALIBRATION: "fit",
}


def require_inputs(place: Place, provenance: Attributes) -> list[Record]:
    """The records of the inputs of a version.

    Raises
    ------
    InputError
        If an input no longer exists, or if it was made from a product of many subjects
        that was withdrawn.
    """
    records = []
    faults = []
    for reference in inputs_in(provenance):
        title = _name(reference)
        record = _record_of(place, reference)
        if record is None:
            rule = "the inputs of a version must exist when it is committed"
            finding = "it was removed during the run"
            faults.append(Fault(title, rule, finding, "run the command again"))
            continue
        records.append(record)
        rule = "the inputs of an input must exist"
        for product in record.made_from:
            is_shared = product["kind"] in KINDS_WITHOUT_SUBJECT
            if is_shared and _record_of(place, product) is None:
                finding = f"{_name(product)} was removed"
                faults.append(Fault(title, rule, finding, "run skindb refresh"))
    require_none(faults)
    return records


def names_of(
    kind: str, take: str, provenance: Attributes, inputs: Iterable[Record]
) -> set[str]:
    """The other takes that a version refers to, directly or through its inputs.

    A capture or a model may be made from a product of many subjects, such as a
    calibration, and outlives it; it does not refer to these subjects.
    """
    names = _takes_in(provenance)
    # a release names versions, but has none of their data
    if kind not in (*KINDS_OF_ONE_SUBJECT, RELEASE):
        names = names.union(*(record.names for record in inputs))
    require_own_subject(kind, take, names)
    return names - own_takes(kind, take)


def require_own_subject(kind: str, take: str, names: Iterable[str]) -> None:
    """Raise an `InputError` if a version of a kind of one subject refers to a take of
    another subject.
    """
    foreign = sorted(name for name in names if subject_of(name) != subject_of(take))
    require(
        not foreign or kind not in KINDS_OF_ONE_SUBJECT,
        f"{kind} of {take}",
        f"a {kind} must refer to takes of its own subject only",
        f"a reference to {', '.join(foreign)}",
        "commit what many subjects share as a kind of its own, and name that "
        "version as the input",
    )


def require_consents(
    place: Place, kind: str, take: str, provenance: Attributes
) -> None:
    """Raise an `InputError` if the present consent of a subject does not cover the version."""
    scope = REQUIRED_SCOPES.get(kind)
    if scope is None:
        return
    subjects = subjects_of(kind, take, _takes_in(provenance))
    faults = []
    for subject in sorted(subjects):
        log = Log(place, CONSENT, subject)
        if not log.is_empty() and scope not in consent_scope(
            (record := log.read()).provenance
        ):
            title = f"{kind} of {take}" if kind != STUDY else f"study {take}, {subject}"
            faults.append(
                Fault(
                    title,
                    f"its subject must consent to {scope} when it is committed",
                    f"no such consent since {record.created}",
                    "nothing was committed; see skindb consent",
                )
            )
    require_none(faults)


def _record_of(place: Place, reference: Attributes) -> Record | None:
    """The record of an input; None if it was removed or replaced."""
    log = Log(place, reference["kind"], reference["take"])
    record = intact_or_none(partial(log.read, reference["generation"]))
    is_same = record is not None and record.seal == reference["seal"]
    return record if is_same else None


def _takes_in(provenance: Attributes) -> set[str]:
    """Takes of the inputs of a version."""
    return {
        str(reference["take"])
        for reference in inputs_in(provenance)
        if reference["kind"] not in KINDS_WITHOUT_SUBJECT
    }


def _name(reference: Attributes) -> str:
    return f"{reference['kind']} {reference['generation']} of {reference['take']}"
