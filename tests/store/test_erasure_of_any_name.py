"""Withdrawals from databases whose pseudonyms are words of everything else: only typed
references decide.
"""

from __future__ import annotations

import json
import random
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from traces import contents

from skindb.schema import dataset
from skindb.store import Database, Record

DATABASES = 60
# pseudonyms, and at the same time words of messages, sites, regions, attributes,
# studies, releases and conditions
WORDS = (
    "0 1 2 3 5 16 43 59 94 98 007 1e5 -1 _ - a A aa aA no to of rays rank are "
    "skipped model models take takes capture "
    "registration population edit summary release calibration consent first "
    "withdrawn readmitted secret staging tmp "
    "log data heads leases tombstones requests names tables manifest json zarr now "
    "normal lotion face beard cheek neck "
    "age gender traits translucency albedo statistics fit null true None S0 S01 "
    "S012 S01-b S_01 S01_ r1 dome "
    "20261125T010101-0123abcd 0000000000000001 0123456789abcdef"
).split()
# what a fit of 43 lights and others record, in which earlier versions searched for pseudonyms
MESSAGES = (
    "43 of 59 are skipped (rank 16; no rays to a model)",
    "S01: its consent does not cover statistics",
    "registration: 3 takes with up to 20 landmarks",
)


@dataclass
class Planted:
    """A version of a planted database, and what it refers to by the account of this test alone."""

    record: Record
    takes: set[str]  # of the version and of everything it refers to
    inputs: list[Planted] = field(default_factory=list)

    @property
    def has_subject(self) -> bool:
        """Whether its take is one of a subject."""
        return self.record.kind not in ("population", "release", "calibration")

    @property
    def is_kept(self) -> bool:
        """Whether it is of one subject, and therefore outlives a product of others that
        it was made from.
        """
        return self.record.kind in ("capture", "model", "consent")


class Planter:
    """Commits random versions.

    Parameters
    ----------
    db
        Empty database.
    draw
        Source of random choices.
    """

    def __init__(self, db: Database, draw: random.Random) -> None:
        self.db = db
        self.draw = draw
        self.versions: list[Planted] = []
        subjects = draw.sample(WORDS, draw.randint(2, 4))
        condition = draw.choice(WORDS)
        self.subjects = subjects
        self.takes = [*subjects]
        self.takes += [
            f"{draw.choice(subjects)}.{condition}{visit}"
            for visit in ("", ".2", ".2.3")
        ]

    def words(self, count: int) -> list[str]:
        """Words that may be pseudonyms."""
        return [self.draw.choice([*self.subjects, *WORDS]) for _ in range(count)]

    def commit(
        self,
        kind: str,
        take: str,
        inputs: list[Planted],
        *,
        named: set[str] = frozenset(),
        has_labels: bool = False,
    ) -> Planted:
        """Commit a version with misleading words in its provenance and its labels."""
        has_subject = kind not in ("population", "release", "calibration")
        takes = set(named).union({take} if has_subject else set())
        # the others take over what their inputs refer to
        if kind not in ("capture", "model", "consent"):
            takes = takes.union(*(one.takes for one in inputs))
        about: dict[str, Any] = {
            "consent_scope": ["fit", "statistics"],
            "inputs": [one.record.as_input() for one in inputs],
            "skipped": [
                *MESSAGES,
                *self.words(2),
                {"take": "", "reason": " ".join(self.words(3))},
            ],
            "traits": dict.fromkeys(self.words(2), self.words(1)[0]),
            "parameters": {"what": self.words(1)[0], self.words(1)[0]: self.words(2)},
            "session": self.words(1)[0],
        }
        with self.db.stage(kind, take, names=takes) as stage:
            if has_labels:
                labels = {
                    "site": list(dict.fromkeys(self.words(3))),
                    "channel": ["R", "G", "B"],
                }
                stage.write(
                    {
                        "translucency": dataset(
                            {"site_sigma_tr": _ones(labels)}, coords=labels
                        )
                    }
                )
            record = stage.commit(about)
        planted = Planted(record, takes, inputs)
        self.versions.append(planted)
        return planted

    def plant(self) -> None:
        """Captures, models, and results of several takes."""
        draw = self.draw
        models: dict[str, Planted] = {}
        products: list[Planted] = []
        for take in dict.fromkeys(self.takes):
            capture = self.commit("capture", take, [], has_labels=draw.random() < 0.1)
            shared = [draw.choice(products)] if products and draw.random() < 0.3 else []
            models[take] = self.commit("model", take, [capture, *shared])
            if draw.random() < 0.2:
                models[take] = self.commit("model", take, [capture])
            if draw.random() < 0.2:
                products.append(
                    self.commit("calibration", self.words(1)[0], [models[take]])
                )
            if draw.random() < 0.2:
                self.commit("consent", take.partition(".")[0], [])
        for _ in range(draw.randint(1, 3)):
            used = draw.sample(sorted(models), draw.randint(1, len(models)))
            named = set(draw.sample(sorted(models), draw.randint(0, 1)))
            inputs = [models[take] for take in used]
            kind = draw.choice(
                ["population", "release", "registration", "summary", "edit"]
            )
            take = (
                draw.choice(used)
                if kind in ("registration", "summary", "edit")
                else self.words(1)[0]
            )
            made = self.commit(kind, take, inputs, named=named)
            if kind == "population" and draw.random() < 0.7:
                self.commit("edit", draw.choice(used), [models[used[0]], made])

    def doomed(self, subject: str) -> list[Planted]:
        """The versions that a withdrawal must remove."""
        refers: dict[int, bool] = {}
        for one in self.versions:  # inputs come before what was made from them
            own = any(take.partition(".")[0] == subject for take in one.takes)
            if one.record.kind == "release":
                refers[id(one)] = own
            else:
                refers[id(one)] = own or any(
                    refers.get(id(used), False) for used in one.inputs
                )
        doomed = [
            one
            for one in self.versions
            if refers[id(one)] and not (one.is_kept and not _is_of(one, subject))
        ]
        gone = {id(one) for one in doomed}
        releases = [
            one
            for one in self.versions
            if one.record.kind == "release" and id(one) not in gone
        ]
        return [
            *doomed,
            *(one for one in releases if any(id(used) in gone for used in one.inputs)),
        ]


def _is_of(one: Planted, subject: str) -> bool:
    return one.has_subject and one.record.take.partition(".")[0] == subject


def _ones(labels: dict[str, list[str]]) -> np.ndarray:
    return np.ones((len(labels["site"]), 3))


def _files_of(root: Path, record: Record) -> dict[str, bytes]:
    """Content of everything that belongs to a version."""
    stem = (root / record.path).with_suffix("")
    files = [
        path
        for top in stem.parent.glob(f"{stem.name}.*")
        for path in [top, *top.rglob("*")]
        if path.is_file()
    ]
    files.append(root / f"log/{record.kind}/{record.take}/{record.generation:08d}.json")
    return {
        str(path.relative_to(root)): path.read_bytes()
        for path in files
        if path.exists()
    }


@pytest.mark.slow
def test_erase__removes_what_refers_to_the_subject_and_nothing_else(tmp_path):
    removed = kept = 0
    for seed in range(DATABASES):
        draw = random.Random(seed)
        db = Database(tmp_path / str(seed))
        planter = Planter(db, draw)
        planter.plant()
        subjects = draw.sample(planter.subjects, 2)
        for subject in subjects:
            if not any(_is_of(one, subject) for one in planter.versions):
                continue  # everything of the second one was removed with the first
            doomed = planter.doomed(subject)
            gone = {id(one) for one in doomed}
            others = [one for one in planter.versions if id(one) not in gone]
            before = [_files_of(db.root, one.record) for one in others]
            assert all(len(files) > 2 for files in before)
            db.erase(subject)
            where = f"seed {seed}, subject {subject}"
            assert [_files_of(db.root, one.record) for one in others] == before, where
            for one in doomed:
                assert _files_of(db.root, one.record) == {}, (where, one.record)
            assert _references(db, subject) == [], where
            planter.versions = [*others, *_revisions(db, others)]
            removed += len(doomed)
            kept += len(others)
        if seed % 4 == 0:
            assert db.verify() == [], seed
        shutil.rmtree(db.root)
    assert min(removed, kept) > 2 * DATABASES


def _revisions(db: Database, versions: list[Planted]) -> list[Planted]:
    """The new revisions of releases."""
    by_seal = {one.record.seal: one for one in versions}
    found = []
    for name in db.takes("release"):
        record = db.record("release", name)
        if record.seal not in by_seal:
            inputs = [by_seal[one["seal"]] for one in record.made_from]
            found.append(
                Planted(record, set().union(*(one.takes for one in inputs)), inputs)
            )
    return found


def _references(db: Database, subject: str) -> list[str]:
    """Files and folders with a typed reference to the subject: names of takes, inputs,
    names, and labels of takes.
    """
    found = []
    for top in ("log", "data", "heads", "leases"):
        for folder in (db.root / top).glob("*/*"):
            has_subject = folder.parent.name not in (
                "population",
                "release",
                "calibration",
            )
            if (
                has_subject
                and folder.name.removesuffix(".json").partition(".")[0] == subject
            ):
                found.append(str(folder))
    for key, content in contents(db.root / "log").items():
        body = json.loads(content)
        takes = [
            one["take"]
            for one in body["provenance"]["inputs"]
            if one["kind"] not in ("population", "calibration")
        ]
        if any(take.partition(".")[0] == subject for take in [*takes, *body["names"]]):
            found.append(key)
    for request in db.requests():
        own = request.take if request.kind == "edit" else ""
        if subject in {
            take.partition(".")[0]
            for take in (own, *request.parameters.get("takes", []))
        }:
            found.append(str(request))
    return found
