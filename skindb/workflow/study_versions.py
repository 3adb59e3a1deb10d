"""Studies as versions: the names they are stored under, and whether a requested one
exists already.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import xarray as xr

from skindb.analysis.members import subjects_without_normal
from skindb.store import STUDY, Database, require_text
from skindb.workflow.provenance import method_digest, provenance
from skindb.workflow.study_inputs import Frame

MAP_PERMUTATIONS = 1000  # each of 100,000 texels and more
# unless conditions are compared
OF_NORMAL_TAKES = ("groups", "maps", "surface", "correlations", "translucency")
STUDY_NAME = r"[A-Za-z0-9_-]{1,64}"
METHOD = (
    "analysis",
    "numerics",
    "optics",
    "reflectance",
    "geometry",
    "render/texels",
    "schema",
    "store/cohort",
    "workflow/studies",
    "workflow/study_inputs",
)
Groups = dict[str, xr.Dataset]
DEFAULTS = {
    "group_by": "",
    "k": 6,
    "in_metric": False,
    "seed": 0,
    "takes": [],
    "release": "",
    "adjust": [],
    "permutations": 10_000,
}
OWN_DEFAULTS: dict[str, dict[str, Any]] = {
    "maps": {"permutations": MAP_PERMUTATIONS},
    "components": {"k": 5},
}


@dataclass(frozen=True)
class StudyRequest:
    """A study as it was requested."""

    what: str
    name: str | None
    release: str | None
    takes: tuple[str, ...]
    parameters: Mapping[str, Any]
    # whose file may change: a study with one is always computed
    dictionary: Path | None = None

    def recorded(self) -> dict[str, Any]:
        """What another run needs to repeat it."""
        return {
            **self.parameters,
            "takes": list(self.takes),
            "release": self.release or "",
        }


def study_key(asked: StudyRequest) -> str:
    """What a study is stored as.

    The study of everything with default parameters is stored under its own word,
    "traits"; with other parameters it is "traits.k-8", and with a name "traits.<name>".
    No study replaces one that was asked for differently; one with another random seed
    is the next generation of the same.
    """
    if asked.name is not None:
        return f"{asked.what}.{require_text(asked.name, STUDY_NAME, 'name of a study')}"
    defaults = DEFAULTS | OWN_DEFAULTS.get(asked.what, {})
    given = {
        key: value
        for key, value in asked.recorded().items()
        if key != "seed" and value != defaults[key]
    }
    if not given:
        return asked.what
    words = dict(given)
    if "adjust" in given and "-" not in "".join(given["adjust"]):
        words["adjust"] = "-".join(given["adjust"])
    text = "_".join(f"{key}-{value}" for key, value in words.items())
    if not re.fullmatch(STUDY_NAME, text):
        text = hashlib.sha256(json.dumps(given, sort_keys=True).encode()).hexdigest()[
            :16
        ]
    return f"{asked.what}.{text}"


def made(
    db: Database,
    asked: StudyRequest,
    compute: Callable[[], Groups],
    cohort: xr.Dataset,
    frame: Frame | None = None,
) -> xr.DataTree:
    """The stored study if it was made from these very versions in this way, or a new
    one, committed.
    """
    generations = zip(
        cohort["take"].values, cohort["model_generation"].values, strict=True
    )
    markers = db.markers()
    used = [
        db.record("model", str(take), int(generation), markers=markers)
        for take, generation in generations
    ]
    used += [*frame.records.values()] if frame else []
    inputs = [record.as_input() for record in used]
    parameters = {"what": asked.what, **asked.recorded()}
    seeds = {"analyze": asked.parameters["seed"]} if "seed" in asked.parameters else {}
    key = study_key(asked)
    about = provenance("analyze", inputs, parameters=parameters, seeds=seeds)
    skipped = list(cohort.attrs["skipped"])
    if asked.what in OF_NORMAL_TAKES and not str(
        asked.parameters.get("group_by", "")
    ).startswith("condition"):
        skipped += subjects_without_normal(cohort)
    about |= {
        "study": key,
        "skipped": skipped,
        "outdated": list(cohort.attrs["outdated"]),
    }
    about |= {
        "attributes_digest": _attributes_digest(cohort),
        "method_digest": method_digest(METHOD),
    }
    if asked.dictionary is None and _is_stored(db, key, about):
        return db.read(STUDY, key)
    groups = compute()
    notes = frame.notes if frame else []
    about |= {"registration": notes} if notes else {}
    names = {record.take for record in used}.union(*(record.names for record in used))
    names |= {
        one["take"] for one in [*skipped, *about["outdated"], *notes] if one["take"]
    }
    with db.stage(STUDY, key, names=names | {*asked.takes}) as stage:
        stage.write(groups)
        stage.commit(about)
    return db.read(STUDY, key)


def _is_stored(db: Database, key: str, about: Mapping[str, Any]) -> bool:
    """Whether the newest study of that key says the same of how it was made."""
    if not db.has(STUDY, key):
        return False
    stored = db.record(STUDY, key).provenance
    return json.dumps(
        {name: stored.get(name) for name in about}, sort_keys=True
    ) == json.dumps(about, sort_keys=True)


def _attributes_digest(cohort: xr.Dataset) -> str:
    """Digest of the coordinates that describe the takes: age, gender, condition,
    parameters of the fit.
    """
    said = {
        str(name): [str(value) for value in coordinate.values]
        for name, coordinate in sorted(
            cohort.coords.items(), key=lambda item: str(item[0])
        )
        if coordinate.dims == ("take",)
    }
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()
