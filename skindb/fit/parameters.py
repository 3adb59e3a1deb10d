"""Parameters of a fit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, Self, get_args

from skindb.errors import Fault, InputError
from skindb.fit.albedo import EVEN_REFLECTION

FullMode = Literal["linear", "perceptual", "paper"]
Profile = Literal["transport", "dipole"]


@dataclass(frozen=True)
class FitParameters:
    """Parameters of a fit.

    Parameters
    ----------
    k
        Number of components of the reduced basis; fewer if fewer surfels are fitted.
    mode, rank
        Mode and rank of the fit by the dictionary, see `fit_surface`. After "paper" the
        refit uses "perceptual".
    eta
        Refractive index of skin.
    profile
        Model of the probe's profiles, see `fit_probe`.
    even_reflection
        Largest fraction of light (95 %) that the surface of skin is assumed to reflect
        evenly and without colour, see `estimate_diffuse_reflectance`.
    light_gains
        Whether samples are first divided by the gain of their light, see `estimate_light_gains`.
    inter_reflection
        Whether light from other parts of the face after one diffuse bounce is
        subtracted, see `bounced_light`; the first pass is then repeated.
    hold_out_lights, hold_out_cameras
        Fractions of lights and cameras that are held out of the fit, to measure the
        error of predictions.
    seed
        Random seed for the hold-out, for sampling and for the starts of the factorisation.

    Raises
    ------
    InputError
        With every parameter that is out of range.
    """

    k: int = 4
    mode: FullMode = "perceptual"
    rank: int = 16
    eta: float = 1.3
    profile: Profile = "transport"
    even_reflection: float = EVEN_REFLECTION
    light_gains: bool = False
    inter_reflection: bool = False
    hold_out_lights: float = 0.0
    hold_out_cameras: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the ranges."""
        rules = {
            "k": (self.k >= 1, "must be at least 1"),
            "mode": (
                self.mode in get_args(FullMode),
                f"must be one of {', '.join(get_args(FullMode))}",
            ),
            "rank": (self.rank >= 1, "must be at least 1"),
            "eta": (
                math.isfinite(self.eta) and 1 <= self.eta <= 2,
                "must lie in [1, 2]",
            ),
            "profile": (
                self.profile in get_args(Profile),
                f"must be one of {', '.join(get_args(Profile))}",
            ),
            "even_reflection": (
                0 <= self.even_reflection <= 0.5,
                "must be a fraction in [0, 0.5]",
            ),
            "hold_out_lights": (
                0 <= self.hold_out_lights < 1,
                "must be a fraction in [0, 1)",
            ),
            "hold_out_cameras": (
                0 <= self.hold_out_cameras < 1,
                "must be a fraction in [0, 1)",
            ),
            "seed": (self.seed >= 0, "must not be negative"),
        }
        faults = [
            Fault(name, rule, repr(getattr(self, name)), "give another value")
            for name, (ok, rule) in rules.items()
            if not ok
        ]
        if faults:
            raise InputError(faults)

    @classmethod
    def of(cls, attrs: Mapping[Any, Any]) -> Self:
        """The parameters in the attributes of a model or of a first pass."""
        given = attrs.get("parameters", {})
        return cls(
            **{one.name: given[one.name] for one in fields(cls) if one.name in given}
        )

    def as_dict(self) -> dict[str, Any]:
        """The parameters as a dictionary for attributes."""
        return asdict(self)
