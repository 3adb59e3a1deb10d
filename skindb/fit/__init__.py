"""From lumitexels to reflectance models: normals, albedo, surface BRDF, reduced basis,
translucency.
"""

from skindb.fit.albedo import estimate_diffuse_reflectance, reflectance_interval
from skindb.fit.basis import reduce_basis
from skindb.fit.dictionary import dictionary_report
from skindb.fit.held_out import held_out_error
from skindb.fit.light_gains import estimate_light_gains
from skindb.fit.lumitexels import lumitexels
from skindb.fit.model import first_pass, fit_model, second_pass
from skindb.fit.normals import estimate_normals
from skindb.fit.obstructed import find_obstructed
from skindb.fit.outliers import find_outliers
from skindb.fit.plan import FitPlan, plan_fit
from skindb.fit.prediction import (
    describe_prediction,
    prediction_table,
    tabulate_prediction,
)
from skindb.fit.sample_noise import sample_variance
from skindb.fit.surface import fit_surface, refit
from skindb.fit.translucency import (
    fit_probe,
    summarise_translucency,
    tabulate_translucency,
    translucency_map,
)
from skindb.parameters import FitParameters
from skindb.reflectance.dictionary import embedded_dictionary
from skindb.reflectance.table_file import read_dictionary

__all__ = [
    "FitParameters",
    "FitPlan",
    "describe_prediction",
    "dictionary_report",
    "embedded_dictionary",
    "estimate_diffuse_reflectance",
    "estimate_light_gains",
    "estimate_normals",
    "find_obstructed",
    "find_outliers",
    "first_pass",
    "fit_model",
    "fit_probe",
    "fit_surface",
    "held_out_error",
    "lumitexels",
    "plan_fit",
    "prediction_table",
    "read_dictionary",
    "reduce_basis",
    "refit",
    "reflectance_interval",
    "sample_variance",
    "second_pass",
    "summarise_translucency",
    "tabulate_prediction",
    "tabulate_translucency",
    "translucency_map",
]
