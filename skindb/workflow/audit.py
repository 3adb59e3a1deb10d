"""Logging of actions that change or disclose data of subjects, before they are done.

Every public function of `skindb.workflow` that does so is decorated by `logged`, or
uses `logged_action`. What these functions call is a part of the same action, also in
other processes, and is not logged again.
"""

from __future__ import annotations

import inspect
import os
import pwd
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial, wraps
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from skindb.errors import InputError, SkindbWarning, require
from skindb.files import Attributes

if TYPE_CHECKING:
    from skindb.store import Database

P = ParamSpec("P")
Result = TypeVar("Result")
Item = TypeVar("Item")

ACTOR = "SKINDB_ACTOR"  # environment variable
MAX_ACTOR_CHARACTERS = 64
# actions that always change the database, and are refused if they cannot be logged;
# others may only read or erase
CHANGES = ("ingest", "calibrate", "fit", "edit", "consent", "release", "restore")
# actions that are logged at their end if they could not be before
ERASURES = ("withdrawal", "clean", "refresh")
BEGINNINGS = ("ingest", "calibrate", "restore")  # actions that may create a database
# arguments that an entry records if they are numbers or true
RECORDED = (
    "edited",
    "explain",
    "generation",
    "generations",
    "gltf",
    "refit",
)
NO_ARGUMENTS: Attributes = MappingProxyType({})

_stated_actor = ContextVar("skindb_actor", default="")
# databases of which an action is running that was logged
_logged_databases: ContextVar[tuple[Database, ...]] = ContextVar(
    "skindb_logged_databases", default=()
)


class NotLoggedWarning(SkindbWarning):
    """An action is done although it could not be written to the audit log."""


@contextmanager
def _set_to(variable: ContextVar[Item], value: Item) -> Iterator[None]:
    """Context in which a variable has a value."""
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)


@contextmanager
def acting_as(actor: str) -> Iterator[None]:
    """Context in which actions are logged under this name in place of that of the
    operating system's user.

    Raises
    ------
    InputError
        If the name is empty, longer than 64 characters, or cannot be printed.
    """
    with _set_to(_stated_actor, _checked_actor("actor", actor)):
        yield


@contextmanager
def logged_action(
    db: Database,
    action: str,
    takes: Iterable[str] = (),
    *,
    subjects: Iterable[str] = (),
    counts: Mapping[str, int] | None = None,
    arguments: Attributes = NO_ARGUMENTS,
    **parameters: Any,
) -> Iterator[None]:
    """Context of an action, which is logged before it begins, as one entry with
    everything that it calls.

    Parameters
    ----------
    db
        Database.
    action
        Name of the action, such as "render".
    takes, subjects
        Whose data the action changes or discloses. Only keyed hashes of the subjects are stored.
    counts
        Further numbers beside that of the takes.
    arguments
        Arguments of the action, of which only numbers and flags with a name in
        `RECORDED` are stored.
    **parameters
        Further parameters: numbers, flags and words of the code, nothing that a person typed.

    Raises
    ------
    OSError, InputError
        If an action that always changes the database cannot be logged, or if the name
        of the actor is invalid.

    Warns
    -----
    NotLoggedWarning
        If another action cannot be logged; it is done all the same.
    """
    running = _logged_databases.get()
    parameters |= {
        name: value
        for name in RECORDED
        if isinstance(value := arguments.get(name), int) and value
    }
    entry = {
        "takes": list(takes),
        "subjects": subjects,
        "counts": counts or {},
        "parameters": parameters,
    }
    error = None if db in running else _log(db, action, entry)
    if error is not None and action not in ERASURES:
        _warn(db, action, error)
    with _set_to(_logged_databases, (*running, db)):
        yield
    # which may have freed the space that an entry needs
    if error is not None and action in ERASURES:
        error = _log(db, action, entry)
        if error is not None:
            _warn(db, action, error)


def logged(
    action: str, **parameters: Any
) -> Callable[[Callable[P, Result]], Callable[P, Result]]:
    """Decorator of functions of a database `db`, which logs each call as an action, see
    `logged_action`.

    The takes are those of the argument `take` or `takes`, by default all that have a model.
    """

    def decorated(function: Callable[P, Result]) -> Callable[P, Result]:
        signature = inspect.signature(function)

        @wraps(function)
        def call(*args: P.args, **options: P.kwargs) -> Result:
            bound = signature.bind(*args, **options)
            bound.apply_defaults()
            arguments = bound.arguments | bound.arguments.get("options", {})
            db = arguments["db"]
            takes = [] if db in _logged_databases.get() else _takes_of(arguments)
            with logged_action(db, action, takes, arguments=arguments, **parameters):
                return function(*args, **options)

        return call

    return decorated


def as_part(function: Callable[[Item], Result]) -> Callable[[Item], Result]:
    """The function, which also in another process is a part of the action that is
    running here, if there is one.
    """
    running = _logged_databases.get()
    return partial(_call_as_part, function, running) if running else function


def _call_as_part(
    function: Callable[[Item], Result], running: tuple[Database, ...], item: Item
) -> Result:
    with _set_to(_logged_databases, running):
        return function(item)


def _takes_of(arguments: Attributes) -> list[str]:
    if "take" in arguments:
        return [arguments["take"]]
    takes = list(arguments.get("takes") or ())
    return takes or arguments["db"].takes("model", release=arguments.get("release"))


def _log(db: Database, action: str, entry: Attributes) -> OSError | InputError | None:
    """Create the entry of an action, or return the error if the action is done all the same."""
    actor = _actor()
    if action not in BEGINNINGS and not {"log", "audit"} & {*(db.names() or ())}:
        return None  # there is no database, as the action itself reports
    try:
        db.log_action(action, actor=actor, **entry)
    except (OSError, InputError) as error:
        if action in CHANGES:
            raise
        return error
    return None


def _warn(db: Database, action: str, error: OSError | InputError) -> None:
    reason = (
        error.faults[0].found
        if isinstance(error, InputError)
        else error.strerror or str(error)
    )
    text = f"{action} was not written to the audit log of {db.url}: {reason}"
    warnings.warn(text, NotLoggedWarning, stacklevel=4)


def _actor() -> str:
    """Who acts: the name that was stated, that of the environment, or the user of the
    operating system.
    """
    if stated := _stated_actor.get():
        return stated
    if named := os.environ.get(ACTOR):
        return _checked_actor(ACTOR, named)
    try:
        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:  # for example in a container
        return f"user {os.getuid()}"


def _checked_actor(source: str, actor: str) -> str:
    is_valid = (
        actor.isprintable()
        and actor == actor.strip()
        and 0 < len(actor) <= MAX_ACTOR_CHARACTERS
    )
    require(
        is_valid,
        source,
        f"must be 1 to {MAX_ACTOR_CHARACTERS} characters that can be printed, "
        "without spaces around them",
        repr(actor)[:200],
        "choose another name",
    )
    return actor
