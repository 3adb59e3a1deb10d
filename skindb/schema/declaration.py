"""How a stored variable is declared, and the status codes of elements: enumerations whose
members have an explanation.
"""

import re
from dataclasses import dataclass
from enum import Flag, IntEnum, auto
from typing import Self

# on the demo's subjects the standard error of R_d is 0.75 % in the median, 1.5 % beyond
# this condition number (1 % of the surfels) and 1.6 % with fewer samples than this (1
# %); errors at held-out lights do not rise with either
MAX_CONDITION_TRUSTED = 1e3
MIN_SAMPLES_TRUSTED = 16


# estimates outside are clamped to these, and flagged
SMALLEST_R_D = 1e-4
LARGEST_R_D = 0.9999
PAPER = "Weyrich et al. 2005"
HEADER = re.compile(
    r"(?P<dtype>\w+) (?P<group>\w+)/(?P<name>\w+)\((?P<dims>[\w, ]*)\) \[(?P<units>.+)\]"
)


class Explained(IntEnum):
    """A code with one sentence for the user."""

    explanation: str

    # without one: a member looked up by its code
    def __new__(cls, code: int, explanation: str = "") -> Self:
        """A member, written as its code and its sentence."""
        member = int.__new__(cls, code)
        member._value_ = code
        member.explanation = explanation
        return member


class FitStatus(Explained):
    """Status of the fit of one surfel."""

    FITTED = 0, "all stages fitted"
    UNSEEN = 1, "no camera sees the surfel under any light; nothing was fitted"
    TOO_FEW_SAMPLES = 2, "fewer samples than the fit needs; nothing was fitted"
    NO_DIFFUSE_ESTIMATE = (
        3,
        "no sample above the grazing limit and the noise floor; diffuse reflectance unknown",
    )
    DIFFUSE_CLAMPED = (
        4,
        "diffuse reflectance outside (0, 1) was clamped; do not trust it",
    )
    NOT_CONVERGED = 5, "the active set stopped at its iteration limit; see kkt_residual"
    NOT_FINITE = (
        6,
        "samples or geometry hold NaN or inf where numbers must be; nothing was fitted",
    )
    OBSTRUCTED = (
        7,
        "darker than the face and unlike any surface: hair in front of the skin, or a deep fold",
    )
    LAMBERT = (
        8,
        "three samples: normal and diffuse reflectance by Lambert's law, no gloss",
    )
    UNDETERMINED = (
        9,
        "the lights of the samples do not determine the normal; nothing was fitted",
    )


class ProbeStatus(Explained):
    """Status of the probe fit of one site and channel."""

    FITTED = 0, "fitted; sigma_tr identified"
    TOO_FEW_FIBRES = (
        1,
        "fewer than three fibres above the noise floor; nothing was fitted",
    )
    NOT_CONVERGED = 2, "the solver stopped at its iteration limit"
    AT_BOUND = 3, "a parameter ended at its bound; do not trust it"
    UNIDENTIFIED = (
        4,
        "the profile does not determine sigma_tr: its standard error exceeds its value",
    )
    POOR_FIT = (
        5,
        (
            "no single medium has this profile: clearly measured fibres differ by more "
            "than 10 % beyond the errors"
        ),
    )
    AMBIGUOUS = (
        6,
        "another sigma_tr fits nearly as well; the error contains it; a measured gain would decide",
    )
    OUT_OF_RANGE = (
        7,
        "darker than the model reaches, or 1/sigma_tr is beyond the last fibre: extrapolated",
    )
    NOT_MEASURED = 8, "the probe did not touch this site of the take"


class TexelStatus(Explained):
    """Origin of the values of a texel of a map."""

    MEASURED = 0, "measured: the nearest surfel was fitted"
    DOUBTFUL_FIT = (
        1,
        (
            "doubtful: hair hides the skin, or the fit clamped the diffuse reflectance "
            "or did not converge"
        ),
    )
    ILL_CONDITIONED = (
        2,
        f"doubtful: the condition number of the fit is above {MAX_CONDITION_TRUSTED:g}",
    )
    FEW_SAMPLES = 3, f"doubtful: the fit had fewer than {MIN_SAMPLES_TRUSTED} samples"
    FILLED = 4, "interpolated from its surroundings: the nearest surfel has no fit"
    OPENING = 5, "interpolated: an opening of the surface"
    OUTSIDE = 6, "interpolated: outside the surface"


# sigma_tr counts in statistics: a profile of several media has one slope at a distance
# too, with a wider error
IDENTIFIED = (ProbeStatus.FITTED, ProbeStatus.POOR_FIT)


def flag_attrs(status: type[Explained]) -> dict[str, object]:
    """CF `flag_values` and `flag_meanings` of a status enumeration, with the sentences
    as `flag_explanations`.
    """
    return {
        "flag_values": [int(member) for member in status],
        "flag_meanings": " ".join(member.name.lower() for member in status),
        "flag_explanations": "; ".join(
            f"{member.name.lower()}: {member.explanation}" for member in status
        ),
    }


class Use(Flag):
    """What the values of a variable are used for beyond their version."""

    NONE = 0
    COPIED = auto()  # from the surfels of a capture into its model
    REPORTED = auto()  # median and 95 % quantile stand in the report of a fit
    EXPORTED = auto()  # median and 95 % quantile stand in the manifest of an export
    SAMPLED = auto()  # in the samples of surfels and sites that cohorts read
    MAPPED = auto()  # as texel_<name> in the maps of a registered take
    SURVIVES_EDIT = auto()  # an edited model has it; others describe the unedited one
    SURFACE = auto()  # parameter of a surface model; where it is NaN nothing was fitted


@dataclass(frozen=True)
class Variable:
    """Declaration of a stored variable."""

    group: str
    name: str
    dims: tuple[str, ...]
    dtype: str
    units: str
    doc: str
    source: str = "skindb"
    uses: Use = Use.NONE
    statuses: type[Explained] | None = None  # its values are codes of this enumeration
    absent: int = 0  # integer that stands where a take has no such element


DECLARED: dict[str, Variable] = {}  # in the order of their declarations


def declare(
    header: str,
    doc: str,
    source: str = "skindb",
    uses: Use = Use.NONE,
    *,
    statuses: type[Explained] | None = None,
    absent: int = 0,
) -> str:
    """Declare a stored variable and return its name, by which code refers to it.

    Parameters
    ----------
    header
        "dtype group/name(dim, dim) [units]", where group/name is the path in a version.
    doc
        One sentence.
    source
        Of the definition.
    uses
        What the values are used for beyond their version.
    statuses
        Enumeration of the values, for a status.
    absent
        Integer that stands in a cohort where a take has no such element; numbers with a
        fraction are NaN there.
    """
    match = HEADER.fullmatch(header)
    if match is None:
        raise ValueError(
            f"{header}: a variable is declared as 'dtype group/name(dim, dim) [units]'"
        )
    name = match["name"]
    dims = tuple(match["dims"].replace(",", " ").split())
    if name in DECLARED:
        raise ValueError(f"{name} is declared twice")
    DECLARED[name] = Variable(
        match["group"],
        name,
        dims,
        match["dtype"],
        match["units"],
        doc,
        source,
        uses,
        statuses,
        absent,
    )
    return name


def names_of(use: Use) -> tuple[str, ...]:
    """Names of the variables with this use, in the order of their declarations."""
    return tuple(name for name, declared in DECLARED.items() if use in declared.uses)
