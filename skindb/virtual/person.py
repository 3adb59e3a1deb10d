"""Virtual subjects: a frozen record that determines shape, skin and condition."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from skindb.files import Json, package_json
from skindb.parameters import CONDITIONS
from skindb.schema.cohort import take_name
from skindb.virtual.face import FaceShape

# standard deviations between visits, as fractions of those between subjects: blood follows
# temperature and exertion of the day
VISIT_MELANIN = 0.1
VISIT_BLOOD = 0.4
# of dataset A
PAPER_CONDITIONS = ("normal", "lotion", "powder", "sweat", "hot", "cold", "makeup")
ANCESTRIES = ("european", "east_asian", "african", "south_asian")


@dataclass(frozen=True)
class Person:
    """One virtual subject in one condition; a seed gives the same face and skin in
    every condition.
    """

    subject: str
    age: float
    gender: str  # "female" or "male"
    ancestry: str  # one of ANCESTRIES
    seed: int
    condition: str = "normal"  # one of CONDITIONS
    beard_density: float = 0.0  # 0 shaven clean to 1 dense shadow
    freckles: float = 0.0  # 0 none to 1 many
    melanin: float = 0.0  # standard deviations from the mean of the group
    blood: float = 0.0  # standard deviations
    fullness: float = 0.5  # of the cheeks, 0 to 1
    visit: int | None = None  # None if there is only one
    bases: int | None = None  # see `skindb.parameters.SimulationParameters`

    def __post_init__(self) -> None:
        for value, allowed, name in (
            (self.gender, ("female", "male"), "gender"),
            (self.ancestry, ANCESTRIES, "ancestry"),
            (self.condition, CONDITIONS, "condition"),
        ):
            if value not in allowed:
                raise ValueError(
                    f"{name} must be one of {', '.join(allowed)}; found {value!r}"
                )

    @property
    def take(self) -> str:
        """Name of this take."""
        return take_name(self.subject, self.condition, self.visit or 1)

    def stream(self, purpose: int) -> np.random.Generator:
        """Random generator for this person, independent of the condition, with one
        stream per purpose.
        """
        return np.random.default_rng([self.seed, purpose])


def default_people() -> tuple[Person, ...]:
    """The demo's eight takes: six subjects, the first of them also under lotion and powder."""
    return tuple(Person(**row) for row in _tables()["demo"])


def cohort_people(
    subjects: int = 87,
    *,
    conditions: Sequence[str] = (),
    visits: int = 1,
    paper: bool = False,
    seed: int = 2005,
) -> list[Person]:
    """A population with the groups and ages of the paper's table 1, dataset B.

    The paper's "Asian" is East Asian and South Asian in turn, "lotion / makeup" the one
    and the other.

    Parameters
    ----------
    subjects
        Number of subjects: the first of 87 in a random order, and further similar ones
        beyond 87. The first ones do not depend on the number.
    conditions
        Further conditions that every subject is also photographed in.
    visits
        Visits of every subject in every condition. With more than one, melanin and blood
        vary between visits, normally with the standard deviations `VISIT_MELANIN` and
        `VISIT_BLOOD`, about those of the subject.
    paper
        Whether dataset A comes first: one more subject, in seven conditions.
    seed
        Random seed for the order, ages, skins and shapes.
    """
    groups = _tables()["table_1"]
    kinds = [(group, i) for group in groups for i in range(group["subjects"])]
    order = np.random.default_rng([seed, 87]).permutation(len(kinds))
    people = []
    if paper:
        subject = Person(**_tables()["dataset_a"])
        people = _takes_of(subject, PAPER_CONDITIONS, visits)
    for number in range(subjects):
        group, i = kinds[order[number % len(kinds)]]
        ancestries = group["ancestries"]
        worn = group["conditions"]
        rng = np.random.default_rng([seed, number])
        male = group["gender"] == "male"
        age = int(rng.integers(group["youngest"], group["oldest"] + 1))
        ancestry = ancestries[i % len(ancestries)]
        # boys have none
        shadow = rng.uniform(0.0, 0.8) * min(max(age - 14, 0) / 6, 1.0) if male else 0.0
        freckles = rng.uniform(0.0, 0.6) if ancestry == "european" else 0.0
        person = Person(
            f"P{number + 1:03d}",
            age,
            group["gender"],
            ancestry,
            int(rng.integers(2**31)),
            worn[i % len(worn)],
            beard_density=round(float(shadow), 2),
            freckles=round(float(freckles), 2),
            melanin=float(rng.normal(0, 1)),
            blood=float(rng.normal(0, 1)),
            fullness=float(rng.uniform(0.3, 0.7)),
        )
        people += _takes_of(person, [person.condition, *conditions], visits)
    return people


def _takes_of(person: Person, conditions: Iterable[str], visits: int) -> list[Person]:
    """A person in each of these conditions, at each visit."""
    takes = []
    for condition in dict.fromkeys(conditions):
        worn_by = replace(person, condition=condition)
        takes += _at_visits(worn_by, visits) if visits > 1 else [worn_by]
    return takes


def _at_visits(person: Person, visits: int) -> list[Person]:
    """A person at each visit, with the same skin in all conditions of a visit."""
    deviations = person.stream(3).standard_normal((visits, 2))
    return [
        replace(
            person,
            visit=number,
            melanin=person.melanin + VISIT_MELANIN * float(melanin),
            blood=person.blood + VISIT_BLOOD * float(blood),
        )
        for number, (melanin, blood) in enumerate(deviations, 1)
    ]


def face_shape(person: Person) -> FaceShape:
    """The shape of this person's face: group means, age, and individual variation.

    Differences between groups are the modeller's choice in the direction anthropometry
    reports (Farkas 1994); they give the virtual population variety and are no claim
    about anyone.
    """
    value_of = {
        "constant": 1.0,
        "male": float(person.gender == "male"),
        "african": float(person.ancestry == "african"),
        "asian": float(person.ancestry == "east_asian"),
        "south": float(person.ancestry == "south_asian"),
        "age": float(np.clip((person.age - 30) / 45, 0, 1)),
        "child": float(np.clip((18 - person.age) / 10, 0, 1)),
        "fullness": person.fullness,
    }
    terms = _tables()["shape"]
    variation = person.stream(1).standard_normal(len(terms)).tolist()
    lengths = {}
    for (name, factors), individual in zip(terms.items(), variation, strict=True):
        values = value_of | {"individual": individual}
        lengths[name] = sum(factor * values[term] for term, factor in factors.items())
    for name, (low, high) in _tables()["limits"].items():
        lengths[name] = min(max(lengths[name], low), high)
    return FaceShape(**lengths, sagging=value_of["age"])


@cache
def _tables() -> Json:
    """Subjects of the demo, the paper's table 1 (subject of dataset A, groups of dataset
    B), and the terms of a linear model of the shape of faces.
    """
    return package_json("skindb.virtual", "person.json")
