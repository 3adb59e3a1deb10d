"""Cohorts: the population data of many takes as one lazy Dataset; see `Database.cohort`."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import xarray as xr

from skindb.errors import Fault, InputError
from skindb.schema.cohort import Part, combine, few_names, one_take_each, take_coords
from skindb.store.kinds import SUMMARY
from skindb.store.known import Known
from skindb.store.log import RESTORE
from skindb.store.record import AS_RECORDED, Record
from skindb.store.stage import describe

if TYPE_CHECKING:
    from skindb.store.database import Database

Layout = Literal["tables", "surfels", "maps"]
GROUP: dict[str, str] = {"tables": "tables", "surfels": "sample", "maps": "maps"}
SAMPLES, DOME = "reflectance_sample", ("light_position", "camera_position")
OPEN_TABLES, OPEN_GROUPS = 2048, 512  # kept in a process; tables of a take are some 20 kB, open groups hold no values


@dataclass(frozen=True)
class CohortRequest:
    """Parameters of a cohort; see `Database.cohort`."""

    layout: Layout
    surfels: int = 2000
    size: int = 512
    seed: int = 0
    digest: str = ""  # of the code that made the summary; any if empty


@dataclass(frozen=True)
class Address:
    """Address of a version, by which another process finds it and detects changes."""

    db: Database
    kind: str
    take: str
    generation: int
    seal: str

    @classmethod
    def of(cls, db: Database, record: Record) -> Address:
        """Of a record."""
        return cls(db, record.kind, record.take, record.generation, record.seal)

    def record(self) -> Record:
        """The record, which must be the one that was named."""
        record = self.db.record(self.kind, self.take, self.generation)
        if record.seal != self.seal:
            where, rule = f"{self.kind} of {self.take}", "a version never changes while a cohort refers to it"
            raise InputError(Fault(where, rule, "another one of that generation", "open the cohort again"))
        return record


@dataclass(frozen=True)
class StoredTables:
    """Tables beside a version."""

    address: Address

    def read(self, name: str) -> xr.DataArray:
        """A variable of the tables."""
        return _tables(self.address)[name]


@dataclass(frozen=True)
class StoredGroup:
    """A group of a version."""

    address: Address
    group: str

    def read(self, name: str) -> xr.DataArray:
        """A variable of the group."""
        return _group(self.address, self.group)[name].compute(scheduler="synchronous")


@dataclass(frozen=True)
class StoredSamples:
    """The sample of a version, and the samples of light of those surfels from the capture it was made from."""

    address: Address
    capture: Address
    surfels: int

    def read(self, name: str) -> xr.DataArray:
        """A variable of the sample, of the dome, or the samples of light."""
        if name in DOME:
            return _group(self.capture, "dome")[name].compute(scheduler="synchronous")
        own = _group(self.address, "sample")
        if name != SAMPLES:
            return own[name].compute(scheduler="synchronous")
        index = own["surfel_index"].values[: self.surfels]
        order = np.argsort(index)
        found = _group(self.capture, "samples")[SAMPLES].isel(surfel=index[order]).compute(scheduler="synchronous")
        dome = _group(self.capture, "dome")
        labels = {dim: dome[dim].values for dim in ("light", "camera") if dim in dome.coords}
        return found.isel(surfel=np.argsort(order)).assign_coords(labels)


def cohort(
    db: Database,
    layout: Layout,
    *,
    kind: str,
    variables: Iterable[str] | None,
    takes: Sequence[str] | None,
    dim: str,
    surfels: int,
    size: int,
    seed: int,
    release: str | None,
) -> xr.Dataset:
    """See `Database.cohort`."""
    if layout not in GROUP:
        rule = f"must be one of {', '.join(GROUP)}"
        raise InputError(Fault("layout", rule, repr(layout), "choose one"))
    if dim not in ("take", "subject"):
        raise InputError(Fault("dim", "must be take or subject", repr(dim), "choose one"))
    wanted = None if variables is None else list(variables)
    base = "registration" if layout == "maps" else kind
    known = Known(db, release)
    names, skipped = _members(known, base, takes)
    asked = CohortRequest(layout, surfels, size, seed)
    records = {take: known.record(base, take) for take in names}
    stored = {take: _stored(known, record, asked) for take, record in records.items()}
    if missing := [take for take, found in stored.items() if found is None]:
        what = {"tables": "tables", "surfels": f"a sample of {surfels} surfels with seed {seed}"}
        rule = f"a version of kind {base} keeps {what.get(layout, f'maps of {size} texels')} for cohorts"
        cure = "call skindb.workflow.summarise for them"
        raise InputError(Fault(few_names(missing), rule, "none, or others", cure))
    parts = [_part(known, records[take], found, asked, wanted) for take, found in stored.items() if found is not None]
    if empty := [part.take for part in parts if layout == "surfels" and "surfel_index" not in part.variables]:
        parts = [part for part in parts if part.take not in empty]
        skipped += [f"{take}: none of its surfels was fitted" for take in empty]
    if layout == "surfels" and wanted is None and not _share_dome(parts):
        parts = [_without(part, (SAMPLES, *DOME)) for part in parts]
    sizes = {"surfel": surfels} if layout == "surfels" else {}
    attrs = {"layout": layout, "kind": base, "skipped": skipped, "outdated": _outdated(known, records)}
    whole = combine(parts, variables=wanted, sizes=sizes, attrs=attrs)
    return one_take_each(whole) if dim == "subject" else whole


def _outdated(known: Known, records: Mapping[str, Record]) -> list[str]:
    """One line for each take whose model was made from an earlier capture than the newest one."""
    lines = []
    for take in records:
        if known.has("capture", take) and known.has("model", take):
            newest = known.record("capture", take).generation
            of = [one["generation"] for one in known.record("model", take).made_from if one["kind"] == "capture"]
            if of and newest not in of:
                lines.append(f"{take}: its model is of capture {max(of)}, the newest is {newest}; run skindb fit")
    return lines


def lacking(
    db: Database, kind: str, asked: Iterable[CohortRequest], takes: Iterable[str], *, release: str | None = None
) -> list[str]:
    """Takes whose versions of a kind, and summaries of these, lack data that cohorts read."""
    known, every = Known(db, release), list(asked)
    return [take for take in takes if any(_stored(known, known.record(kind, take), one) is None for one in every)]


def _members(known: Known, kind: str, takes: Sequence[str] | None) -> tuple[list[str], list[str]]:
    """Takes whose consent permits the cohort, and one line for each other take."""
    there = sorted(take for take in known.takes(kind) if not known.is_withdrawn(take))
    names = there if takes is None else list(dict.fromkeys(takes))
    if unknown := [take for take in names if take not in there]:
        rule, cure = f"a cohort needs a {kind} of every take", f"takes with one: {', '.join(there) or 'none'}"
        raise InputError(Fault(take, rule, "none", cure) for take in unknown)
    if not names:
        cure = "run skindb register first" if kind == "registration" else "run skindb fit first"
        raise InputError(Fault(known.db.url, "a study needs fitted takes", f"no {kind}", cure))
    allowed, skipped = [], []
    for take in names:
        if "statistics" not in known.scope(take):
            skipped.append(f"{take}: its consent does not cover statistics")
        elif kind == "registration" and not _of_current_model(known, take):
            skipped.append(f"{take}: its registration is of an earlier model; run skindb register")
        else:
            allowed.append(take)
    if kind == "registration":
        allowed, others = _of_one_frame(known, allowed)
        skipped += [f"{take}: it was registered apart from the others; run skindb register" for take in others]
    if not allowed:
        found, cure = "; ".join(skipped[:3]), "see skindb consent"
        rule = "statistics need takes that consent to them"
        if any("registration" in line for line in skipped):
            rule, cure = "maps and regions by landmarks need takes with a registration that is up to date", ""
        raise InputError(Fault("population", rule, found, cure))
    return allowed, skipped


def _of_current_model(known: Known, take: str) -> bool:
    if not known.has("model", take):
        return False
    current = known.record("model", take)
    of = [(one["kind"], one["take"], one["generation"]) for one in known.record("registration", take).made_from]
    return ("model", take, current.generation) in of


def _of_one_frame(known: Known, takes: Sequence[str]) -> tuple[list[str], list[str]]:
    """Takes that were registered together, as many as there are, and the others: their (u, v) are not the same."""
    frames: dict[str, list[str]] = {}
    for take in takes:
        frames.setdefault(frame_of(known.record("registration", take)), []).append(take)
    most = max(frames.values(), key=len, default=[])
    return most, [take for take in takes if take not in set(most)]


def frame_of(registration: Record) -> str:
    """What the common (u, v) of a registration follow from: the same for takes that were registered together."""
    about = registration.about
    inputs = sorted((str(one["take"]), str(one.get("seal", one["generation"]))) for one in registration.made_from)
    return json.dumps([inputs, about["parameters"], about["software_version"]], sort_keys=True)


def _coords(known: Known, take: str) -> dict[str, Any]:
    """Coordinates of a take: attributes of its capture and parameters of its model."""
    model = known.record("model", take) if known.has("model", take) else None
    coords = take_coords(take, known.about(take), None if model is None else model.about)
    return coords | ({} if model is None else {"model_generation": model.generation})


def _stored(known: Known, record: Record, asked: CohortRequest) -> Record | None:
    """The version that holds the data of a cohort: the record itself, or a summary of it; None if there is none."""
    for one in reversed(known.db.history(SUMMARY, record.take) if known.has(SUMMARY, record.take) else []):
        of = [(i["kind"], i["generation"], i.get("seal")) for i in one.made_from]
        if (record.kind, record.generation, record.seal) in of and _suffices(one, asked):
            return one  # newer than what the version keeps itself
    return record if _suffices(record, asked) else None


def _suffices(record: Record, asked: CohortRequest) -> bool:
    by = record.about.get("summary_parameters", {}).get("digest", "")
    if asked.digest and by != asked.digest:
        return False
    contents = record.contents.get(GROUP[asked.layout])
    if contents is None:  # a summary without a sample is of a take without a fitted surfel
        return asked.layout == "surfels" and record.kind == SUMMARY and "tables" in record.contents
    if asked.layout == "surfels":
        kept, of = contents["sizes"]["surfel"], record.about.get("summary_parameters", {})
        whole = kept < int(of.get("surfels", 0))  # smaller than what was asked for: it holds every fitted surfel
        return int(of.get("seed", 0)) == asked.seed and (kept >= asked.surfels or whole)
    return asked.layout == "tables" or contents["sizes"]["u"] == asked.size


def _part(known: Known, record: Record, stored: Record, asked: CohortRequest, wanted: Sequence[str] | None) -> Part:
    db = known.db
    layout, address = asked.layout, Address.of(db, stored)
    contents = stored.contents.get(GROUP[layout], {"variables": [], "sizes": {}, "labels": {}})
    variables, sizes, labels = list(contents["variables"]), dict(contents["sizes"]), dict(contents["labels"])
    coords = _coords(known, record.take)
    if layout == "tables":
        return Part(record.take, coords, variables, sizes, labels, StoredTables(address))
    if layout == "maps" or "surfel_index" not in variables:
        return Part(record.take, coords, variables, sizes, labels, StoredGroup(address, GROUP[layout]))
    capture = _capture_of(db, known.record("model", record.take))
    if capture is None or (wanted is not None and not {SAMPLES, *DOME} & set(wanted)):
        return Part(record.take, coords, variables, sizes, labels, StoredGroup(address, GROUP[layout]))
    dome_sizes, dome_labels = _dome(db, capture)
    return Part(
        record.take,
        coords,
        [*variables, SAMPLES, *DOME],
        sizes | dome_sizes,
        labels | dome_labels,
        StoredSamples(address, Address.of(db, capture), asked.surfels),
    )


def _capture_of(db: Database, model: Record) -> Record | None:
    """The capture that a model was made from; None if it no longer exists."""
    for one in model.made_from:
        if one["kind"] == "capture":
            try:
                return db.record("capture", one["take"], one["generation"])
            except InputError:
                return None
    return None


def _dome(db: Database, capture: Record) -> tuple[dict[str, int], dict[str, list[Any]]]:
    """Sizes and labels of the lights, cameras and channels of a capture."""
    contents = capture.contents
    if "dome" in contents and "samples" in contents:
        sizes, labels = dict(contents["dome"]["sizes"]), dict(contents["dome"]["labels"])
    else:  # a capture of schema version 1: its record does not say
        dome = _group(Address.of(db, capture), "dome")
        sizes = {str(dim): size for dim, size in dome.sizes.items()}
        labels = {str(dim): dome[dim].values.tolist() for dim in dome.dims if dim in dome.coords}
    dims = ("light", "camera", "channel", "xyz")
    return {d: sizes[d] for d in dims if d in sizes}, {d: labels[d] for d in dims if d in labels}


def _share_dome(parts: Sequence[Part]) -> bool:
    """Whether all takes were measured under the same lights by the same cameras."""
    domes = [(part.labels.get("light"), part.labels.get("camera")) for part in parts]
    return all(SAMPLES in part.variables for part in parts) and all(dome == domes[0] for dome in domes)


def _without(part: Part, names: Iterable[str]) -> Part:
    kept = [name for name in part.variables if name not in set(names)]
    return Part(part.take, part.coords, kept, part.sizes, part.labels, part.source)


@lru_cache(OPEN_TABLES)
def _tables(address: Address) -> xr.Dataset:
    record = address.record()
    return _as_recorded(record, "tables", address.db.tables(record))


@lru_cache(OPEN_GROUPS)
def _group(address: Address, name: str) -> xr.Dataset:
    record = address.record()
    return _as_recorded(record, name, address.db.read_group(record, name))


def _as_recorded(record: Record, name: str, ds: xr.Dataset) -> xr.Dataset:
    """The group, which must match its record, from which the layout of the cohort was derived."""
    if name in record.contents and describe(ds) != record.contents[name]:
        where = f"{record.kind} {record.generation} of {record.take}"
        raise InputError(Fault(where, AS_RECORDED, f"another group {name}", RESTORE))
    return ds
