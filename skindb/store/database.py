"""A database: versions and their log, in a folder or a bucket."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from xarray import Dataset, DataTree

from skindb.errors import Fault, InputError, counted, input_error, require
from skindb.files import Attributes, Json, make_private
from skindb.schema.consent import CONSENT, require_consent
from skindb.store.archive import Archive
from skindb.store.arrays import open_version
from skindb.store.audit import AuditEntry, append_entry, read_audit
from skindb.store.backup import BackupReport, create_backup, erase_from_archive
from skindb.store.bucket import place_at
from skindb.store.catalogue import (
    INFO_SECTIONS,
    cached_table,
    describe_versions,
    matching,
)
from skindb.store.cohort import FEW_TAKES, CohortRequest, Layout, cohort
from skindb.store.decisions import (
    commit_release,
    consent_history,
    create_release,
    record_consent,
)
from skindb.store.entries import CACHED_KINDS
from skindb.store.erasure import (
    Erasure,
    Holdings,
    erase,
    erase_withdrawn,
    holdings_of,
    subject_holdings,
)
from skindb.store.folder import SHARED_MODES
from skindb.store.garbage import Garbage, find_garbage, remove_garbage
from skindb.store.lease import LEASE_SECONDS, Lease
from skindb.store.log import Log
from skindb.store.markers import Markers, read_markers, read_withdrawal
from skindb.store.place import subject_of
from skindb.store.record import Record
from skindb.store.snapshot import (
    Lookup,
    RecordCache,
    Snapshot,
    consent_of,
    pinned_record,
    pins_of,
)
from skindb.store.stage import Stage, read_tables
from skindb.store.stale import Request, read_requests
from skindb.store.verify import database_faults

# names at the top level that may exist after a first ingest that was killed
BEGUN = {"audit", "data", "leases", "secret", "staging", "tmp"}


class Database:
    """A database of versions; the object holds no state except its location.

    Parameters
    ----------
    url
        Folder, created by the first commit, or ``s3://bucket/prefix`` in an existing
        bucket; see docs/howto/bucket.md.
    """

    def __init__(self, url: str | os.PathLike[str]) -> None:
        text = os.fspath(url)
        self.folder = None if "://" in text else Path(text)  # None for a bucket
        self.place = place_at(text)

    def __repr__(self) -> str:
        return f"<skindb.Database {self.url!r}: {counted(len(self.takes()), 'take')}>"

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Database)
            and self.place.address() == other.place.address()
        )

    def __hash__(self) -> int:
        return hash(self.place.address())

    def __reduce__(self) -> tuple[type[Database], tuple[str]]:
        return Database, (self.place.address(),)

    @property
    def url(self) -> str:
        """Address of the folder or bucket."""
        return self.place.name

    @property
    def root(self) -> Path:
        """The folder of the database; `InputError` if it is in a bucket."""
        if self.folder is None:
            raise input_error(
                self.url,
                "the database must be in a local folder",
                "a bucket",
                "use db.url",
            )
        return self.folder

    def scratch(self) -> Path:
        """Path of a local folder for temporary files of this database, which may not exist yet."""
        return self.place.scratch()

    def make_scratch(self, folder: Path) -> None:
        """Create a folder for temporary files, and its parents, with the permissions of
        the database, so that others who may write the database can work and remove it.
        """
        if self.folder is not None:
            make_private(folder, self.folder.stat().st_mode & SHARED_MODES)

    def names(self) -> list[str] | None:
        """Names at the top level of the folder or bucket; None if the database does not
        exist yet.
        """
        return self.place.names()

    def has(self, kind: str, take: str) -> bool:
        """Whether a take has a version of this kind."""
        return Snapshot(self.place).has(kind, take)

    def kinds(self, take: str | None = None) -> list[str]:
        """Kinds of the versions of one take or of all takes."""
        return Snapshot(self.place).kinds(take)

    def takes(
        self,
        kind: str = "capture",
        *,
        where: str | None = None,
        release: str | None = None,
    ) -> list[str]:
        """Takes with a committed version of this kind.

        Takes whose records were lost are included; reading them raises an error.

        Parameters
        ----------
        kind
            Kind of the versions.
        where
            Condition on the columns of `table`: comparisons with ``and``, ``or``,
            ``not``, ``in`` and ``is missing``, see docs/howto/database.md.
        release
            Name of a release, to list only the takes of which it names such a version.

        Raises
        ------
        InputError
            If the release does not exist, or if the condition is not valid.

        Warns
        -----
        MissingWarning
            If takes are not selected because they lack an attribute that the condition compares.

        Examples
        --------
        >>> db.takes(where="condition == 'lotion' and age > 40 and fit_k == 4")  # doctest: +SKIP
        """
        if where is None:
            return sorted(Lookup(self, release).takes(kind))
        lookup = Lookup(self, release, RecordCache(self.place))
        rows = cached_table(lookup)
        return sorted(matching(rows[rows.index.isin(lookup.takes(kind))], where))

    def subjects(self) -> list[str]:
        """Subjects with at least one capture."""
        return sorted({subject_of(take) for take in self.takes("capture")})

    def record(
        self,
        kind: str,
        take: str,
        generation: int | None = None,
    ) -> Record:
        """The record of a version, by default the current one.

        Parameters
        ----------
        kind, take, generation
            Kind, take and generation of the version.

        Raises
        ------
        InputError
            If the version does not exist, if its record is damaged, or if it refers to
            a withdrawn subject.
        """
        return Snapshot(self.place).record(kind, take, generation)

    def markers(self) -> Markers:
        """The withdrawals of subjects at this moment."""
        return read_markers(self.place)

    def history(self, kind: str, take: str) -> list[Record]:
        """All records, oldest first.

        Raises
        ------
        InputError
            If a record is damaged, or is missing without a tombstone.
        """
        return Snapshot(self.place).history(kind, take)

    def read(
        self,
        kind: str,
        take: str,
        *,
        generation: int | None = None,
        release: str | None = None,
        groups: Sequence[str] | None = None,
    ) -> DataTree:
        """A version as a lazy DataTree, in blocks of 4,096 surfels.

        Every file is verified against its committed digest before it is used.

        Parameters
        ----------
        kind, take
            Kind and take of the version.
        generation
            Generation of the version, by default the newest.
        release
            Name of a release, to read the version that it names.
        groups
            Groups that are opened, by default all.

        Returns
        -------
        DataTree
            The attributes of its root are its provenance. `generation` is the
            generation of the version, and `consent_scope` is the present consent of the
            subject, see `consent`: a narrower consent also applies to versions that
            were made before it.

        Raises
        ------
        InputError
            If the version does not exist, or if one of its files is missing or has a
            different size. A file with changed content raises an `InputError` when
            values that need it are computed.
        """
        if release is None:
            record = self.record(kind, take, generation)
        else:
            snapshot = Snapshot(self.place)
            record = pinned_record(snapshot, pins_of(snapshot, release), kind, take)
        return self.version(record, groups)

    def version(self, record: Record, groups: Sequence[str] | None = None) -> DataTree:
        """The version of a record, see `read`."""
        version = open_version(self.place, record, groups)
        if record.kind not in INFO_SECTIONS:
            version.attrs |= self._consent_of(record.take)
        return version

    def _consent_of(self, take: str) -> dict[Any, Any]:
        """Consent attributes of a version that is read; the scope is empty if the
        newest record was lost.
        """
        versions = ((CONSENT, subject_of(take)), ("capture", take), ("model", take))
        try:
            snapshot = Snapshot(self.place)
            is_known = any(snapshot.has(*version) for version in versions)
            return {"consent_scope": self.consent(take)} if is_known else {}
        except InputError:
            return {"consent_scope": []}

    def consent(self, take: str) -> list[str]:
        """Scopes that the subject of a take consents to, from the newest record of consent.

        Without such a record they are those of the newest capture of the take, or of
        its newest model if there is no capture.
        """
        return list(consent_of(Snapshot(self.place), take))

    def require_consent(self, take: str, scope: str) -> None:
        """Raise an `InputError` unless the subject of a take consents to this scope."""
        require_consent({"consent_scope": self.consent(take), "take": take}, scope)

    def record_consent(self, subject: str, scope: Iterable[str]) -> Record:
        """Record the consent of a subject, which takes effect immediately for all
        present and future versions.

        Parameters
        ----------
        subject
            A subject with at least one version of a take.
        scope
            Names from `skindb.schema.consent.SCOPES`; empty for no consent. Captures
            that are ingested later do not change it.

        Raises
        ------
        InputError
            For an unknown subject or scope.
        """
        return record_consent(self.place, subject, scope)

    def consent_history(self, subject: str) -> list[Json]:
        """History of the consent of a subject, oldest first: created, scope and source
        (a capture or a record).
        """
        return consent_history(self.place, subject)

    def tables(self, record: Record) -> Dataset:
        """The tables kept beside a version; empty if it has none."""
        return read_tables(self.place, record)

    def cohort(
        self,
        layout: Layout = "tables",
        *,
        kind: str = "model",
        variables: Iterable[str] | None = None,
        takes: Sequence[str] | None = None,
        dim: str = "take",
        surfels: int = 2000,
        size: int = 512,
        release: str | None = None,
    ) -> Dataset:
        """A lazy Dataset of the population with one entry per take.

        Opening it only reads the records of the log; values are read and verified when
        they are computed.

        Parameters
        ----------
        layout
            "tables": values per take, region and probe site. "surfels": a random sample
            of fitted surfels per take, with their weights, albedo and normals and, if
            all takes share a dome, the reflectance samples that were measured there.
            "maps": albedo and translucency in the common (u, v) of registered takes.
        kind
            "model", or "registration", which adds the regions that the landmarks define.
        variables
            Names of variables, by default all. "reflectance_sample" can also be
            requested if the takes do not share a dome; lights and cameras that a take
            does not have are then NaN.
        takes
            Names of takes, by default all. Takes whose consent does not cover
            statistics are skipped and listed in the attribute "skipped".
        dim
            "take", or "subject" for the first take of each subject, in the condition normal.
        surfels
            Number of surfels of each take; models store a random sample of 5,000.
        size
            Number of texels along each side of the maps; registrations store 512.
        release
            Name of a release, whose captures, models and registrations are used instead
            of the newest ones.

        Returns
        -------
        Dataset
            Coordinates along "take" are subject, condition, visit, repeat, session, the
            attributes of the captures, and the parameters of the fit as ``fit_k``,
            ``fit_eta`` and so on. Values that a take does not have are NaN.

        Raises
        ------
        InputError
            If a take or variable does not exist, if no subject consents to statistics,
            or if the requested sample or size is not stored;
            `skindb.workflow.summarise` stores others.

        Examples
        --------
        >>> cohort = db.cohort("tables")  # doctest: +SKIP
        >>> cohort.region_diffuse_reflectance.groupby("gender").mean()  # doctest: +SKIP
        """
        # registrations are not cached, because each names every take; few takes are
        # read faster without the records of all others
        is_cached = kind == "model" and layout != "maps"
        is_cached &= takes is None or len(takes) > FEW_TAKES
        lookup = Lookup(self, release, RecordCache(self.place) if is_cached else None)
        lookup.read_ahead(CACHED_KINDS)
        chosen = None if variables is None else tuple(variables)
        combined = cohort(
            lookup,
            CohortRequest(layout, surfels, size, variables=chosen),
            kind=kind,
            takes=takes,
            dim=dim,
        )
        lookup.save()
        return combined

    def table(self, *, release: str | None = None) -> pd.DataFrame:
        """The catalogue, with one row per take.

        Parameters
        ----------
        release
            Name of a release, whose versions are used instead of the newest ones.

        Returns
        -------
        DataFrame
            Columns: subject, condition, visit, repeat, session, the attributes of the
            captures, the parameters of the fit as ``fit_k`` and so on, generation and date (UTC) of
            capture, model and registration, consent, the fraction of surfels with each
            status of the fit, and whether there is a newer capture than that of the
            model (``outdated``). Values that a take does not have are NaN.
        """
        return cached_table(Lookup(self, release, RecordCache(self.place)))

    def create_release(self, name: str, takes: Sequence[str] | None = None) -> Record:
        """Record the present versions of takes (capture, model and registration of
        each) as a release.

        Cohorts and studies of a release give the same values after later fits. A
        release never changes; only the withdrawal of a subject creates a new revision
        of it.

        Parameters
        ----------
        name
            Name of the release, of letters, digits, "-" and "_".
        takes
            Names of takes, by default all that have a model.

        Raises
        ------
        InputError
            If a release of this name exists already, or if a take has no model.
        """
        return create_release(self.place, name, takes)

    def commit_release(self, name: str, pins: Iterable[Attributes]) -> Record:
        """Commit the next revision of a release, which names these versions; prefer
        `create_release`.
        """
        return commit_release(self.place, name, pins)

    def source(
        self,
        version: DataTree,
        kind: str = "capture",
        take: str | None = None,
        groups: Sequence[str] | None = None,
    ) -> DataTree:
        """The input of this kind, and of this take if one is given, from which a
        version was made, or some groups of it.
        """
        title = str(version.attrs.get("take", "version"))
        for made_from in version.attrs.get("inputs", []):
            if made_from["kind"] == kind and take in (None, made_from["take"]):
                record = self.record(kind, made_from["take"], made_from["generation"])
                require(
                    made_from["seal"] == record.seal,
                    title,
                    f"the {kind} it was made from must exist",
                    "a different version of that generation",
                    "compute the version again",
                )
                return self.version(record, groups)
        raise input_error(
            title,
            f"its provenance must name a {kind}",
            "none",
            "compute the version again",
        )

    def stage(
        self,
        kind: str,
        take: str,
        lease: Lease | None = None,
        *,
        names: Iterable[str] = (),
    ) -> Stage:
        """A new version to be written, under a lease if one is given, that refers to
        the takes `names`; see `Stage`.
        """
        return Stage(self.place, kind, take, lease, names)

    def lease(
        self,
        take: str,
        *kinds: str,
        wait: float = 0.0,
        seconds: float = LEASE_SECONDS,
        command: str = "python",
    ) -> Lease:
        """Lease of versions of these kinds of a take, which only one run can hold at a
        time; see `Lease`.

        Examples
        --------
        >>> with db.lease("S01", "model", wait=60) as lease:  # doctest: +SKIP
        ...     with db.stage("model", "S01", lease) as stage:
        ...         stage.write(groups)
        ...         stage.commit({"command": "notebook"})
        """
        return Lease(
            self.place, take, kinds, wait=wait, seconds=seconds, command=command
        )

    def remove(self, record: Record) -> None:
        """Remove a version permanently; a tombstone with the seal of its record remains."""
        Log(self.place, record.kind, record.take).remove(record.generation)

    def holdings(self, subject: str) -> Holdings:
        """What `erase` would remove; `InputError` if there is nothing."""
        return subject_holdings(self.place, subject)

    def erase(self, subject: str, *, wait: float = 0.0) -> Erasure:
        """Withdraw a subject and remove everything that refers to it; prefer
        `skindb.workflow.withdraw`.
        """
        return erase(self.place, subject, wait=wait)

    def complete_erasures(self) -> Erasure:
        """Remove what interrupted withdrawals and writers that were suspended left of
        withdrawn subjects.
        """
        return erase_withdrawn(self.place)

    def has_remains(self) -> bool:
        """Whether data of a withdrawn subject are left, which `complete_erasures` removes."""
        return bool(holdings_of(self.place, self.markers()))

    def withdrawal(self, subject: str) -> Json | None:
        """When a subject was withdrawn, and the numbers of removed versions; None if the
        subject is not withdrawn.
        """
        return read_withdrawal(self.place, subject)

    def requests(self) -> list[Request]:
        """Results that withdrawals removed and that are to be computed again."""
        return read_requests(self.place)[0]

    def fulfil(self, request: Request) -> None:
        """Remove a request, because its result was computed."""
        self.place.remove(request.key)

    def info(
        self,
        *,
        takes: Sequence[str] | None = None,
        where: str | None = None,
        release: str | None = None,
    ) -> Json:
        """Summary of the database, {"takes": {take: {kind: {generation, path, created,
        bytes, status}}}}.

        A version with a damaged record has only "fault". A version that is out of date
        also has "stale", a list of the reasons. Studies, releases, calibrations and
        consents do not belong to a take: they are listed in the same form under
        "studies", "releases", "calibrations" and "consents", if there are any; a
        consent has "scope" instead of "status".

        Parameters
        ----------
        takes
            Names of the only takes to list, without the other sections.
        where
            Condition, see `takes`; only takes that fulfil it are listed, without the
            other sections.
        release
            Name of a release, to list the versions that it names.
        """
        return describe_versions(self, takes=takes, where=where, release=release)

    def log_action(self, action: str, **about: Any) -> None:
        """Create an entry of the audit log, see `append_entry`; prefer
        `skindb.workflow.logged_action`.
        """
        append_entry(self.place, action, **about)

    def audit(
        self, *, subject: str | None = None
    ) -> tuple[list[AuditEntry], list[Fault]]:
        """The entries of the audit log, oldest first, and the faults of the whole log.

        Parameters
        ----------
        subject
            Pseudonym, to list only what concerns this subject.
        """
        return read_audit(self.place, subject=subject)

    def verify(self) -> list[Fault]:
        """Check every record and every file of every version, and return all faults."""
        return database_faults(self.place)

    def backup(self, url: str, *, verify: bool = False) -> BackupReport:
        """Write a new state to the backup at a folder or bucket; prefer
        `skindb.workflow.backup`.
        """
        return create_backup(self.place, Archive(place_at(url)), verify=verify)

    def require_backup(self, url: str) -> None:
        """Raise an `InputError` unless there is a backup of this database at a folder or bucket."""
        archive = Archive(place_at(url))
        archive.require()
        archive.require_of(self.place)

    def erase_from_backup(self, url: str, *, wait: float = 0.0) -> int:
        """Remove subjects who were withdrawn from all states of a backup; returns the
        number of removed files.
        """
        return erase_from_archive(self.place, Archive(place_at(url)), wait=wait)

    def garbage(self, *, generations: int | None = None) -> list[Garbage]:
        """Files to which no record refers, such as those of killed runs, with their
        sizes and reasons for keeping them.

        Parameters
        ----------
        generations
            Number of newest generations of each kind and take to keep. Older
            generations are listed too, unless a version that is kept was made from
            them. Consents, releases and calibrations are always kept. By default all
            generations are kept.
        """
        return find_garbage(self.place, generations)

    def clean(self, *, generations: int | None = None) -> list[Garbage]:
        """Remove and return what `garbage` lists without a reason for keeping it; old
        generations leave tombstones.
        """
        return remove_garbage(self.place, generations)


def open(  # noqa: A001  as in xarray and zarr
    url: str | os.PathLike[str], *, create: bool | None = None
) -> Database:
    """Open a database.

    Parameters
    ----------
    url
        See `Database`.
    create
        Whether the database may be absent; its first commit then creates it. By default it
        may, with a warning.

    Returns
    -------
    Database
        With `takes()`, `table()`, `read(kind, take)`, `cohort(layout)` and `info()`.

    Raises
    ------
    InputError
        If there is no database, and `create` is False; if the folder is something else.
    """
    db = Database(url)
    if create:
        return db
    names = db.names()
    if names is None and create is None:
        text = f"{db.url}: there is no database; the first ingest will create it"
        warnings.warn(text, stacklevel=2)
        return db
    require(
        names is not None,
        db.url,
        "the database must exist",
        "nothing",
        "ingest a capture into it first",
    )
    entries = set(names or ())
    # a bucket without records has no log
    has_log = bool(entries & {"log", "tombstones", "withdrawn"})
    require(
        has_log or entries <= BEGUN,
        db.url,
        "a database must have a log",
        "a folder without one",
        "give the folder of the database",
    )
    return db
