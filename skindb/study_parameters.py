"""Names, descriptions and parameters of the studies of a population, for their commands.

They are apart from the methods, so that the help of a command imports no science.
"""

from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from skindb.limits import MAX_PERMUTATIONS
from skindb.parameters import DICTIONARY_HELP, option, seed_option

MAX_VISITS = 100
MAX_DOSES = 10
PERMUTATIONS = 1000  # of each of 65,536 texels


class Declaration(NamedTuple):
    """What the help shows of a study."""

    name: str
    description: str
    parameters: type[Any]


def group_option() -> Any:
    """Field of a record for the attribute or trait of the groups."""
    text = "Attribute or trait by which takes are grouped: gender, age, ..."
    return option(None, text)


def compared_option() -> Any:
    """Field of a record for the attribute or trait that is compared, which has no default."""
    text = "Attribute or trait that is compared: gender, age, ..."
    return option(MISSING, text)


def adjust_option() -> Any:
    """Field of a record for attributes that a comparison is adjusted for."""
    text = "Attributes that the comparison adjusts for, separated by commas."
    return option((), text, metavar="NAME,...", show_default=False)


def quantities_option() -> Any:
    """Field of a record for the quantities of a study."""
    text = (
        "Quantities, separated by commas: R_d, surface reflectance, sigma_tr, L*, a*, b*, "
        "ITA, melanin index, erythema index, glossiness, albedo contrast, RMS slope.  "
        "[default: the first three]"
    )
    return option((), text, metavar="NAME,...", show_default=False)


def permutations_option(default: int = 10_000) -> Any:
    """Field of a record for the number of permutations."""
    text = "Largest number of permutations for p values."
    return option(default, text, minimum=100, maximum=MAX_PERMUTATIONS)


@dataclass(frozen=True)
class ContrastParameters:
    """Parameters of a study that compares groups of subjects."""

    group_by: str = compared_option()
    adjust: tuple[str, ...] = adjust_option()
    quantities: tuple[str, ...] = quantities_option()
    permutations: int = permutations_option()
    seed: int = seed_option("the permutations")


@dataclass(frozen=True)
class GroupParameters:
    """Parameters of the studies of albedo and of translucency."""

    group_by: str | None = group_option()


@dataclass(frozen=True)
class BrdfParameters:
    """Parameters of the study of the number of bases."""

    seed: int = seed_option("the bootstrap")
    dictionary: Path | None = option(None, DICTIONARY_HELP)


@dataclass(frozen=True)
class ChromophoreParameters:
    """Parameters of the study of chromophores."""

    group_by: str | None = group_option()
    seed: int = seed_option("the independent components and the bootstrap")


@dataclass(frozen=True)
class ComponentParameters:
    """Parameters of the study of components."""

    k: int = option(5, "Largest number of modes.", minimum=1)
    adjust: tuple[str, ...] = adjust_option()
    seed: int = seed_option("samples whose distance from subjects is reported")


@dataclass(frozen=True)
class CorrelationParameters:
    """Parameters of the study of correlations."""

    permutations: int = permutations_option()
    seed: int = seed_option("the permutations and the bootstrap")


@dataclass(frozen=True)
class NoParameters:
    """The study of coverage has no parameters."""


@dataclass(frozen=True)
class ModelParameters:
    """Parameters of the study of a model."""

    formula: str = option(
        MISSING,
        "Formula, such as: ITA ~ treatment * visit + age + (1 | subject).",
    )
    contrasts: tuple[str, ...] = option(
        (),
        "Sums of multiples of terms to estimate, separated by commas.",
        metavar="TERMS,...",
        show_default=False,
    )
    margin: float | None = option(
        None,
        "Largest effect that does not matter, for tests of equivalence.",
        minimum=1e-9,
        maximum=1e9,
    )


@dataclass(frozen=True)
class MapParameters(ContrastParameters):
    """Parameters of the study of maps."""

    permutations: int = permutations_option(PERMUTATIONS)


@dataclass(frozen=True)
class PlanParameters:
    """Parameters of the study that plans another one."""

    formula: str = option(
        MISSING, "Formula, such as: ITA ~ treatment * visit + (1 | subject)."
    )
    term: str = option("treatment", "Term to find, or a sum of multiples of terms.")
    effect: float = option(
        1.0, "Its value, in the unit of the quantity.", minimum=-1e9, maximum=1e9
    )
    power: float = option(0.8, "Probability to find it.", minimum=0.1, maximum=0.99)
    visits: int = option(1, "Visits of each subject.", minimum=1, maximum=MAX_VISITS)
    design: Literal["parallel", "crossover"] = option(
        "parallel",
        "Each subject has one dose of the treatment, or all of them.",
    )
    doses: int = option(
        1,
        "Largest dose: treatment is 0, 1, ... up to it.",
        minimum=1,
        maximum=MAX_DOSES,
    )
    drop_out: float = option(
        0.0, "Fraction of the subjects who leave.", minimum=0.0, maximum=0.9
    )


@dataclass(frozen=True)
class RepeatabilityParameters:
    """Parameters of the study of repeatability."""

    condition: str = option("normal", "Condition of the takes.")
    quantities: tuple[str, ...] = quantities_option()


@dataclass(frozen=True)
class SurfaceParameters:
    """Parameters of the study of surfaces."""

    group_by: str = compared_option()
    pairs: tuple[str, ...] = option(
        (),
        "Pairs of interest, separated by commas, such as: normal to lotion.  [default: all]",
        metavar="PAIR,...",
        show_default=False,
    )
    k: int = option(6, "Number of components of the common basis.", minimum=1)
    permutations: int = permutations_option()
    seed: int = seed_option("the factorisation and the permutations")
    dictionary: Path | None = option(None, DICTIONARY_HELP)


@dataclass(frozen=True)
class TraitParameters:
    """Parameters of the study of traits."""

    k: int = option(6, "Number of components of the common basis.", minimum=1)
    adjust: tuple[str, ...] = adjust_option()
    seed: int = seed_option("the factorisation and the bootstrap")
    dictionary: Path | None = option(None, DICTIONARY_HELP)


# in the order in which the help lists them
DECLARED = {
    study.name: study
    for study in (
        Declaration(
            "brdf", "number of basis BRDFs that the population needs", BrdfParameters
        ),
        Declaration("albedo", "distribution of the diffuse albedo", GroupParameters),
        Declaration(
            "translucency", "translucency by site of the face", GroupParameters
        ),
        Declaration(
            "traits",
            "vectors of BRDF, albedo and translucency for each attribute",
            TraitParameters,
        ),
        Declaration(
            "groups",
            "differences between groups of subjects, with intervals and p values",
            ContrastParameters,
        ),
        Declaration(
            "components",
            "joint modes of shape, albedo, gloss and translucency, drawn as faces",
            ComponentParameters,
        ),
        Declaration(
            "correlations",
            "correlations between albedo, surface BRDF and translucency",
            CorrelationParameters,
        ),
        Declaration(
            "maps",
            "differences between groups at every texel of the common (u, v)",
            MapParameters,
        ),
        Declaration(
            "chromophores",
            "melanin and haemoglobin in maps of albedo",
            ChromophoreParameters,
        ),
        Declaration(
            "coverage", "number of subjects by skin type, gender and age", NoParameters
        ),
        Declaration(
            "surface",
            "differences between the surface BRDFs of groups",
            SurfaceParameters,
        ),
        Declaration(
            "repeatability",
            "reliability and repeatability of quantities, from repeated takes",
            RepeatabilityParameters,
        ),
        Declaration(
            "model",
            "effects of attributes, conditions and visits by a formula",
            ModelParameters,
        ),
        Declaration(
            "plan",
            "numbers of subjects that a study needs, from the variances of repeats",
            PlanParameters,
        ),
    )
}
