"""The failure of an element is data: statuses whose member is the explanation."""

from __future__ import annotations

from enum import IntEnum


class FitStatus(IntEnum):
    """What became of the fit of one surfel."""

    FITTED = 0
    UNSEEN = 1
    TOO_FEW_SAMPLES = 2
    NO_DIFFUSE_ESTIMATE = 3
    DIFFUSE_CLAMPED = 4
    NOT_CONVERGED = 5
    NOT_FINITE = 6

    @property
    def explanation(self) -> str:
        """One sentence for the user."""
        return _FIT[self]


_FIT = {
    FitStatus.FITTED: "all stages fitted",
    FitStatus.UNSEEN: "no camera sees the surfel under any light; nothing was fitted",
    FitStatus.TOO_FEW_SAMPLES: "fewer samples than the fit needs; nothing was fitted",
    FitStatus.NO_DIFFUSE_ESTIMATE: "no sample above the grazing limit and the noise floor; diffuse reflectance unknown",
    FitStatus.DIFFUSE_CLAMPED: "diffuse reflectance outside (0, 1) was clamped; do not trust it",
    FitStatus.NOT_CONVERGED: "the active set stopped at its iteration limit; see kkt_residual",
    FitStatus.NOT_FINITE: "samples or geometry hold NaN or inf where numbers must be; nothing was fitted",
}


class ProbeStatus(IntEnum):
    """What became of the probe fit of one site and channel."""

    FITTED = 0
    TOO_FEW_FIBRES = 1
    NOT_CONVERGED = 2
    AT_BOUND = 3
    UNIDENTIFIED = 4
    POOR_FIT = 5
    AMBIGUOUS = 6
    OUT_OF_RANGE = 7

    @property
    def explanation(self) -> str:
        """One sentence for the user."""
        return _PROBE[self]


_PROBE = {
    ProbeStatus.FITTED: "fitted; sigma_tr identified",
    ProbeStatus.TOO_FEW_FIBRES: "fewer than three fibres above the noise floor; nothing was fitted",
    ProbeStatus.NOT_CONVERGED: "the solver stopped at its iteration limit",
    ProbeStatus.AT_BOUND: "a parameter ended at its bound; do not trust it",
    ProbeStatus.UNIDENTIFIED: "the profile does not determine sigma_tr: its standard error exceeds its value",
    ProbeStatus.POOR_FIT: "no single medium has this profile: residuals above 10 % that the errors do not explain",
    ProbeStatus.AMBIGUOUS: "another sigma_tr fits nearly as well; the error contains it; a measured gain would tell",
    ProbeStatus.OUT_OF_RANGE: "darker than the model reaches, or 1/sigma_tr is beyond the last fibre: extrapolated",
}


# sigma_tr counts in statistics: a profile of several media has one slope at a distance too, with a wider error
IDENTIFIED = (ProbeStatus.FITTED, ProbeStatus.POOR_FIT)


def flag_attrs(status: type[FitStatus] | type[ProbeStatus]) -> dict[str, object]:
    """CF `flag_values` and `flag_meanings` of a status enumeration, with the sentences as `flag_explanations`."""
    return {
        "flag_values": [int(member) for member in status],
        "flag_meanings": " ".join(member.name.lower() for member in status),
        "flag_explanations": "; ".join(f"{member.name.lower()}: {member.explanation}" for member in status),
    }
