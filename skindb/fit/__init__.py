"""From lumitexels to reflectance models: normals, albedo, surface BRDF, reduced basis,
translucency.
"""

from skindb.fit.albedo import estimate_diffuse_reflectance
from skindb.fit.corrections import (
    estimate_camera_gains,
    estimate_light_gains,
    light_residuals,
)
from skindb.fit.gloss import estimate_gloss
from skindb.fit.joint import refine_jointly
from skindb.fit.kernels import compile_kernels
from skindb.fit.lumitexels import lumitexels, sample_variance
from skindb.fit.model import first_pass, fit_model, second_pass
from skindb.fit.normals import estimate_normals
from skindb.fit.plan import FitPlan, plan_fit
from skindb.fit.quality import (
    describe_prediction,
    find_obstructed,
    prediction_table,
    tabulate_diffuse,
    tabulate_prediction,
)
from skindb.fit.surface import find_outliers, fit_surface, held_out_error, refit
from skindb.fit.translucency import (
    fit_probe,
    summarise_translucency,
    tabulate_translucency,
    translucency_map,
)
from skindb.parameters import FitParameters
from skindb.reflectance.brdf_files import read_dictionary
from skindb.reflectance.dictionary import dictionary_report, embedded_dictionary
from skindb.reflectance.reduction import reduce_basis

__all__ = [
    "FitParameters",
    "FitPlan",
    "compile_kernels",
    "describe_prediction",
    "dictionary_report",
    "embedded_dictionary",
    "estimate_camera_gains",
    "estimate_diffuse_reflectance",
    "estimate_gloss",
    "estimate_light_gains",
    "estimate_normals",
    "find_obstructed",
    "find_outliers",
    "first_pass",
    "fit_model",
    "fit_probe",
    "fit_surface",
    "held_out_error",
    "light_residuals",
    "lumitexels",
    "plan_fit",
    "prediction_table",
    "read_dictionary",
    "reduce_basis",
    "refine_jointly",
    "refit",
    "sample_variance",
    "second_pass",
    "summarise_translucency",
    "tabulate_diffuse",
    "tabulate_prediction",
    "tabulate_translucency",
    "translucency_map",
]
