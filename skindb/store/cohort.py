"""Cohorts: data of many takes as one lazy Dataset; see `Database.cohort`."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import xarray as xr

from skindb.errors import Fault, InputError, input_error, require
from skindb.schema.cohort import (
    Part,
    Source,
    combine,
    few_names,
    one_take_each,
    take_coords,
)
from skindb.schema.notes import Note, note, note_lines
from skindb.store.arrays import open_group
from skindb.store.gathered import (
    Address,
    StoredTables,
    require_recorded,
    table_sources,
)
from skindb.store.place import SUMMARY, Located
from skindb.store.record import Record
from skindb.store.snapshot import Lookup

# takes that are read faster by themselves than from caches that hold many others
FEW_TAKES = 32
Layout = Literal["tables", "surfels", "maps"]
GROUP: dict[str, str] = {"tables": "tables", "surfels": "sample", "maps": "maps"}
SAMPLES = "reflectance_sample"
DOME = ("light_position", "camera_position")
# cached by a process; open groups hold no values
MAX_OPEN_GROUPS = 512


@dataclass(frozen=True)
class CohortRequest:
    """Parameters of a cohort; see `Database.cohort`."""

    layout: Layout
    surfels: int = 2000
    size: int = 512
    seed: int = 0
    digest: str = ""  # of the code that computed the summary; empty for any


@dataclass(frozen=True)
class StoredGroup:
    """A group of a version as a source of variables."""

    address: Address
    group: str

    def read(self, name: str) -> xr.DataArray:
        """Values of a variable of the group."""
        return _group(self.address, self.group)[name].compute(scheduler="synchronous")


@dataclass(frozen=True)
class StoredSamples:
    """The sample of surfels of a model, with their reflectance samples from the capture
    of the model.
    """

    address: Address
    capture: Address
    surfels: int

    def read(self, name: str) -> xr.DataArray:
        """Values of a variable of the sample or of the dome, or the reflectance samples."""
        if name in DOME:
            return _group(self.capture, "dome")[name].compute(scheduler="synchronous")
        sample = _group(self.address, "sample")
        if name != SAMPLES:
            return sample[name].compute(scheduler="synchronous")
        index = sample["surfel_index"].values[: self.surfels]
        order = np.argsort(index)
        values = (
            _group(self.capture, "samples")[SAMPLES]
            .isel(surfel=index[order])
            .compute(scheduler="synchronous")
        )
        dome = _group(self.capture, "dome")
        labels = {
            dim: dome[dim].values for dim in ("light", "camera") if dim in dome.coords
        }
        return values.isel(surfel=np.argsort(order)).assign_coords(labels)


def cohort(
    lookup: Lookup,
    request: CohortRequest,
    *,
    kind: str,
    variables: Iterable[str] | None,
    takes: Sequence[str] | None,
    dim: str,
) -> xr.Dataset:
    """See `Database.cohort`."""
    layout = request.layout
    if layout not in GROUP:
        raise input_error(
            "layout", f"must be one of {', '.join(GROUP)}", repr(layout), "choose one"
        )
    require(
        dim in ("take", "subject"),
        "dim",
        "must be take or subject",
        repr(dim),
        "choose one",
    )
    chosen = None if variables is None else list(variables)
    base = "registration" if layout == "maps" else kind
    names, skipped = _members(lookup, base, takes)
    records = {take: lookup.record(base, take) for take in names}
    stored = _stored_records(lookup, records, request)
    parts = [
        _part(lookup, records[take], version, request, chosen)
        for take, version in stored.items()
    ]
    if layout == "tables" and len(parts) > FEW_TAKES:
        addresses = [Address.of(lookup.place, version) for version in stored.values()]
        sources = table_sources(addresses)
        parts = [
            replace(part, source=source)
            for part, source in zip(parts, sources, strict=True)
        ]
    if empty := [
        part.take
        for part in parts
        if layout == "surfels" and "surfel_index" not in part.variables
    ]:
        parts = [part for part in parts if part.take not in empty]
        skipped += [note(take, "none of its surfels was fitted") for take in empty]
    if layout == "surfels" and chosen is None and not _have_same_dome(parts):
        parts = [_without_variables(part, (SAMPLES, *DOME)) for part in parts]
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
    stored = {}
    missing = []
    for take, record in records.items():
        version = _stored_record(lookup, record, request)
        if version is None:
            missing.append(take)
        else:
            stored[take] = version
    if missing:
        contents = {
            "tables": "tables",
            "surfels": f"a sample of {request.surfels} surfels with seed {request.seed}",
            "maps": f"maps of {request.size} texels",
        }
        kind = records[missing[0]].kind
        raise input_error(
            few_names(missing),
            f"a version of kind {kind} must store {contents[request.layout]} for cohorts",
            "none, or different ones",
            "call skindb.workflow.summarise for them",
        )
    return stored


def _outdated(lookup: Lookup, records: Mapping[str, Record]) -> list[Note]:
    """One note for each take whose model was not made from the newest capture."""
    notes = []
    for take in records:
        if lookup.has("capture", take) and lookup.has("model", take):
            newest = lookup.record("capture", take).generation
            generations = [
                reference["generation"]
                for reference in lookup.record("model", take).made_from
                if reference["kind"] == "capture"
            ]
            if generations and newest not in generations:
                text = f"its model was made from capture {max(generations)}"
                text += f", but the newest is {newest}; run skindb fit"
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
    if unknown := [take for take in names if not lookup.has(kind, take)]:
        rule = f"every take of a cohort must have a {kind}"
        cure = f"takes with one: {', '.join(available) or 'none'}"
        raise InputError(Fault(take, rule, "none", cure) for take in unknown)
    if not names:
        cure = (
            "run skindb register first"
            if kind == "registration"
            else "run skindb fit first"
        )
        raise input_error(
            lookup.place.name, "a study needs fitted takes", f"no {kind}", cure
        )
    allowed = []
    skipped = []
    lacks_registration = False
    for take in names:
        if "statistics" not in lookup.scope(take):
            skipped.append(note(take, "its consent does not cover statistics"))
        elif kind == "registration" and not _is_of_current_model(lookup, take):
            skipped.append(
                note(
                    take,
                    "its registration was made from an earlier model; run skindb register",
                )
            )
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
    if not lookup.has("model", take):
        return False
    current = lookup.record("model", take)
    models = [
        (reference["kind"], reference["take"], reference["generation"])
        for reference in lookup.record("registration", take).made_from
    ]
    return ("model", take, current.generation) in models


def _largest_frame(lookup: Lookup, takes: Sequence[str]) -> tuple[list[str], list[str]]:
    """The largest group of takes that were registered together, and the others, whose
    (u, v) differ.
    """
    frames: dict[str, list[str]] = {}
    for take in takes:
        frames.setdefault(frame_of(lookup.record("registration", take)), []).append(
            take
        )
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
    model = lookup.record("model", take) if lookup.has("model", take) else None
    coords = take_coords(
        take, lookup.about(take), None if model is None else model.provenance
    )
    return coords | ({} if model is None else {"model_generation": model.generation})


def _stored_record(
    lookup: Lookup, record: Record, request: CohortRequest
) -> Record | None:
    """The record of the version with the data for a cohort: the given one, or a summary
    of it; None if neither.
    """
    for summary in reversed(lookup.history(SUMMARY, record.take)):
        sources = [(i["kind"], i["generation"], i["seal"]) for i in summary.made_from]
        if (record.kind, record.generation, record.seal) in sources and _has_data_for(
            summary, request
        ):
            return (
                summary  # preferred, because it is newer than the data of the version
            )
    return record if _has_data_for(record, request) else None


def _has_data_for(record: Record, request: CohortRequest) -> bool:
    by = record.provenance.get("summary_parameters", {}).get("digest", "")
    if request.digest and by != request.digest:
        return False
    contents = record.contents.get(GROUP[request.layout])
    if contents is None:  # the take of a summary without a sample has no fitted surfels
        return (
            request.layout == "surfels"
            and record.kind == SUMMARY
            and "tables" in record.contents
        )
    if request.layout == "surfels":
        count = contents["sizes"]["surfel"]
        parameters = record.provenance.get("summary_parameters", {})
        # fewer than requested: the sample contains all fitted surfels
        is_complete = count < int(parameters.get("surfels", 0))
        return int(parameters.get("seed", 0)) == request.seed and (
            count >= request.surfels or is_complete
        )
    return request.layout == "tables" or contents["sizes"]["u"] == request.size


def _part(
    lookup: Lookup,
    record: Record,
    stored: Record,
    request: CohortRequest,
    chosen: Sequence[str] | None,
) -> Part:
    layout = request.layout
    address = Address.of(lookup.place, stored)
    contents = stored.contents.get(
        GROUP[layout], {"variables": [], "sizes": {}, "labels": {}}
    )
    variables = list(contents["variables"])
    sizes = dict(contents["sizes"])
    labels = dict(contents["labels"])
    coords = _coords(lookup, record.take)
    source: Source = StoredTables(address)
    if layout != "tables":
        source = StoredGroup(address, GROUP[layout])
    needs_samples = chosen is None or bool({SAMPLES, *DOME} & set(chosen))
    if layout == "surfels" and "surfel_index" in variables and needs_samples:
        capture = _capture_of(lookup, lookup.record("model", record.take))
        if capture is not None:
            dome_sizes, dome_labels = _dome(capture)
            variables += [SAMPLES, *DOME]
            sizes |= dome_sizes
            labels |= dome_labels
            capture_address = Address.of(lookup.place, capture)
            source = StoredSamples(address, capture_address, request.surfels)
    return Part(record.take, coords, variables, sizes, labels, source)


def _capture_of(lookup: Lookup, model: Record) -> Record | None:
    """The capture with samples from which a model was made; None if there is none."""
    for reference in model.made_from:
        if reference["kind"] == "capture":
            try:
                capture = lookup.generation(
                    "capture", reference["take"], reference["generation"]
                )
            except InputError:
                return None
            return capture if {"dome", "samples"} <= capture.contents.keys() else None
    return None


def _dome(capture: Record) -> tuple[dict[str, int], dict[str, list[Any]]]:
    """Sizes and labels of the lights, cameras and channels of a capture."""
    contents = capture.contents
    sizes = contents["dome"]["sizes"]
    labels = contents["dome"]["labels"]
    dims = ("light", "camera", "channel", "xyz")
    return {d: sizes[d] for d in dims if d in sizes}, {
        d: labels[d] for d in dims if d in labels
    }


def _have_same_dome(parts: Sequence[Part]) -> bool:
    """Whether all takes were measured under the same lights by the same cameras."""
    domes = [(part.labels.get("light"), part.labels.get("camera")) for part in parts]
    return all(SAMPLES in part.variables for part in parts) and all(
        dome == domes[0] for dome in domes
    )


def _without_variables(part: Part, names: Iterable[str]) -> Part:
    remaining = [name for name in part.variables if name not in set(names)]
    return Part(part.take, part.coords, remaining, part.sizes, part.labels, part.source)


@lru_cache(MAX_OPEN_GROUPS)
def _group(address: Address, name: str) -> xr.Dataset:
    record = address.record()
    return require_recorded(record, name, open_group(address.place, record, name))
