"""Computing stale results again, in order of dependence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skindb._types import Progress, silent
from skindb.errors import Fault, InputError
from skindb.store import STUDY, Database, Record, UnavailableError, stale_versions
from skindb.workflow.cluster import computing_on
from skindb.workflow.edits import edit
from skindb.workflow.fit import fit_with
from skindb.workflow.registration import register_takes
from skindb.workflow.studies import STUDIES
from skindb.workflow.takes import map_takes

if TYPE_CHECKING:
    from distributed import Client

KINDS = ("model", "registration", STUDY, "edit")


@dataclass(frozen=True)
class Refreshed:
    """A stale version and what became of it."""

    kind: str
    take: str
    generation: int
    reasons: tuple[str, ...]
    record: Record | None = None  # what took its place
    fault: str = ""  # why nothing did


def stale_results(db: Database) -> list[Refreshed]:
    """The newest versions that are stale, in order of dependence, and why; nothing is made."""
    return [
        Refreshed(record.kind, record.take, record.generation, tuple(dict.fromkeys(map(str, reasons))))
        for record, reasons in stale_versions(db)
    ]


def refresh(
    db: Database,
    *,
    dictionary: Path | None = None,
    workers: int | None = None,
    client: Client | None = None,
    wait: float = 0.0,
    progress: Progress | None = None,
) -> list[Refreshed]:
    """Make stale models, registrations, studies and edits again, each with its own parameters.

    Parameters
    ----------
    db
        Database.
    dictionary
        Path of the dictionary of the fits; default the embedded one.
    workers, client
        See `map_takes`. With `client` its workers do the studies as well, see `computing_on`.
    wait
        Seconds to wait for another run that fits one of the takes.
    progress
        Called with the stage, the number of finished steps and the total number of steps.

    Returns
    -------
    list of Refreshed
        One for each stale version, in the order in which they were made. What cannot be computed again, such as a
        registration of a take whose consent does not cover statistics any more, stays as it is and is refused by every
        step that would read it.
    """
    where = {"workers": workers, "client": client}
    makers: dict[str, Callable[[list[Refreshed]], list[Refreshed]]] = {
        "model": partial(_fit_again, db, dictionary, wait, where),
        "registration": partial(_register_again, db, where),
        STUDY: partial(_study_again, db, dictionary),
        "edit": partial(_edit_again, db, dictionary),
    }
    done, tell = list[Refreshed](), progress or silent
    for number, kind in enumerate(KINDS):
        tell("refresh", number, len(KINDS))
        if stale := [one for one in stale_results(db) if one.kind == kind]:  # what was made before made others stale
            with computing_on(client if kind == STUDY else None, db.folder):
                done += makers[kind](stale)
    tell("refresh", len(KINDS), len(KINDS))
    return done


def repeat_study(db: Database, record: Record, *, dictionary: Path | None = None) -> Record:
    """Run a study again with its own parameters, stored as before; takes that are not there any more are skipped."""
    asked = dict(record.about.get("parameters", {}))
    what, name = str(asked.pop("what", "")), record.take.partition(".")[2]
    if what not in STUDIES:
        raise InputError(Fault(record.take, f"a study is one of {', '.join(STUDIES)}", repr(what), "analyze again"))
    release, takes = asked.pop("release", "") or None, asked.pop("takes", [])
    there = set(db.takes("model", release=release))
    if takes and not there & set(takes):
        raise InputError(Fault(record.take, "a study needs fitted takes", "no version of it is left", "analyze again"))
    options: dict[str, Any] = {**asked, "takes": [take for take in takes if take in there]}
    options |= {"release": release, "name": name or None}
    options |= {"group_by": options["group_by"] or None} if "group_by" in options else {}
    options |= {"dictionary": dictionary} if what in ("brdf", "traits", "surface") else {}
    study = STUDIES[what](db, **options)
    return db.record(STUDY, record.take, study.attrs["generation"])


def repeat_edit(db: Database, record: Record, *, dictionary: Path | None = None) -> Record:
    """Edit a model again by the same amounts, with the newest study of that name."""
    asked = record.about["parameters"]
    tree = edit(db, record.take, asked["amounts"], study=asked.get("study", "traits"), dictionary=dictionary)
    return db.record("edit", record.take, tree.attrs["generation"])


def _fit_again(
    db: Database, dictionary: Path | None, wait: float, where: Mapping[str, Any], stale: Sequence[Refreshed]
) -> list[Refreshed]:
    known = {one.take: one for one in stale}
    call = partial(fit_with, db, given={}, refit=True, dictionary=dictionary, wait=wait)
    done = []
    for outcome in map_takes(call, list(known), **where, shared=db.folder):
        record = outcome.value if isinstance(outcome.value, Record) else None
        done.append(_with(known[outcome.take], record, str(outcome.error or "")))
    return done


def _register_again(db: Database, where: Mapping[str, Any], stale: Sequence[Refreshed]) -> list[Refreshed]:
    """All takes together: the common (u, v) depends on each of them."""
    first = db.record("registration", stale[0].take)
    reference = first.about.get("parameters", {}).get("reference") or None
    try:
        records = register_takes(db, reference=reference, **where)
    except UnavailableError:
        raise
    except InputError as error:
        return [_with(one, None, str(error)) for one in stale]
    rule = "its consent does not cover statistics, or its model has no landmarks"
    return [_with(one, records.get(one.take), "" if one.take in records else rule) for one in stale]


def _study_again(db: Database, dictionary: Path | None, stale: Sequence[Refreshed]) -> list[Refreshed]:
    return [_again(one, partial(repeat_study, db, db.record(STUDY, one.take), dictionary=dictionary)) for one in stale]


def _edit_again(db: Database, dictionary: Path | None, stale: Sequence[Refreshed]) -> list[Refreshed]:
    return [_again(one, partial(repeat_edit, db, db.record("edit", one.take), dictionary=dictionary)) for one in stale]


def _again(one: Refreshed, make: Callable[[], Record]) -> Refreshed:
    try:
        return _with(one, make(), "")
    except UnavailableError:
        raise
    except InputError as error:
        return _with(one, None, str(error))


def _with(one: Refreshed, record: Record | None, fault: str) -> Refreshed:
    return Refreshed(one.kind, one.take, one.generation, one.reasons, record, fault)
