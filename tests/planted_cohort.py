"""A database of fitted takes of a few subjects: one in two conditions, one without
probe, one without consent.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from planted_skin import capture_of, make_skin

import skindb
from skindb import workflow
from skindb.fit import FitParameters
from skindb.reflectance.dictionary import Dictionary, embedded_dictionary
from skindb.store import Database
from skindb.workflow.derive import groups_of

PARAMETERS = FitParameters(k=2, rank=4, hold_out_lights=0.1)
EVERYTHING = ("fit", "statistics", "export")
PEOPLE: dict[str, dict[str, Any]] = {
    "S01": {"traits": {"age": 20, "gender": "female", "hair": "red"}},
    "S01.lotion": {"traits": {"age": 20, "gender": "female"}},
    "S02": {"traits": {"age": 60, "gender": "male"}, "sites": ["cheek"]},
    "S03": {"traits": {"gender": "male"}, "sites": []},
    "S04": {"traits": {"age": 50, "gender": "female"}, "scope": ["fit"]},
}


def few_materials() -> Dictionary:
    """Four of the embedded materials."""
    whole = embedded_dictionary()
    chosen = [3, 20, 44, 57]
    table = np.ascontiguousarray(whole.table[..., chosen])
    return Dictionary(
        tuple(whole.names[i] for i in chosen), table, whole.grid, "four of them"
    )


def capture(take: str, person: dict[str, Any], seed: int) -> Any:
    """Capture of one take."""
    skin = make_skin(surfels=90, lights=30, cameras=4, seed=seed)
    tree = capture_of(
        skin,
        probe=person.get("sites", True) != [],
        scope=list(person.get("scope", EVERYTHING)),
    )
    if sites := person.get("sites", ["cheek", "neck"]):
        probe = tree["probe"].to_dataset().isel(site=[0] * len(sites))
        tree["probe"] = probe.assign_coords(
            site=np.array(sites, np.dtypes.StringDType())
        )
    subject, _, condition = take.partition(".")
    tree.attrs |= {
        "subject": subject,
        "condition": condition or "normal",
        "traits": person["traits"],
        "take": take,
    }
    return tree


def database(root: Path, people: dict[str, dict[str, Any]]) -> Database:
    """Database of the fitted captures of these subjects."""
    db = skindb.open(str(root / "db"), create=True)
    for seed, (take, person) in enumerate(people.items()):
        tree = capture(take, person, seed)
        with db.stage("capture", take) as stage:
            stage.write(groups_of(tree))
            stage.commit(tree.attrs)
        workflow.fit_take(db, take, PARAMETERS, dictionary=few_materials())
    return db
