"""What studies of a population hold, and reports on measured BRDFs."""

from __future__ import annotations

from skindb.schema.declaration import PAPER, Variable, declare

# group of a version -> its variables
STUDIES: dict[str, tuple[Variable, ...]] = {
    "translucency_table": (
        declare(
            "sigma_tr_count", "group site channel", "int32", "1", "takes with a fitted sigma_tr", f"{PAPER}, table 2"
        ),
        declare("sigma_tr_mean", "group site channel", "float64", "mm-1", "mean of sigma_tr", f"{PAPER}, table 2"),
        declare(
            "sigma_tr_mean_low", "group site channel", "float64", "mm-1", "lower end of the 95 % interval of the mean"
        ),
        declare(
            "sigma_tr_mean_high", "group site channel", "float64", "mm-1", "upper end of the 95 % interval of the mean"
        ),
        declare(
            "sigma_tr_standard_deviation", "group site channel", "float64", "mm-1", "standard deviation of sigma_tr"
        ),
        declare("sigma_tr_deviation_low", "group site channel", "float64", "mm-1", "lower end of its 95 % interval"),
        declare("sigma_tr_deviation_high", "group site channel", "float64", "mm-1", "upper end of its 95 % interval"),
        declare("sigma_tr_variance", "group site channel", "float64", "mm-2", "variance of sigma_tr, unbiased"),
        declare(
            "sigma_tr_measurement_error",
            "group site channel",
            "float64",
            "mm-1",
            "RMS of the standard errors of the takes, a part of the standard deviation",
        ),
    ),
    "dictionary_report": (
        declare("normal_albedo", "basis", "float64", "1", "share of the light reflected at normal incidence"),
        declare("largest_albedo", "basis", "float64", "1", "the same, the largest over incidences up to 85 degrees"),
        declare("energy_excess", "basis", "float64", "1", "largest albedo above 1, before or after the light's disc"),
        declare(
            "reciprocity_error", "basis", "float64", "1", "relative rms difference when both directions are exchanged"
        ),
        declare("one_sided_error", "basis", "float64", "1", "the same between disc averages around either direction"),
        declare(
            "disc_quadrature_error", "basis", "float64", "1", "relative rms error of the rule over the light's disc"
        ),
        declare("disc_table_error", "basis", "float64", "1", "the same of the averaged tables between their nodes"),
        declare(
            "interpolation_error", "basis", "float64", "1", "relative rms error of the tables against their source"
        ),
        declare("hole_share", "basis", "float64", "1", "unmeasured nodes above the horizon, which continue neighbours"),
    ),
    "registration": (
        declare(
            "common_uv",
            "surfel uv",
            "float32",
            "1",
            "texture coordinates in the space all takes share, warped by landmarks; may leave [0, 1] at the rim",
            f"{PAPER}, section 10.2",
        ),
        declare("common_landmark", "landmark uv", "float32", "1", "where landmarks lie in the space all takes share"),
        declare(
            "landmark_residual",
            "landmark",
            "float32",
            "1",
            "distance of the warped landmark from common_landmark, in texture coordinates; NaN where it is missing",
        ),
        declare(
            "landmark_prediction_error",
            "landmark",
            "float32",
            "1",
            "distance of common_landmark from where the warp by the other landmarks puts it; large: clicked wrong",
        ),
        declare(
            "landmark_used",
            "landmark",
            "bool",
            "1",
            "0: missing, not finite, or so near to one before it that their mean counts",
        ),
    ),
    "basis_size": (
        declare(
            "relative_error",
            "k",
            "float64",
            "1",
            "reconstruction error of reflectance over that of every basis",
            f"{PAPER}, figure 15",
        ),
        declare("relative_error_low", "k", "float64", "1", "lower end of the 95 % bootstrap interval over surfels"),
        declare("relative_error_high", "k", "float64", "1", "upper end of the 95 % bootstrap interval over surfels"),
    ),
    "population_basis": (
        declare(
            "population_weight",
            "component basis",
            "float32",
            "1",
            "rows of H common to the population",
            f"{PAPER}, section 10.1",
        ),
        declare(
            "take_coefficient",
            "take component",
            "float64",
            "1",
            "mean surface BRDF of a take in the common basis",
            f"{PAPER}, section 10.1",
        ),
    ),
    "albedo": (
        declare("colour_mean", "channel", "float64", "1", "mean diffuse reflectance over takes"),
        declare(
            "colour_axis",
            "axis channel",
            "float64",
            "1",
            "rows: decorrelated colour axes over their standard deviation",
            "Heeger and Bergen 1995, section 3.5",
        ),
        declare("histogram_edge", "axis edge", "float64", "1", "bin edges, shared by all takes"),
        declare(
            "albedo_histogram",
            "take region axis bin",
            "float64",
            "1",
            "share of the region's area per bin",
            f"{PAPER}, section 10.2",
        ),
        declare("albedo_mean", "take region channel", "float64", "1", "area-weighted mean diffuse reflectance"),
    ),
    "albedo_table": (
        declare("group_albedo_count", "group region channel", "int32", "1", "takes with such a region"),
        declare("group_albedo_mean", "group region channel", "float64", "1", "mean over takes of their mean albedo"),
        declare(
            "group_albedo_mean_low", "group region channel", "float64", "1", "lower end of the mean's 95 % interval"
        ),
        declare(
            "group_albedo_mean_high", "group region channel", "float64", "1", "upper end of the mean's 95 % interval"
        ),
        declare("group_albedo_standard_deviation", "group region channel", "float64", "1", "between takes"),
        declare("group_histogram", "group region axis bin", "float64", "1", "mean over takes of albedo_histogram"),
    ),
    "traits": (
        declare("trait_count", "trait side", "int32", "1", "takes with and without the trait"),
        declare(
            "trait_brdf_shift",
            "trait component",
            "float64",
            "1",
            "mean coefficient with the trait less without",
            f"{PAPER}, section 11",
        ),
        declare(
            "trait_histogram_shift",
            "trait region axis bin",
            "float64",
            "1",
            "mean histogram with the trait less without",
            f"{PAPER}, section 11",
        ),
        declare(
            "trait_quantile_shift",
            "trait region axis level",
            "float64",
            "1",
            "mean quantile of decorrelated colour with the trait less without, in standard deviations",
        ),
        declare(
            "trait_log_sigma_tr_shift", "trait channel", "float64", "1", "mean log sigma_tr with the trait less without"
        ),
        declare(
            "take_log_sigma_tr",
            "take channel",
            "float64",
            "1",
            "mean over trusted sites of log sigma_tr in mm-1; NaN without one",
        ),
    ),
}
