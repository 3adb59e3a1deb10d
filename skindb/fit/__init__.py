"""From lumitexels to reflectance models: normals, albedo, surface BRDF, reduced basis, translucency."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from skindb.fit.lumitexels import lumitexels  # not lazily: the module of the same name would hide it

if TYPE_CHECKING:
    from skindb.fit.albedo import estimate_diffuse_reflectance
    from skindb.fit.basis import reduce_basis
    from skindb.fit.dictionary import dictionary_report
    from skindb.fit.held_out import held_out_error
    from skindb.fit.normals import estimate_normals
    from skindb.fit.outliers import find_outliers
    from skindb.fit.prediction import prediction_table
    from skindb.fit.run import fit_take, plan_take
    from skindb.fit.surface import fit_surface, refit
    from skindb.fit.translucency import fit_probe, translucency_map

__all__ = [
    "dictionary_report",
    "estimate_diffuse_reflectance",
    "estimate_normals",
    "find_outliers",
    "fit_probe",
    "fit_surface",
    "fit_take",
    "held_out_error",
    "lumitexels",
    "plan_take",
    "prediction_table",
    "reduce_basis",
    "refit",
    "translucency_map",
]
_HOME = {
    "dictionary_report": "dictionary",
    "estimate_diffuse_reflectance": "albedo",
    "estimate_normals": "normals",
    "find_outliers": "outliers",
    "fit_probe": "translucency",
    "fit_surface": "surface",
    "fit_take": "run",
    "held_out_error": "held_out",
    "plan_take": "run",
    "prediction_table": "prediction",
    "reduce_basis": "basis",
    "refit": "surface",
    "translucency_map": "translucency",
}


def __getattr__(name: str) -> Any:
    """Import a function when it is first asked for: `import skindb.fit` stays fast."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"skindb.fit.{_HOME[name]}"), name)
