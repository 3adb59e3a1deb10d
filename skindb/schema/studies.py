"""Variables of registrations, of studies of a population, and of reports on dictionaries."""

from __future__ import annotations

from skindb.schema.declaration import PAPER, Variable, declare

TABLE_2 = f"{PAPER}, table 2"
# group of a version -> its variables
STUDIES: dict[str, tuple[Variable, ...]] = {
    "translucency_table": (
        declare(
            "sigma_tr_count",
            "group site channel",
            "int32",
            "1",
            "takes with a trusted sigma_tr",
            TABLE_2,
        ),
        declare(
            "sigma_tr_mean",
            "group site channel",
            "float64",
            "mm-1",
            "mean of sigma_tr",
            TABLE_2,
        ),
        declare(
            "sigma_tr_mean_low",
            "group site channel",
            "float64",
            "mm-1",
            "lower end of the 95 % interval of the mean",
        ),
        declare(
            "sigma_tr_mean_high",
            "group site channel",
            "float64",
            "mm-1",
            "upper end of the 95 % interval of the mean",
        ),
        declare(
            "sigma_tr_standard_deviation",
            "group site channel",
            "float64",
            "mm-1",
            "standard deviation of sigma_tr",
        ),
        declare(
            "sigma_tr_deviation_low",
            "group site channel",
            "float64",
            "mm-1",
            "lower end of the 95 % interval of the standard deviation",
        ),
        declare(
            "sigma_tr_deviation_high",
            "group site channel",
            "float64",
            "mm-1",
            "upper end of the 95 % interval of the standard deviation",
        ),
        declare(
            "sigma_tr_variance",
            "group site channel",
            "float64",
            "mm-2",
            "unbiased variance of sigma_tr",
        ),
        declare(
            "sigma_tr_measurement_error",
            "group site channel",
            "float64",
            "mm-1",
            (
                "RMS of the standard errors of the takes from their fibres, a part of "
                "the standard deviation"
            ),
        ),
        declare(
            "sigma_tr_total_error",
            "group site channel",
            "float64",
            "mm-1",
            (
                "RMS of the total standard errors of the takes; the model's part is "
                "common to all of them"
            ),
        ),
        declare(
            "sigma_tr_people_fraction",
            "group site channel",
            "float64",
            "1",
            "fraction of the variance that noise of the fibres does not explain",
        ),
        declare(
            "sigma_tr_repeat_deviation",
            "group site channel",
            "float64",
            "mm-1",
            "standard deviation of the takes of one subject; NaN where no subject has two",
        ),
    ),
    "dictionary_report": (
        declare(
            "normal_albedo",
            "dictionary",
            "float64",
            "1",
            "fraction of the light that is reflected at normal incidence",
        ),
        declare(
            "largest_albedo",
            "dictionary",
            "float64",
            "1",
            "largest reflected fraction over incidences up to 85 degrees",
        ),
        declare(
            "energy_excess",
            "dictionary",
            "float64",
            "1",
            "largest albedo above 1, before or after the light's disc",
        ),
        declare(
            "reciprocity_error",
            "dictionary",
            "float64",
            "1",
            "relative RMS difference when both directions are exchanged",
        ),
        declare(
            "one_sided_error",
            "dictionary",
            "float64",
            "1",
            "relative RMS difference between disc averages around either direction",
        ),
        declare(
            "disc_quadrature_error",
            "dictionary",
            "float64",
            "1",
            "relative RMS error of the quadrature over the light's disc",
        ),
        declare(
            "disc_table_error",
            "dictionary",
            "float64",
            "1",
            "relative RMS error of the averaged tables between their nodes",
        ),
        declare(
            "interpolation_error",
            "dictionary",
            "float64",
            "1",
            "relative RMS error of the tables against their source",
        ),
        declare(
            "hole_fraction",
            "dictionary",
            "float64",
            "1",
            (
                "fraction of nodes above the horizon that were not measured and "
                "continue their neighbours"
            ),
        ),
    ),
    "registration": (
        declare(
            "common_uv",
            "surfel uv",
            "float32",
            "1",
            (
                "texture coordinates in the space shared by all takes, warped by "
                "landmarks; may leave [0, 1] at the rim"
            ),
            f"{PAPER}, section 10.2",
        ),
        declare(
            "common_landmark",
            "landmark uv",
            "float32",
            "1",
            "position of the landmarks in the space shared by all takes",
        ),
        declare(
            "landmark_residual",
            "landmark",
            "float32",
            "1",
            (
                "distance of the warped landmark from common_landmark, in texture "
                "coordinates; NaN where it is missing"
            ),
        ),
        declare(
            "landmark_prediction_error",
            "landmark",
            "float32",
            "1",
            (
                "distance of common_landmark from its position by the warp of the "
                "other landmarks; large: a wrong click"
            ),
        ),
        declare(
            "landmark_used",
            "landmark",
            "int8",
            "1",
            "0: missing, not finite, or so near to an earlier one that their mean is used; else 1",
        ),
        declare(
            "mm_per_uv",
            "",
            "float64",
            "mm",
            "millimetres of face per unit of common_uv; NaN if unknown",
        ),
    ),
    "maps": (
        declare(
            "texel_diffuse_reflectance",
            "v u channel",
            "float32",
            "1",
            "diffuse albedo R_d in the common (u, v); NaN outside the measured surface",
            f"{PAPER}, section 10.2",
        ),
        declare(
            "texel_diffuse_reflectance_total_error",
            "v u channel",
            "float32",
            "1",
            "standard error of R_d with the error of the model",
        ),
        declare(
            "texel_surface_reflectance",
            "v u",
            "float32",
            "1",
            "fraction of light along the normal that the surface reflects",
        ),
        declare(
            "texel_sigma_tr",
            "v u channel",
            "float32",
            "mm-1",
            "effective transport coefficient",
        ),
        declare("texel_status", "v u", "uint8", "1", "origin of the texel's values"),
        declare(
            "texel_coverage",
            "v u",
            "float32",
            "1",
            "fraction of the texel that trusted surfels cover; 0 outside the face",
        ),
    ),
    "basis_size": (
        declare(
            "relative_error",
            "k",
            "float64",
            "1",
            "reconstruction error of reflectance over that of the whole dictionary",
            f"{PAPER}, figure 15",
        ),
        declare(
            "relative_error_low",
            "k",
            "float64",
            "1",
            "lower end of the 95 % bootstrap interval of relative_error",
        ),
        declare(
            "relative_error_high",
            "k",
            "float64",
            "1",
            "upper end of the 95 % bootstrap interval of relative_error",
        ),
        declare(
            "smallest_size",
            "",
            "int32",
            "1",
            "smallest size that may be on the plateau of the error; 0 without plateau",
        ),
        declare(
            "sufficient_size",
            "",
            "int32",
            "1",
            "smallest size that is surely on the plateau; 0 without plateau",
        ),
        declare(
            "plateau_tolerance",
            "",
            "float64",
            "1",
            "relative error above the plateau that still counts as on it",
        ),
        declare(
            "dictionary_error",
            "",
            "float64",
            "1",
            "relative RMS residual of reflectance with the whole dictionary",
        ),
    ),
    "population_basis": (
        declare(
            "population_mixture",
            "component dictionary",
            "float32",
            "1",
            (
                "rows of H: the basis common to the population as mixtures of the "
                "BRDFs of the dictionary"
            ),
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
        declare(
            "colour_mean",
            "channel",
            "float64",
            "1",
            "mean diffuse reflectance over takes",
        ),
        declare(
            "colour_axis",
            "axis channel",
            "float64",
            "1",
            "rows: decorrelated colour axes over their standard deviation",
            "Heeger and Bergen 1995, section 3.5",
        ),
        declare(
            "histogram_edge",
            "axis edge",
            "float64",
            "1",
            "bin edges, shared by all takes",
        ),
        declare(
            "albedo_histogram",
            "take region axis bin",
            "float64",
            "1",
            "fraction of the region's area per bin",
            f"{PAPER}, section 10.2",
        ),
        declare(
            "albedo_mean",
            "take region channel",
            "float64",
            "1",
            "area-weighted mean diffuse reflectance",
        ),
    ),
    "texture": (
        declare(
            "texture_colour_mean",
            "channel",
            "float64",
            "1",
            "mean over takes of the logarithm of R_d",
        ),
        declare(
            "texture_colour_axis",
            "axis channel",
            "float64",
            "1",
            "rows: decorrelated axes of the logarithm of R_d over their standard deviation",
            "Heeger and Bergen 1995, section 3.5",
        ),
        declare(
            "texture_edge",
            "axis part edge",
            "float64",
            "1",
            "bin edges, shared by all takes",
        ),
        declare(
            "texture_histogram",
            "take region axis part bin",
            "float32",
            "1",
            (
                "fraction of the region's texels per bin, of log albedo and of each "
                "band of its steerable pyramid"
            ),
            f"{PAPER}, section 10.2",
        ),
        declare(
            "texture_quantile",
            "take region axis part level",
            "float32",
            "1",
            "quantiles of the same, in standard deviations of the decorrelated axis",
        ),
        declare(
            "texture_coverage",
            "take region",
            "float64",
            "1",
            "fraction of the region's texels that are measured",
        ),
        declare(
            "texture_region",
            "region v u",
            "int8",
            "1",
            "1 inside the region of the common (u, v), else 0",
        ),
    ),
    "albedo_table": (
        declare(
            "group_albedo_count",
            "group region channel",
            "int32",
            "1",
            "takes that have the region",
        ),
        declare(
            "group_albedo_mean",
            "group region channel",
            "float64",
            "1",
            "mean over takes of their mean albedo",
        ),
        declare(
            "group_albedo_mean_low",
            "group region channel",
            "float64",
            "1",
            "lower end of the mean's 95 % interval",
        ),
        declare(
            "group_albedo_mean_high",
            "group region channel",
            "float64",
            "1",
            "upper end of the mean's 95 % interval",
        ),
        declare(
            "group_albedo_level_low",
            "group region channel",
            "float64",
            "1",
            (
                "lower end of the mean's 95 % interval with "
                "group_even_reflection_limit, which groups have in common"
            ),
        ),
        declare(
            "group_even_reflection_limit",
            "group",
            "float64",
            "1",
            "largest even_reflection_limit of the group's takes",
        ),
        declare(
            "group_albedo_standard_deviation",
            "group region channel",
            "float64",
            "1",
            "standard deviation between takes of their mean albedo",
        ),
        declare(
            "group_histogram",
            "group region axis bin",
            "float64",
            "1",
            "mean over takes of albedo_histogram",
        ),
    ),
    "effects": (
        declare(
            "effect_count",
            "contrast quantity side",
            "int32",
            "1",
            "subjects with and without; of a number, all",
        ),
        declare(
            "effect",
            "contrast quantity",
            "float64",
            "1",
            (
                "value with an attribute less that without, or change per unit of it; "
                "that of the logarithm for sigma_tr"
            ),
        ),
        declare(
            "effect_low",
            "contrast quantity",
            "float64",
            "1",
            "lower end of the 95 % interval of effect",
        ),
        declare(
            "effect_high",
            "contrast quantity",
            "float64",
            "1",
            "upper end of the 95 % interval of effect",
        ),
        declare(
            "effect_percent",
            "contrast quantity",
            "float64",
            "%",
            "effect over the mean without the attribute",
        ),
        declare(
            "effect_percent_low",
            "contrast quantity",
            "float64",
            "%",
            "lower end of the 95 % interval",
        ),
        declare(
            "effect_percent_high",
            "contrast quantity",
            "float64",
            "%",
            "upper end of the 95 % interval",
        ),
        declare(
            "effect_standardised",
            "contrast quantity",
            "float64",
            "1",
            "effect over the standard deviation between subjects that the regression leaves",
        ),
        declare(
            "effect_p",
            "contrast quantity",
            "float64",
            "1",
            "p value by permutation, of this quantity alone",
        ),
        declare(
            "effect_p_adjusted",
            "contrast quantity",
            "float64",
            "1",
            "p value adjusted for all quantities of the contrast by the largest statistic",
            "Westfall and Young 1993",
        ),
        declare(
            "effect_p_false_discovery",
            "contrast quantity",
            "float64",
            "1",
            "p value adjusted so that on average this fraction of the stated effects are none",
            "Benjamini and Hochberg 1995",
        ),
        declare(
            "effect_detectable",
            "contrast quantity",
            "float64",
            "1",
            "smallest effect that a test at 5 % finds with a probability of 80 %",
        ),
        declare(
            "attribute_association",
            "contrast attribute",
            "float64",
            "1",
            (
                "multiple correlation of what is compared with another attribute, "
                "adjusted for the number of its values"
            ),
        ),
    ),
    "components": (
        declare(
            "principal_mean",
            "v u channel",
            "float32",
            "1",
            "mean R_d over takes; NaN where a take has none",
        ),
        declare(
            "principal_axis",
            "component v u channel",
            "float32",
            "1",
            "unit vectors along which R_d varies most",
        ),
        declare(
            "principal_score",
            "take component",
            "float64",
            "1",
            "place of a take along an axis",
        ),
        declare(
            "principal_variance_ratio",
            "component",
            "float64",
            "1",
            "fraction of the variance between takes",
        ),
        declare(
            "principal_residual",
            "take",
            "float64",
            "1",
            "root mean square of R_d that the components leave",
        ),
    ),
    "correlations": (
        declare(
            "component_correlation",
            "pair",
            "float64",
            "1",
            "correlation between subjects",
        ),
        declare(
            "component_correlation_low",
            "pair",
            "float64",
            "1",
            "lower end of its 95 % interval",
            "Efron 1987",
        ),
        declare(
            "component_correlation_high",
            "pair",
            "float64",
            "1",
            "upper end of its 95 % interval",
            "Efron 1987",
        ),
        declare(
            "correlation_p",
            "pair",
            "float64",
            "1",
            "p value by permutation of subjects, of this pair alone",
        ),
        declare(
            "correlation_p_false_discovery",
            "pair",
            "float64",
            "1",
            "p value adjusted for all pairs",
            "Benjamini and Hochberg 1995",
        ),
        declare(
            "correlation_count", "pair", "int32", "1", "subjects with both components"
        ),
    ),
    "effect_maps": (
        declare(
            "map_effect",
            "contrast quantity v u",
            "float32",
            "1",
            (
                "value with an attribute less that without, or change per unit of it; "
                "that of the logarithm for sigma_tr"
            ),
        ),
        declare(
            "map_effect_half_width",
            "contrast quantity v u",
            "float32",
            "1",
            "half of the 95 % interval of map_effect",
        ),
        declare(
            "map_effect_p",
            "contrast quantity v u",
            "float32",
            "1",
            "p value by permutation, of this texel alone",
        ),
        declare(
            "map_effect_p_adjusted",
            "contrast quantity v u",
            "float32",
            "1",
            "p value adjusted for all texels and channels of the variable by the largest statistic",
            "Westfall and Young 1993",
        ),
        declare(
            "map_effect_count",
            "contrast quantity v u",
            "int32",
            "1",
            "subjects who have the texel",
        ),
    ),
    "chromophores": (
        declare(
            "chromophore_axis",
            "chromophore channel",
            "float64",
            "1",
            "absorption of a pigment in skin, over that at green",
            "Tsumura et al. 2003",
        ),
        declare(
            "chromophore_offset",
            "channel",
            "float64",
            "1",
            "mean -ln R_d over takes, where amounts are 0",
        ),
        declare(
            "chromophore_table_axis",
            "chromophore channel",
            "float64",
            "1",
            "absorption of the pigment in solution, over that at green",
            "Prahl 1999; Sarna and Swartz 1988",
        ),
        declare(
            "chromophore_table_angle",
            "chromophore",
            "float64",
            "deg",
            "angle between the axis and the table's",
        ),
        declare(
            "chromophore_axis_spread",
            "chromophore",
            "float64",
            "deg",
            "RMS angle by which independent components turn in bootstrapped samples of texels",
        ),
        declare(
            "density_variance",
            "axis",
            "float64",
            "1",
            "variance of -ln R_d along its principal components",
        ),
        declare(
            "take_chromophore",
            "take region chromophore",
            "float64",
            "1",
            (
                "mean over texels of what the pigment takes from ln R_d at green, less "
                "the mean of the takes"
            ),
        ),
        declare(
            "take_chromophore_deviation",
            "take region chromophore",
            "float64",
            "1",
            "standard deviation over texels",
        ),
        declare(
            "take_chromophore_residual",
            "take region",
            "float64",
            "1",
            "RMS of ln R_d that no pigment explains",
        ),
        declare(
            "take_chromophore_coverage",
            "take region",
            "float64",
            "1",
            "fraction of the region that is measured",
        ),
    ),
    "chromophore_maps": (
        declare(
            "texel_chromophore",
            "v u chromophore",
            "float32",
            "1",
            "what the pigment takes from ln R_d at green, less the mean of the takes",
        ),
        declare(
            "texel_chromophore_residual",
            "v u",
            "float32",
            "1",
            "what no pigment explains of -ln R_d",
        ),
    ),
    "chromophore_table": (
        declare(
            "group_chromophore_count",
            "group region chromophore",
            "int32",
            "1",
            "subjects with such a region",
        ),
        declare(
            "group_chromophore_mean",
            "group region chromophore",
            "float64",
            "1",
            "mean of take_chromophore",
        ),
        declare(
            "group_chromophore_mean_low",
            "group region chromophore",
            "float64",
            "1",
            "lower end of the 95 % interval of the mean",
        ),
        declare(
            "group_chromophore_mean_high",
            "group region chromophore",
            "float64",
            "1",
            "upper end of the 95 % interval of the mean",
        ),
        declare(
            "group_chromophore_standard_deviation",
            "group region chromophore",
            "float64",
            "1",
            "standard deviation between subjects",
        ),
    ),
    "mean_face": (
        declare(
            "face_diffuse_reflectance",
            "v u channel",
            "float32",
            "1",
            "geometric mean of R_d over subjects",
        ),
        declare(
            "face_diffuse_reflectance_log_deviation",
            "v u channel",
            "float32",
            "1",
            "standard deviation of ln R_d between subjects",
        ),
        declare(
            "face_diffuse_reflectance_count",
            "v u",
            "int32",
            "1",
            "subjects whose R_d is measured there",
        ),
        declare(
            "face_sigma_tr",
            "v u channel",
            "float32",
            "mm-1",
            "geometric mean of sigma_tr over subjects",
        ),
        declare(
            "face_sigma_tr_log_deviation",
            "v u channel",
            "float32",
            "1",
            "standard deviation of ln sigma_tr between subjects",
        ),
        declare(
            "face_sigma_tr_count",
            "v u",
            "int32",
            "1",
            "subjects whose sigma_tr is known there",
        ),
        declare(
            "face_surface_reflectance",
            "v u",
            "float32",
            "1",
            "mean surface reflectance over subjects",
        ),
        declare(
            "face_surface_reflectance_deviation",
            "v u",
            "float32",
            "1",
            "standard deviation of surface reflectance between subjects",
        ),
        declare(
            "face_surface_reflectance_count",
            "v u",
            "int32",
            "1",
            "subjects whose surface is measured there",
        ),
    ),
    "coverage": (
        declare(
            "coverage_count",
            "cell",
            "int32",
            "1",
            "subjects with a value, or with all values of a crossing",
        ),
        declare(
            "coverage_unknown",
            "attribute",
            "int32",
            "1",
            "subjects who do not say the attribute",
        ),
        declare(
            "coverage_association",
            "attribute attribute_2",
            "float64",
            "1",
            "Cramer's V, multiple correlation or correlation of two attributes between subjects",
            "Bergsma 2013",
        ),
    ),
    "brdf_space": (
        declare("group_subject_count", "group", "int32", "1", "subjects of the group"),
        declare(
            "group_coefficient",
            "group component",
            "float64",
            "1",
            "mean over subjects of take_coefficient",
            f"{PAPER}, section 10.1",
        ),
        declare(
            "group_brdf",
            "group theta_h theta_d phi_d",
            "float32",
            "sr-1",
            "mean surface BRDF of the group, averaged over the discs of the lights",
            f"{PAPER}, figure 14",
        ),
        declare(
            "take_distance",
            "take take_2",
            "float64",
            "1",
            "distance between the surface BRDFs of two takes over the length of the mean BRDF",
        ),
        declare(
            "take_place",
            "take axis",
            "float64",
            "1",
            "place in the map of takes, in the units of take_distance",
        ),
        declare(
            "explained_fraction",
            "axis",
            "float64",
            "1",
            "fraction of the scatter of takes along an axis",
        ),
        declare(
            "map_error",
            "",
            "float64",
            "1",
            "RMS error of distances in the map over the RMS distance",
        ),
        declare(
            "pair_subject_count",
            "pair side",
            "int32",
            "1",
            "subjects of the first and of the second group",
        ),
        declare(
            "pair_permutations",
            "pair",
            "int32",
            "1",
            "permutations of group_distance_p; 0 where it is NaN",
        ),
        declare(
            "group_distance",
            "pair",
            "float64",
            "1",
            (
                "distance of the mean BRDFs of two groups over the length of the mean "
                "BRDF; of subjects in both if any"
            ),
        ),
        declare(
            "group_distance_noise",
            "pair",
            "float64",
            "1",
            "standard error of group_distance from scatter of subjects",
        ),
        declare(
            "group_distance_p",
            "pair",
            "float64",
            "1",
            "p value by permutation of subjects, of this pair alone",
        ),
        declare(
            "group_distance_p_adjusted",
            "pair",
            "float64",
            "1",
            (
                "p value adjusted for all pairs by the largest statistic, or by "
                "Bonferroni if pairs are of two kinds"
            ),
            "Westfall and Young 1993",
        ),
    ),
    "traits": (
        declare(
            "trait_count",
            "trait side",
            "int32",
            "1",
            "takes with and without the trait",
        ),
        declare(
            "trait_brdf_shift",
            "trait component",
            "float64",
            "1",
            "mean coefficient with the trait minus the mean without",
            f"{PAPER}, section 11",
        ),
        declare(
            "trait_histogram_shift",
            "trait region axis bin",
            "float64",
            "1",
            "mean histogram with the trait minus the mean without",
            f"{PAPER}, section 11",
        ),
        declare(
            "trait_quantile_shift",
            "trait region axis level",
            "float64",
            "1",
            (
                "mean quantile of decorrelated colour with the trait minus the mean "
                "without, in standard deviations"
            ),
        ),
        declare(
            "trait_texture_shift",
            "trait region axis part level",
            "float32",
            "1",
            (
                "mean texture_quantile with the trait minus the mean without; NaN "
                "where no take is registered"
            ),
            f"{PAPER}, section 11",
        ),
        declare(
            "trait_log_sigma_tr_shift",
            "trait channel",
            "float64",
            "1",
            "mean log sigma_tr with the trait minus the mean without",
        ),
        declare(
            "trait_brdf_shift_error",
            "trait component",
            "float64",
            "1",
            "standard error of trait_brdf_shift by bootstrap over subjects",
        ),
        declare(
            "trait_quantile_shift_error",
            "trait region axis level",
            "float64",
            "1",
            "standard error of trait_quantile_shift by bootstrap over subjects",
        ),
        declare(
            "trait_log_sigma_tr_shift_error",
            "trait channel",
            "float64",
            "1",
            "standard error of trait_log_sigma_tr_shift by bootstrap over subjects",
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
