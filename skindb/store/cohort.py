"""Cohorts: data of many takes as one lazy Dataset; see `Database.cohort`."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Literal

import numpy as np
from xarray import Dataset

from skindb.errors import Fault, InputError, few_names, input_error, require
from skindb.schema.cohort import (
    Part,
    Source,
    Values,
    combine,
    one_take_each,
    take_coords,
    values_of,
)
from skindb.schema.notes import Note, note, note_lines
from skindb.store.arrays import open_group
from skindb.store.entries import collection_paused
from skindb.store.gathered import (
    Address,
    StoredTables,
    require_recorded,
    table_sources,
)
from skindb.store.place import SUMMARY, Located
from skindb.store.record import Record, intact_or_none
from skindb.store.snapshot import Lookup

# takes that are read faster by themselves than from caches that hold many others
FEW_TAKES = 32
Layout = Literal["tables", "surfels", "maps"]
GROUP: dict[str, str] = {"tables": "tables", "surfels": "sample", "maps": "maps"}
SAMPLES = "reflectance_sample"
DOME = ("light_position", "camera_position")
DOME_DIMS = ("light", "camera", "channel", "xyz")
Contents = Mapping[str, Any]  # description of a group in a record
NO_CONTENTS: Contents = {"variables": [], "sizes": {}, "labels": {}}
# variables, sizes and labels of a part
Layouts = tuple[Sequence[str], Mapping[str, int], Mapping[str, Sequence[Any]]]
# cached by a process; open groups hold no values
MAX_OPEN_GROUPS = 512


@dataclass(frozen=True)
class CohortRequest:
    """Parameters of a cohort; see `Database.cohort`."""

    layout: Layout
    surfels: int = 2000
    size: int = 512
    digest: str = ""  # of the code that computed the summary; empty for any
    variables: tuple[str, ...] | None = None  # by default all


@dataclass(frozen=True)
class StoredGroup:
    """A group of a version as a source of variables."""

    address: Address
    group: str

    def read(self, name: str) -> Values:
        """Values of a variable of the group."""
        return _read(self.address, self.group, name)


@dataclass(frozen=True)
class StoredSamples:
    """The sample of surfels of a model, with their reflectance samples from the capture
    of the model.
    """

    address: Address
    capture: Address
    surfels: int

    def read(self, name: str) -> Values:
        """Values of a variable of the sample or of the dome, or the reflectance samples."""
        if name in DOME:
            return _read(self.capture, "dome", name)
        if name != SAMPLES:
            return _read(self.address, "sample", name)
        sample = _group(self.address, "sample")
        index = sample["surfel_index"].values[: self.surfels]
        order = np.argsort(index)
        chosen = _group(self.capture, "samples").isel(surfel=index[order])
        array, labels = values_of(chosen[[name]].compute(scheduler="synchronous"), name)
        return Values(array[np.argsort(order)], labels)


def _read(address: Address, group: str, name: str) -> Values:
    ds = _group(address, group)[[name]]
    return values_of(ds.compute(scheduler="synchronous"), name)


@collection_paused()
def cohort(
    lookup: Lookup,
    request: CohortRequest,
    *,
    kind: str,
    takes: Sequence[str] | None,
    dim: str,
) -> Dataset:
    """See `Database.cohort`."""
    layout = request.layout
    rule = f"must be one of {', '.join(GROUP)}"
    require(layout in GROUP, "layout", rule, repr(layout), "choose one")
    rule = "must be take or subject"
    require(dim in ("take", "subject"), "dim", rule, repr(dim), "choose one")
    base = "registration" if layout == "maps" else kind
    names, skipped = _members(lookup, base, takes)
    records = {take: lookup.record(base, take) for take in names}
    stored = _stored_records(lookup, records, request)
    parts = _parts(lookup, stored, request)
    if empty := [
        part.take
        for part in parts
        if layout == "surfels" and "surfel_index" not in part.variables
    ]:
        parts = [part for part in parts if part.take not in empty]
        skipped += [note(take, "none of its surfels was fitted") for take in empty]
    chosen = request.variables
    if layout == "surfels" and chosen is None and not _have_same_dome(parts):
        parts = _without_samples(parts)
    sizes = {"surfel": request.surfels} if layout == "surfels" else {}
    attrs = {
        "layout": layout,
        "kind": base,
        "skipped": skipped,
        "outdated": _outdated(lookup, records),
    }
    combined = combine(parts, variables=chosen, sizes=sizes, attrs=attrs)
    return one_take_each(combined) if dim == "subject" else combined


def _stored_records(
    lookup: Lookup, records: Mapping[str, Record], request: CohortRequest
) -> dict[str, Record]:
    """The versions with the data of each take; an `InputError` names takes without them."""
    stored = {
        take: version
        for take, record in records.items()
        if (version := _stored_record(lookup, record, request))
    }
    if missing := [take for take in records if take not in stored]:
        kind = records[missing[0]].kind
        data = {
            "maps": f"maps of {request.size} texels",
            "surfels": f"a sample of {request.surfels} surfels",
        }.get(request.layout, request.layout)
        raise input_error(
            few_names(missing),
            f"the {kind} must store {data}",
            "none, or others",
            "call skindb.workflow.summarise for them",
        )
    return stored


def _outdated(lookup: Lookup, records: Mapping[str, Record]) -> list[Note]:
    """One note for each take whose model was not made from the newest capture."""
    notes = []
    for take in records:
        if lookup.has("capture", take) and lookup.has("model", take):
            newest = lookup.record("capture", take)
            model = lookup.record("model", take)
            if model.is_outdated(newest):
                earlier = max(n for kind, _, n in model.input_keys if kind == "capture")
                text = f"its model was made from capture {earlier}"
                text += f", but the newest is {newest.generation}; run skindb fit"
                notes.append(note(take, text))
    return notes


def lacking(
    db: Located,
    kind: str,
    requests: Iterable[CohortRequest],
    takes: Iterable[str],
    *,
    release: str | None = None,
) -> list[str]:
    """Takes whose versions of a kind, and the summaries of these versions, lack data
    that the cohorts need.
    """
    lookup = Lookup(db, release)
    requested = list(requests)
    return [
        take
        for take in takes
        if any(
            _stored_record(lookup, lookup.record(kind, take), request) is None
            for request in requested
        )
    ]


def _members(
    lookup: Lookup, kind: str, takes: Sequence[str] | None
) -> tuple[list[str], list[Note]]:
    """Takes that the cohort may use, and one note for each skipped take."""
    available = sorted(lookup.takes(kind))
    names = available if takes is None else list(dict.fromkeys(takes))
    if unknown := [take for take in takes or () if not lookup.has(kind, take)]:
        rule = f"every take of a cohort must have a {kind}"
        cure = f"takes with one: {', '.join(available) or 'none'}"
        raise InputError(Fault(take, rule, "none", cure) for take in unknown)
    if not names:
        cure = f"run skindb {'register' if kind == 'registration' else 'fit'} first"
        rule = "a study needs fitted takes"
        raise input_error(lookup.place.name, rule, f"no {kind}", cure)
    allowed = []
    skipped = []
    lacks_registration = False
    for take in names:
        if "statistics" not in lookup.scope(take):
            skipped.append(note(take, "its consent does not cover statistics"))
        elif kind == "registration" and not _is_of_current_model(lookup, take):
            text = (
                "its registration was made from an earlier model; run skindb register"
            )
            skipped.append(note(take, text))
            lacks_registration = True
        else:
            allowed.append(take)
    if kind == "registration":
        allowed, rest = _largest_frame(lookup, allowed)
        reason = "it was not registered together with the others; run skindb register"
        skipped += [note(take, reason) for take in rest]
    if not allowed:
        finding = "; ".join(note_lines(skipped[:3]))
        cure = "see skindb consent"
        rule = "statistics need takes that consent to them"
        if lacks_registration:
            rule = "at least one take must have an up-to-date registration"
            cure = ""
        raise input_error("population", rule, finding, cure)
    return allowed, skipped


def _is_of_current_model(lookup: Lookup, take: str) -> bool:
    registration = lookup.record("registration", take)
    return (
        lookup.has("model", take)
        and lookup.record("model", take).key in registration.input_keys
    )


def _largest_frame(lookup: Lookup, takes: Sequence[str]) -> tuple[list[str], list[str]]:
    """The largest group of takes that were registered together, and the others, whose
    (u, v) differ.
    """
    frames: dict[str, list[str]] = {}
    for take in takes:
        frame = frame_of(lookup.record("registration", take))
        frames.setdefault(frame, []).append(take)
    largest = max(frames.values(), key=len, default=[])
    return largest, [take for take in takes if take not in set(largest)]


def frame_of(registration: Record) -> str:
    """Key of the common (u, v) of a registration, which is equal for takes that were
    registered together.
    """
    provenance = registration.provenance
    inputs = sorted(
        (str(reference["take"]), str(reference["seal"]))
        for reference in registration.made_from
    )
    code = provenance.get("code_digest", "")
    return json.dumps([inputs, provenance["parameters"], code], sort_keys=True)


def _coords(lookup: Lookup, take: str) -> dict[str, Any]:
    """Coordinates of a take: attributes of its capture and parameters of its model."""
    about = lookup.about(take)
    if not lookup.has("model", take):
        return take_coords(take, about, None)
    model = lookup.record("model", take)
    generation = {"model_generation": model.generation}
    return take_coords(take, about, model.provenance) | generation


def _stored_record(
    lookup: Lookup, record: Record, request: CohortRequest
) -> Record | None:
    """The record of the version with the data for a cohort: the given one, or a summary
    of it; None if neither.
    """
    if request.layout == "maps":
        # a summary may have some of the maps; all are those of the registration
        stored = record.contents.get("maps", NO_CONTENTS)["variables"]
        names = stored if request.variables is None else request.variables
        request = replace(
            request, variables=tuple(name for name in names if name in stored)
        )
    # preferred, because they are newer than the data of the version
    for summary in reversed(lookup.history(SUMMARY, record.take)):
        seals = [reference["seal"] for reference in summary.made_from]
        if record.seal in seals and _has_data_for(summary, request):
            return summary
    return record if _has_data_for(record, request) else None


def _has_data_for(record: Record, request: CohortRequest) -> bool:
    parameters = record.provenance.get("summary_parameters", {})
    if request.digest and parameters.get("digest", "") != request.digest:
        return False
    contents = record.contents.get(GROUP[request.layout])
    if contents is None:  # the take of a summary without a sample has no fitted surfels
        has_tables = record.kind == SUMMARY and "tables" in record.contents
        return request.layout == "surfels" and has_tables
    if request.layout == "surfels":
        count = int(contents["sizes"]["surfel"])
        # fewer than requested: the sample contains all fitted surfels
        is_complete = count < int(parameters.get("surfels", 0))
        return count >= request.surfels or is_complete
    return request.layout == "tables" or (
        contents["sizes"]["u"] == request.size
        and set(request.variables or ()) <= set(contents["variables"])
    )


def _parts(
    lookup: Lookup, stored: Mapping[str, Record], request: CohortRequest
) -> list[Part]:
    """The part of each take, from the version with its data."""
    url = lookup.place.address()
    group = GROUP[request.layout]
    needs_samples = request.layout == "surfels" and (
        request.variables is None or not {SAMPLES, *DOME}.isdisjoint(request.variables)
    )
    addresses = [Address.of(url, version) for version in stored.values()]
    sources: Iterable[Source] = (StoredGroup(one, group) for one in addresses)
    if request.layout == "tables":
        is_gathered = len(stored) > FEW_TAKES
        sources = (
            table_sources(addresses) if is_gathered else map(StoredTables, addresses)
        )
    # identities of the contents of a version and of its capture, which thousands of
    # takes share -> these, and the layout
    layouts = {}
    parts = []
    for (take, version), address, source in zip(
        stored.items(), addresses, sources, strict=True
    ):
        contents = version.contents.get(group, NO_CONTENTS)
        dome = NO_CONTENTS
        if needs_samples and "surfel_index" in contents["variables"]:
            capture = _capture_of(lookup, lookup.record("model", take))
            if capture is not None:
                dome = capture.contents["dome"]
                captured = Address.of(url, capture)
                source = StoredSamples(address, captured, request.surfels)
        key = (id(contents), id(dome))
        if key not in layouts:
            layouts[key] = (contents, dome, _layout(contents, dome))
        parts.append(Part(take, _coords(lookup, take), *layouts[key][2], source))
    return parts


def _layout(contents: Contents, dome: Contents) -> Layouts:
    """Variables, sizes and labels of a part, with the samples if there is a dome."""
    variables = list(contents["variables"])
    if dome is NO_CONTENTS:
        return variables, contents["sizes"], contents["labels"]
    sizes, labels = (
        {dim: dome[name][dim] for dim in DOME_DIMS if dim in dome[name]}
        for name in ("sizes", "labels")
    )
    variables += [SAMPLES, *DOME]
    return variables, contents["sizes"] | sizes, contents["labels"] | labels


def _capture_of(lookup: Lookup, model: Record) -> Record | None:
    """The capture with samples from which a model was made; None if there is none."""
    for key in model.input_keys:
        if key[0] == "capture":
            capture = intact_or_none(partial(lookup.generation, *key))
            has_samples = capture and {"dome", "samples"} <= capture.contents.keys()
            return capture if has_samples else None
    return None


def _have_same_dome(parts: Sequence[Part]) -> bool:
    """Whether all takes were measured under the same lights by the same cameras."""
    domes = [(part.labels.get("light"), part.labels.get("camera")) for part in parts]
    return all(SAMPLES in part.variables for part in parts) and all(
        dome == domes[0] for dome in domes
    )


def _without_samples(parts: Sequence[Part]) -> list[Part]:
    """The parts without the reflectance samples and the dome; those with the same
    variables share them again.
    """
    remaining = {
        id(part.variables): [v for v in part.variables if v not in (SAMPLES, *DOME)]
        for part in parts
    }
    return [replace(part, variables=remaining[id(part.variables)]) for part in parts]


@lru_cache(MAX_OPEN_GROUPS)
def _group(address: Address, name: str) -> Dataset:
    record = address.record()
    return require_recorded(record, name, open_group(address.place, record, name))
