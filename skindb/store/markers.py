"""Withdrawals of subjects, which are kept for good and without pseudonyms.

`withdrawn/<hash>.json` is an entry, which states that a subject was withdrawn. The hash
is that of the pseudonym, keyed with the random bytes in `secret`. A withdrawn subject
never comes back: who consents again gets a new pseudonym. No reader sees a version that
refers to a withdrawn subject.

No writer can bring a withdrawn subject back, although writers hold no locks and may be
suspended at any time. In a folder, a record appears in three steps: the writer (W1)
writes a temporary file in `staging/`, (W2) lists the entries and refuses if a
subject is withdrawn, and (W3) links the temporary file to the name of the record. A
withdrawal (E1) creates its entry, (E2) removes every file in `staging/`, and (E3) lists
and removes what refers to the subject. If W2 comes after E1, the writer sees the entry
and refuses. If W2 comes before E1, the temporary file exists before E2 removes it:
either W3 came first, and E3 finds the record, or W3 fails. A writer whose file was
removed although its subjects are not withdrawn starts again at W1.

In a bucket, W1 and W3 are one conditional put, and the writer repeats W2 afterwards. If
it refuses then, it removes its record. If it is killed before, readers ignore the
record, and `skindb clean` removes it.

The *marker file* is a local file outside the database that notes withdrawals and
consents. A restore of an earlier backup repeats what the file notes.
It is a JSON object with a seal that is keyed by the secret of the database. Subjects are
named by keyed hashes only. Notes are only added, except for the consents of a subject
who was withdrawn or has a newer one; what is missing, for example after a full disk, is
added by the next command that writes the file.
"""

from __future__ import annotations

import fcntl
import hashlib
import hmac
import json
import os
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

from skindb.clock import utc_time
from skindb.errors import (
    Fault,
    InputError,
    SkindbWarning,
    UnavailableError,
    attempt,
    require,
    system_fault,
)
from skindb.files import Attributes, Json, make_private, private_file, read_regular
from skindb.limits import MAX_STORE_JSON_BYTES
from skindb.schema.consent import CONSENT, consent_scope
from skindb.store.folder import flush_path
from skindb.store.place import AUDIT, Place
from skindb.store.record import (
    Record,
    damage_as_fault,
    json_object,
    seal_of,
    sealed,
    sealed_object,
    subjects_of,
)

SECRET = "secret"
SECRET_BYTES = 32
WITHDRAWN = "withdrawn"
ENTRY = re.compile(r"([0-9a-f]{64})\.json")
RESTORE_SECRET = "restore it from a backup"
RESTORING = "restoring.json"
BACKUP = "backup.json"
# names of files in `withdrawn/`, which every reader and writer lists -> what they find,
# and the cure
LOCKS = {
    RESTORING: ("a restore that is not complete", "run skindb restore again"),
    BACKUP: ("a backup", "run skindb restore, which makes a database of it"),
}
MARKER_FILE_FORMAT = 2
MARKER_FILE = "markers"  # the key in its seal
CURE_MARKER_FILE = (
    "give the right file; or rename this one, and the next withdrawal, consent or "
    "backup writes a new one"
)


class WithdrawnError(InputError):
    """A subject is withdrawn, or was withdrawn while a version with its data was written."""


@dataclass(frozen=True)
class Markers:
    """The withdrawn subjects at one moment."""

    hashes: frozenset[str]  # keyed hashes of the subjects
    secret: bytes = field(repr=False)

    def is_withdrawn(self, subject: str) -> bool:
        """Whether a subject is withdrawn."""
        return bool(self.hashes) and keyed_hash(self.secret, subject) in self.hashes

    def with_withdrawn(self, subject: str) -> Markers:
        """The withdrawals if a subject were withdrawn too."""
        return replace(self, hashes=self.hashes | {keyed_hash(self.secret, subject)})

    def hides(self, kind: str, take: str) -> bool:
        """Whether the versions of a kind of a take are those of a withdrawn subject."""
        return any(map(self.is_withdrawn, subjects_of(kind, take, ())))

    def admits(self, record: Record) -> bool:
        """Whether no subject of a version is withdrawn."""
        # most databases have no withdrawals, and many records
        return not self.hashes or not any(map(self.is_withdrawn, record.subjects))


@dataclass(frozen=True)
class WithdrawalGuard:
    """The check when a writer begins, and the last one before a file of its subjects is
    created: raises if one is withdrawn.
    """

    place: Place
    subjects: frozenset[str]

    def __call__(self) -> None:
        """Raise a `WithdrawnError` if one of the subjects is withdrawn."""
        withdrawn = filter(read_markers(self.place).is_withdrawn, self.subjects)
        rule = (
            "the subject must not be withdrawn while a version with its data is written"
        )
        cure = "nothing was committed; run the command again without the subject"
        if faults := [Fault(one, rule, "a withdrawal", cure) for one in withdrawn]:
            raise WithdrawnError(faults)


def require_secret(place: Place) -> bytes:
    """The random bytes of the database, which are created if there are none and nothing
    was made with them.
    """
    if (
        not place.file_type(SECRET)
        and not _hashes(place)
        and not place.file_type(AUDIT)
    ):
        place.create(SECRET, sealed({"secret": os.urandom(SECRET_BYTES).hex()}))
    rule = "must be as it was created, because withdrawn subjects and the audit log need it"
    with damage_as_fault(place.where(SECRET), rule, RESTORE_SECRET):
        return bytes.fromhex(sealed_object(place.read_small(SECRET))["secret"])


def read_markers(place: Place) -> Markers:
    """The withdrawn subjects, from one list."""
    hashes = _hashes(place)
    return Markers(hashes, require_secret(place) if hashes else b"")


def read_withdrawal(place: Place, subject: str) -> Json | None:
    """The entry of a subject: time, and number of removed versions of each kind; None if
    the subject is not withdrawn.
    """
    markers = read_markers(place)
    if not markers.is_withdrawn(subject):
        return None
    name = keyed_hash(markers.secret, subject)
    return _read_entry(place, markers.secret, f"{WITHDRAWN}/{name}.json")


def mark_withdrawn(place: Place, subject: str, removed: Mapping[str, int]) -> None:
    """Create the entry of a withdrawal, with the number of versions of each kind,
    unless the subject is withdrawn.
    """
    secret = require_secret(place)
    key = f"{WITHDRAWN}/{keyed_hash(secret, subject)}.json"
    body = {"withdrawn": utc_time(), "removed": dict(removed)}
    content = json.dumps({**body, "seal": keyed_seal(secret, key, body)})
    place.create(key, content.encode())


def marker_faults(place: Place) -> list[Fault]:
    """Faults of the secret and of the entries."""
    faults: list[Fault] = []
    hashes = _hashes(place)
    if not hashes and not place.file_type(SECRET):
        return faults
    secret = attempt(faults, partial(require_secret, place))
    if secret is not None:
        for name in sorted(hashes):
            key = f"{WITHDRAWN}/{name}.json"
            attempt(faults, partial(_read_entry, place, secret, key))
    return faults


def _hashes(place: Place) -> frozenset[str]:
    """Keyed hash of every subject that was withdrawn."""
    names = place.sizes(WITHDRAWN)
    for name, (finding, cure) in LOCKS.items():
        require(
            name not in names or place.is_unlocked,
            place.name,
            "must be a complete database",
            finding,
            cure,
        )
    return withdrawn_hashes(names)


def withdrawn_hashes(names: Iterable[str]) -> frozenset[str]:
    """Keyed hash of every subject that was withdrawn, from the names of the entries."""
    return frozenset(match[1] for name in names if (match := ENTRY.fullmatch(name)))


def is_sealed(secret: bytes, key: str, body: Attributes) -> bool:
    """Whether the seal of an entry is that of its content, as by `keyed_seal`."""
    content = {name: value for name, value in body.items() if name != "seal"}
    seal = str(body.get("seal")).encode(errors="replace")
    return hmac.compare_digest(seal, keyed_seal(secret, key, content).encode())


def keyed_seal(secret: bytes, key: str, body: Attributes) -> str:
    """Seal of an entry, which shows that it belongs to this secret and key."""
    return keyed_hash(secret, key + seal_of(body))


def keyed_hash(secret: bytes, text: str) -> str:
    """Hash of a text that nobody can compute without the secret."""
    return hmac.digest(
        secret, text.encode(errors="surrogatepass"), hashlib.sha256
    ).hex()


def _read_entry(place: Place, secret: bytes, key: str) -> Json:
    rule = "an entry of a withdrawal must be as it was created"
    with damage_as_fault(place.where(key), rule, RESTORE_SECRET):
        body = json_object(place.read_small(key))
        if not is_sealed(secret, key, body):
            raise ValueError("content that does not match its seal")
        return body


class MarkerFileWarning(SkindbWarning):
    """A withdrawal or consent could not be noted outside the database."""


@dataclass
class Notes:
    """What a marker file notes."""

    # key of an entry of `withdrawn/` -> content
    entries: dict[str, Json] = field(default_factory=dict)
    # hash of a subject -> its newest consent
    consents: dict[str, Json] = field(default_factory=dict)
    # keyed hashes of the seals of records of consent
    records: list[str] = field(default_factory=list)


def read_marker_file(path: Path, secret: bytes) -> Notes:
    """The notes of a marker file; `InputError` if it is damaged, or not that of the
    database with this secret.
    """
    content = read_regular(path, MAX_STORE_JSON_BYTES)
    rule = "a marker file must be as it was written"
    with damage_as_fault(str(path), rule, CURE_MARKER_FILE):
        body = json_object(content)
        if not is_sealed(secret, MARKER_FILE, body):
            raise ValueError("content that is damaged, or of another database")
        if body["format"] != MARKER_FILE_FORMAT:
            raise ValueError("another format")
        return Notes(body["entries"], body["consents"], body["records"])


def note_withdrawals(place: Place, *, is_repeated: bool = False) -> None:
    """Add the withdrawals of a database to its marker file, which is created if it is
    missing.

    Parameters
    ----------
    place
        Location of the database.
    is_repeated
        Whether the caller calls this again later, so that a failure causes no warning.
    """

    def add(notes: Notes, _: bytes) -> None:
        for name in place.sizes(WITHDRAWN):
            key = f"{WITHDRAWN}/{name}"
            match = ENTRY.fullmatch(name)
            if match and key not in notes.entries:
                notes.entries[key] = json_object(place.read_small(key))
                # what was agreed to before the withdrawal
                notes.consents.pop(match[1], None)

    _note(place, add, is_repeated=is_repeated)


def note_consents(place: Place, records: Iterable[Record]) -> None:
    """Add the records of consent among these to the marker file of their database, which
    is created if it is missing.
    """

    def add(notes: Notes, secret: bytes) -> None:
        for record in records:
            name = keyed_hash(secret, record.seal)
            if record.kind == CONSENT and name not in notes.records:
                notes.records.append(name)
                notes.consents[keyed_hash(secret, record.take)] = {
                    "consent": list(consent_scope(record.provenance)),
                    "created": record.created,
                    "record": name,
                }

    _note(place, add)


def _note(
    place: Place,
    add: Callable[[Notes, bytes], None],
    *,
    is_repeated: bool = False,
) -> None:
    """Add notes to a marker file; a file that cannot be written is a warning, because
    the database is not.
    """
    path = place.marker_file()
    try:
        secret = require_secret(place)
        # a link to another disk stays
        file = Path(os.path.realpath(path))
        with _locked(file.parent):
            notes = read_marker_file(path, secret) if file.exists() else Notes()
            before = seal_of(asdict(notes))
            add(notes, secret)
            if seal_of(asdict(notes)) != before or not file.exists():
                body = {"format": MARKER_FILE_FORMAT, **asdict(notes)}
                seal = keyed_seal(secret, MARKER_FILE, body)
                _write(file, json.dumps({**body, "seal": seal}).encode())
    except UnavailableError:
        raise
    except (OSError, InputError) as error:
        if is_repeated:
            return
        rule = (
            "withdrawals and consents must be noted outside the database, so that a "
            "restore repeats them"
        )
        fault = (
            system_fault(error, str(path))
            if isinstance(error, OSError)
            else error.faults[0]
        )
        warnings.warn(MarkerFileWarning(str(replace(fault, rule=rule))), stacklevel=2)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Context in which no other process writes a marker file in a folder."""
    make_private(folder)
    number = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(number, fcntl.LOCK_EX)
        try:
            yield
        finally:
            # closing alone keeps it while a copy of the descriptor is open
            fcntl.flock(number, fcntl.LOCK_UN)
    finally:
        os.close(number)


def _write(file: Path, content: bytes) -> None:
    """Write or replace a file durably, everything or nothing."""
    temporary = file.with_name(f".{file.name}.tmp")
    private_file(temporary).write_bytes(content)
    flush_path(temporary)
    temporary.rename(file)  # which replaces it
    flush_path(file.parent)
