"""Virtual subjects: a frozen record that determines shape, skin and condition."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from skindb.parameters import CONDITIONS
from skindb.virtual.face import FaceShape

ANCESTRIES = ("european", "east_asian", "african", "south_asian")
# subjects of the paper's table 1, dataset B: ancestries, gender, how many, least and
# largest age, conditions
TABLE_1 = (
    (("european",), "male", 50, 13, 59, ("normal",)),
    (("european",), "female", 5, 24, 55, ("normal",)),
    (("european",), "female", 6, 23, 56, ("lotion", "makeup")),
    (("east_asian", "south_asian"), "male", 20, 22, 74, ("normal",)),
    (("east_asian", "south_asian"), "female", 4, 22, 65, ("normal",)),
    (("east_asian", "south_asian"), "female", 2, 24, 30, ("lotion", "makeup")),
)


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
    head_file: Path | None = None  # a head model file instead of the parametric face

    def __post_init__(self) -> None:
        for value, allowed, what in (
            (self.gender, ("female", "male"), "gender"),
            (self.ancestry, ANCESTRIES, "ancestry"),
            (self.condition, CONDITIONS, "condition"),
        ):
            if value not in allowed:
                raise ValueError(
                    f"{what} must be one of {', '.join(allowed)}; found {value!r}"
                )

    @property
    def take(self) -> str:
        """Key of this take: the subject, with the condition unless it is normal."""
        return (
            self.subject
            if self.condition == "normal"
            else f"{self.subject}.{self.condition}"
        )

    def stream(self, purpose: int) -> np.random.Generator:
        """Random generator for this person, independent of the condition, with one
        stream per purpose.
        """
        return np.random.default_rng([self.seed, purpose])


def default_people() -> tuple[Person, ...]:
    """The demo's eight takes: six subjects, the first of them also under lotion and powder."""
    base = Person(
        "V001",
        31,
        "female",
        "european",
        11,
        freckles=0.5,
        melanin=-0.3,
        blood=0.3,
        fullness=0.45,
    )
    return (
        base,
        replace(base, condition="lotion"),
        replace(base, condition="powder"),
        Person(
            "V002",
            46,
            "male",
            "european",
            22,
            beard_density=0.75,
            melanin=0.5,
            blood=0.6,
            fullness=0.55,
        ),
        Person(
            "V003",
            27,
            "male",
            "african",
            33,
            beard_density=0.35,
            melanin=0.3,
            fullness=0.4,
        ),
        Person("V004", 38, "female", "east_asian", 44, melanin=-0.2, fullness=0.6),
        Person(
            "V005",
            67,
            "male",
            "south_asian",
            55,
            beard_density=0.55,
            melanin=0.2,
            fullness=0.3,
        ),
        Person("V006", 22, "female", "african", 66, melanin=-0.9, fullness=0.7),
    )


def cohort_people(
    subjects: int = 87, *, conditions: Sequence[str] = (), seed: int = 2005
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
    seed
        Random seed for the order, ages, skins and shapes.
    """
    kinds = [(*kind, i) for kind in TABLE_1 for i in range(kind[2])]
    order = np.random.default_rng([seed, 87]).permutation(len(kinds))
    people = []
    for number in range(subjects):
        ancestries, gender, _, youngest, oldest, worn, i = kinds[
            order[number % len(kinds)]
        ]
        rng = np.random.default_rng([seed, number])
        male = gender == "male"
        age = int(rng.integers(youngest, oldest + 1))
        ancestry = ancestries[i % len(ancestries)]
        # boys have none
        shadow = rng.uniform(0.0, 0.8) * min(max(age - 14, 0) / 6, 1.0) if male else 0.0
        freckles = rng.uniform(0.0, 0.6) if ancestry == "european" else 0.0
        person = Person(
            f"P{number + 1:03d}",
            age,
            gender,
            ancestry,
            int(rng.integers(2**31)),
            worn[i % len(worn)],
            beard_density=round(float(shadow), 2),
            freckles=round(float(freckles), 2),
            melanin=float(rng.normal(0, 1)),
            blood=float(rng.normal(0, 1)),
            fullness=float(rng.uniform(0.3, 0.7)),
        )
        people += [
            person,
            *(
                replace(person, condition=condition)
                for condition in conditions
                if condition != person.condition
            ),
        ]
    return people


def face_shape(person: Person) -> FaceShape:
    """The shape of this person's face: group means, age, and individual variation.

    Differences between groups are the modeller's choice in the direction anthropometry
    reports (Farkas 1994); they give the virtual population variety and are no claim
    about anyone.
    """
    z = person.stream(1).standard_normal(18)
    male = 1.0 if person.gender == "male" else 0.0
    african = float(person.ancestry == "african")
    asian = float(person.ancestry == "east_asian")
    south = float(person.ancestry == "south_asian")
    age = np.clip((person.age - 30) / 45, 0, 1)
    child = np.clip((18 - person.age) / 10, 0, 1)
    return FaceShape(
        width=0.965 + 0.03 * male + 0.025 * asian - 0.05 * child + 0.016 * z[0],
        height=0.955 + 0.045 * male - 0.08 * child + 0.018 * z[1],
        jaw_width=50.5 + 4.5 * male + 1.5 * z[2],
        chin_forward=-1.5 + 3.0 * male - 1.0 * african + 1.2 * z[3],
        chin_width=13.0 + 4.0 * male + 1.2 * z[4],
        nose_length=-1.2
        + 2.2 * male
        - 1.0 * african
        - 1.0 * asian
        + 2.5 * age
        - 2.5 * child
        + 1.0 * z[5],
        nose_height=0.4
        + 1.2 * male
        - 2.6 * african
        - 2.2 * asian
        + 0.8 * south
        - 2.0 * child
        + 0.9 * z[6],
        nose_width=9.6
        + 1.1 * male
        + 2.6 * african
        + 0.9 * asian
        + 0.6 * age
        + 0.4 * z[7],
        bridge_depth=0.3 + 1.8 * african + 2.4 * asian - 1.2 * male + 0.7 * z[8],
        brow=float(np.clip(0.1 + 0.7 * male + 0.15 * z[9], 0, 1.2)),
        eye_distance=30.6 + 0.6 * male + 0.8 * african + 0.7 * z[10],
        eye_size=12.6 + 0.2 * z[11],
        cheekbone=float(np.clip(0.5 + 0.35 * asian + 0.15 * z[12], 0, 1.2)),
        fullness=float(np.clip(person.fullness + 0.1 * z[13] - 0.3 * age, 0, 1.1)),
        lip_fullness=float(
            np.clip(
                0.55
                + 0.4 * african
                + 0.1 * asian
                - 0.15 * male
                - 0.35 * age
                + 0.1 * z[14],
                0.05,
                1.1,
            )
        ),
        mouth_width=25.2 + 1.2 * male + 1.6 * african + 0.9 * z[15],
        sagging=float(age),
        neck_width=44.0 + 7.0 * male + 1.2 * z[16],
        asymmetry=0.5 * float(z[17]),
    )
