"""Requests to compute results again from which a withdrawn subject was removed.

A withdrawal writes a request before it removes a result of others, and `refresh`
computes the result and removes the request. No result is therefore lost if a withdrawal
is killed, or if a result cannot be computed at once.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

from skindb.errors import Fault
from skindb.store.paths import KIND, KINDS_WITHOUT_SUBJECT, TAKE, subject_of
from skindb.store.place import Place
from skindb.store.sealed import collect_faults, damage_as_fault, sealed, sealed_object

REQUESTS = "requests"
REQUEST_NAME = r"[0-9a-f]{64}\.json"
# parameters that name takes: those that a result is limited to, one of a registration,
# and the versions of a release
TAKES = "takes"
REFERENCE = "reference"
PINS = "pins"


@dataclass(frozen=True)
class Request:
    """A result that is to be computed again."""

    kind: str
    take: str  # empty for the registration of all takes
    parameters: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.kind} of {self.take}" if self.take else self.kind

    @property
    def key(self) -> str:
        """Key of its file; there is one request for each kind and take."""
        name = hashlib.sha256(f"{self.kind}/{self.take}".encode()).hexdigest()
        return f"{REQUESTS}/{name}.json"

    def without(self, is_withdrawn: Callable[[str], bool]) -> Request | None:
        """The request without takes of withdrawn subjects; None if nothing remains to
        be computed.
        """
        if self.kind not in KINDS_WITHOUT_SUBJECT and is_withdrawn(
            subject_of(self.take)
        ):
            return None
        parameters = dict(self.parameters)
        takes = parameters.get(TAKES)
        if takes:
            parameters[TAKES] = [
                take for take in takes if not is_withdrawn(subject_of(take))
            ]
            # an empty list would mean all takes
            if not parameters[TAKES] and not parameters.get(PINS):
                return None
        if PINS in parameters:
            parameters[PINS] = [
                pin
                for pin in parameters[PINS]
                if not is_withdrawn(subject_of(pin["take"]))
            ]
            if not any(pin["kind"] == "model" for pin in parameters[PINS]):
                return None
        reference = parameters.get(REFERENCE)
        if reference and is_withdrawn(subject_of(reference)):
            parameters[REFERENCE] = ""
        return Request(self.kind, self.take, parameters)


def write_request(place: Place, request: Request) -> None:
    """Write a request durably; it replaces one for the same result."""
    place.replace(request.key, request_content(request))


def request_content(request: Request) -> bytes:
    """Content of the file of a request."""
    return sealed(asdict(request))


def remove_request(place: Place, request: Request) -> None:
    """Remove a request."""
    place.remove(request.key)


def read_requests(place: Place) -> tuple[list[Request], list[Fault]]:
    """The readable requests, and the faults of the others."""
    requests: list[Request] = []
    faults: list[Fault] = []
    for name in place.children(REQUESTS):
        if not re.fullmatch(REQUEST_NAME, name):
            continue
        key = f"{REQUESTS}/{name}"
        request = collect_faults(partial(_read_request, place, key), faults)
        requests += [] if request is None else [request]
    return requests, faults


def _read_request(place: Place, key: str) -> Request | None:
    """A request; None if it was fulfilled meanwhile."""
    rule = "a request must be as it was written"
    cure = "remove it, and run the analysis that is missing again"
    with damage_as_fault(place.where(key), rule, cure):
        try:
            content = place.read_small(key)
        except FileNotFoundError:
            return None
        return request_from_json(content)


def request_from_json(content: bytes) -> Request:
    """The request in a file; `ValueError`, `TypeError` or `KeyError` if it is not as it
    was written.
    """
    request = Request(**sealed_object(content))
    names = [
        request.take,
        *request.parameters.get(TAKES, []),
        request.parameters.get(REFERENCE, ""),
    ]
    names += [pin["take"] for pin in request.parameters.get(PINS, [])]
    if not re.fullmatch(KIND, request.kind) or not all(
        re.fullmatch(TAKE, name) for name in names if name
    ):
        raise ValueError("names that are not those of kinds and takes")
    return request
