from .albedo import albedo_histograms, albedo_table, plot_albedo
from .brdf import (
    BASIS_SIZE_VARIABLES,
    basis_size_curve,
    describe_basis_size,
    plot_basis_size,
    population_basis,
    tabulate_basis_size,
)
from .brdf_plots import (
    plot_brdf_space,
    plot_group_lobes,
    plot_group_spheres,
)
from .chromophores import (
    chromophore_axes,
    chromophore_maps,
    chromophore_statistics,
    chromophore_table,
    describe_chromophores,
    plot_chromophores,
)
from .components import plot_face_model
from .correlations import (
    component_correlations,
    describe_correlations,
    plot_correlations,
)
from .coverage import coverage_report, describe_coverage, plot_coverage
from .edit import apply_traits, describe_edit, move_along_modes
from .face_files import write_face_model
from .face_models import condition_face_model, face_at, face_model, sample_faces
from .formula_models import describe_model, linear_model, plot_model
from .groups import (
    describe_group_effects,
    group_effects,
    plot_group_effects,
)
from .long_form import tidy
from .maps import (
    describe_effect_maps,
    effect_maps,
    plot_effect_maps,
    tabulate_effect_maps,
)
from .planning import describe_plan, plot_plan, sample_sizes
from .regions import region_masks, take_masks
from .registration import (
    doubtful_landmarks,
    register,
    tabulate_registration,
)
from .repeats import (
    describe_repeatability,
    plot_repeatability,
    repeatability,
)
from .studies import STUDIES, describe_study, plot_study, tabulate_study
from .subjects import groups_by, sides, subjects_of, trait_names
from .summary import (
    cohort_of,
    common_maps,
    region_tables,
    sample_surfels,
    summary_tables,
)
from .surface import (
    brdf_space,
    describe_brdf_space,
    tabulate_brdf_space,
)
from .traits import plot_traits, trait_vectors
from .translucency import plot_translucency, translucency_table

__all__ = [
    "BASIS_SIZE_VARIABLES",
    "STUDIES",
    "albedo_histograms",
    "albedo_table",
    "apply_traits",
    "basis_size_curve",
    "brdf_space",
    "chromophore_axes",
    "chromophore_maps",
    "chromophore_statistics",
    "chromophore_table",
    "cohort_of",
    "common_maps",
    "component_correlations",
    "condition_face_model",
    "coverage_report",
    "describe_basis_size",
    "describe_brdf_space",
    "describe_chromophores",
    "describe_correlations",
    "describe_coverage",
    "describe_edit",
    "describe_effect_maps",
    "describe_group_effects",
    "describe_model",
    "describe_plan",
    "describe_repeatability",
    "describe_study",
    "doubtful_landmarks",
    "effect_maps",
    "face_at",
    "face_model",
    "group_effects",
    "groups_by",
    "linear_model",
    "move_along_modes",
    "plot_albedo",
    "plot_basis_size",
    "plot_brdf_space",
    "plot_chromophores",
    "plot_correlations",
    "plot_coverage",
    "plot_effect_maps",
    "plot_face_model",
    "plot_group_effects",
    "plot_group_lobes",
    "plot_group_spheres",
    "plot_model",
    "plot_plan",
    "plot_repeatability",
    "plot_study",
    "plot_traits",
    "plot_translucency",
    "population_basis",
    "region_masks",
    "region_tables",
    "register",
    "repeatability",
    "sample_faces",
    "sample_sizes",
    "sample_surfels",
    "sides",
    "subjects_of",
    "summary_tables",
    "tabulate_basis_size",
    "tabulate_brdf_space",
    "tabulate_effect_maps",
    "tabulate_registration",
    "tabulate_study",
    "take_masks",
    "tidy",
    "trait_names",
    "trait_vectors",
    "translucency_table",
    "write_face_model",
]
