"""Variables of registrations, of studies of a population, and of reports on dictionaries."""

from skindb.schema.declaration import PAPER, TexelStatus, declare

TABLE_2 = f"{PAPER}, table 2"

# translucency_table
SIGMA_TR_COUNT = declare(
    "int32 translucency_table/sigma_tr_count(group, site, channel) [1]",
    "subjects with a trusted sigma_tr",
    TABLE_2,
)
SIGMA_TR_MEAN = declare(
    "float64 translucency_table/sigma_tr_mean(group, site, channel) [mm-1]",
    "mean of sigma_tr",
    TABLE_2,
)
SIGMA_TR_MEAN_LOW = declare(
    "float64 translucency_table/sigma_tr_mean_low(group, site, channel) [mm-1]",
    "lower end of the 95 % interval of the mean",
)
SIGMA_TR_MEAN_HIGH = declare(
    "float64 translucency_table/sigma_tr_mean_high(group, site, channel) [mm-1]",
    "upper end of the 95 % interval of the mean",
)
SIGMA_TR_STANDARD_DEVIATION = declare(
    "float64 translucency_table/sigma_tr_standard_deviation(group, site, channel) [mm-1]",
    "standard deviation of sigma_tr",
)
SIGMA_TR_VARIANCE = declare(
    "float64 translucency_table/sigma_tr_variance(group, site, channel) [mm-2]",
    "unbiased variance of sigma_tr",
)
SIGMA_TR_MEASUREMENT_ERROR = declare(
    "float64 translucency_table/sigma_tr_measurement_error(group, site, channel) [mm-1]",
    "RMS of the standard errors of the takes from their fibres, a part of the standard "
    "deviation",
)
SIGMA_TR_TOTAL_ERROR = declare(
    "float64 translucency_table/sigma_tr_total_error(group, site, channel) [mm-1]",
    "RMS of the total standard errors of the takes; the model's part is common to all of them",
)
SIGMA_TR_PEOPLE_FRACTION = declare(
    "float64 translucency_table/sigma_tr_people_fraction(group, site, channel) [1]",
    "fraction of the variance that noise of the fibres does not explain",
)
SIGMA_TR_REPEAT_DEVIATION = declare(
    "float64 translucency_table/sigma_tr_repeat_deviation(group, site, channel) [mm-1]",
    "standard deviation of the takes of one subject; NaN where no subject has two",
)

# dictionary_report
NORMAL_ALBEDO = declare(
    "float64 dictionary_report/normal_albedo(dictionary) [1]",
    "fraction of the light that is reflected at normal incidence",
)
LARGEST_ALBEDO = declare(
    "float64 dictionary_report/largest_albedo(dictionary) [1]",
    "largest reflected fraction over incidences up to 85 degrees",
)
ENERGY_EXCESS = declare(
    "float64 dictionary_report/energy_excess(dictionary) [1]",
    "largest albedo above 1, before or after the light's disc",
)
RECIPROCITY_ERROR = declare(
    "float64 dictionary_report/reciprocity_error(dictionary) [1]",
    "relative RMS difference when both directions are exchanged",
)
INTERPOLATION_ERROR = declare(
    "float64 dictionary_report/interpolation_error(dictionary) [1]",
    "relative RMS error of the tables against their source",
)
HOLE_FRACTION = declare(
    "float64 dictionary_report/hole_fraction(dictionary) [1]",
    "fraction of nodes above the horizon that were not measured and continue their neighbours",
)

# registration
COMMON_UV = declare(
    "float32 registration/common_uv(surfel, uv) [1]",
    "texture coordinates in the space shared by all takes, warped by landmarks; may "
    "leave [0, 1] at the rim",
    f"{PAPER}, section 10.2",
)
COMMON_LANDMARK = declare(
    "float32 registration/common_landmark(landmark, uv) [1]",
    "position of the landmarks in the space shared by all takes",
)
LANDMARK_RESIDUAL = declare(
    "float32 registration/landmark_residual(landmark) [1]",
    "distance of the warped landmark from common_landmark, in texture coordinates; NaN "
    "where it is missing",
)
LANDMARK_PREDICTION_ERROR = declare(
    "float32 registration/landmark_prediction_error(landmark) [1]",
    "distance of common_landmark from its position by the warp of the other landmarks; "
    "large: a wrong click",
)
LANDMARK_USED = declare(
    "int8 registration/landmark_used(landmark) [1]",
    "0: missing, not finite, or so near to an earlier one that their mean is used; else 1",
)
MM_PER_UV = declare(
    "float64 registration/mm_per_uv() [mm]",
    "millimetres of face per unit of common_uv; NaN if unknown",
)

# maps
TEXEL_SURFEL_POSITION = declare(
    "float32 maps/texel_surfel_position(v, u, xyz) [mm]",
    "position in the subject frame",
)
TEXEL_DIFFUSE_REFLECTANCE = declare(
    "float32 maps/texel_diffuse_reflectance(v, u, channel) [1]",
    "diffuse albedo R_d in the common (u, v); NaN outside the measured surface",
    f"{PAPER}, section 10.2",
)
TEXEL_DIFFUSE_REFLECTANCE_TOTAL_ERROR = declare(
    "float32 maps/texel_diffuse_reflectance_total_error(v, u, channel) [1]",
    "standard error of R_d with the error of the model",
)
TEXEL_SURFACE_REFLECTANCE = declare(
    "float32 maps/texel_surface_reflectance(v, u) [1]",
    "fraction of light along the normal that the surface reflects",
)
TEXEL_GLOSSINESS = declare(
    "float32 maps/texel_glossiness(v, u) [1]",
    "fraction of this light within the narrow of two lobes",
)
TEXEL_SIGMA_TR = declare(
    "float32 maps/texel_sigma_tr(v, u, channel) [mm-1]",
    "effective transport coefficient",
)
TEXEL_STATUS = declare(
    "uint8 maps/texel_status(v, u) [1]",
    "origin of the texel's values",
    statuses=TexelStatus,
    absent=TexelStatus.OUTSIDE,
)
TEXEL_COVERAGE = declare(
    "float32 maps/texel_coverage(v, u) [1]",
    "fraction of the texel that trusted surfels cover; 0 outside the face",
)

# basis_size
RELATIVE_ERROR = declare(
    "float64 basis_size/relative_error(k) [1]",
    "reconstruction error of reflectance over that of the whole dictionary",
    f"{PAPER}, figure 15",
)
RELATIVE_ERROR_LOW = declare(
    "float64 basis_size/relative_error_low(k) [1]",
    "lower end of the 95 % bootstrap interval of relative_error",
)
RELATIVE_ERROR_HIGH = declare(
    "float64 basis_size/relative_error_high(k) [1]",
    "upper end of the 95 % bootstrap interval of relative_error",
)
SMALLEST_SIZE = declare(
    "int32 basis_size/smallest_size() [1]",
    "smallest size that may be on the plateau of the error; 0 without plateau",
)
SUFFICIENT_SIZE = declare(
    "int32 basis_size/sufficient_size() [1]",
    "smallest size that is surely on the plateau; 0 without plateau",
)
PLATEAU_TOLERANCE = declare(
    "float64 basis_size/plateau_tolerance() [1]",
    "relative error above the plateau that still counts as on it",
)

# population_basis
POPULATION_MIXTURE = declare(
    "float32 population_basis/population_mixture(component, dictionary) [1]",
    "rows of H: the basis common to the population as mixtures of the BRDFs of the dictionary",
    f"{PAPER}, section 10.1",
)
TAKE_COEFFICIENT = declare(
    "float64 population_basis/take_coefficient(take, component) [1]",
    "mean surface BRDF of a take in the common basis",
    f"{PAPER}, section 10.1",
)
COMPONENT_VECTOR = declare(
    "float64 population_basis/component_vector(component, component_2) [1]",
    "components as vectors whose Euclidean distances are those of the BRDFs",
)

# albedo
COLOUR_MEAN = declare(
    "float64 albedo/colour_mean(channel) [1]",
    "mean diffuse reflectance over takes",
)
COLOUR_AXIS = declare(
    "float64 albedo/colour_axis(axis, channel) [1]",
    "rows: decorrelated colour axes over their standard deviation",
    "Heeger and Bergen 1995, section 3.5",
)
HISTOGRAM_EDGE = declare(
    "float64 albedo/histogram_edge(axis, edge) [1]",
    "bin edges, shared by all takes",
)
ALBEDO_HISTOGRAM = declare(
    "float64 albedo/albedo_histogram(take, region, axis, bin) [1]",
    "fraction of the region's area per bin",
    f"{PAPER}, section 10.2",
)
ALBEDO_MEAN = declare(
    "float64 albedo/albedo_mean(take, region, channel) [1]",
    "area-weighted mean diffuse reflectance",
)

# texture
TEXTURE_COLOUR_MEAN = declare(
    "float64 texture/texture_colour_mean(channel) [1]",
    "mean over takes of the logarithm of R_d",
)
TEXTURE_COLOUR_AXIS = declare(
    "float64 texture/texture_colour_axis(axis, channel) [1]",
    "rows: decorrelated axes of the logarithm of R_d over their standard deviation",
    "Heeger and Bergen 1995, section 3.5",
)
TEXTURE_QUANTILE = declare(
    "float32 texture/texture_quantile(take, region, axis, part, level) [1]",
    "quantiles of log albedo and of each band of its steerable pyramid, in standard "
    "deviations of the decorrelated axis",
)
TEXTURE_COVERAGE = declare(
    "float64 texture/texture_coverage(take, region) [1]",
    "fraction of the region's texels that are measured",
)
TEXTURE_REGION = declare(
    "int8 texture/texture_region(region, v, u) [1]",
    "1 inside the region of the common (u, v), else 0",
)

# albedo_table
GROUP_ALBEDO_COUNT = declare(
    "int32 albedo_table/group_albedo_count(group, region, channel) [1]",
    "subjects that have the region",
)
GROUP_ALBEDO_MEAN = declare(
    "float64 albedo_table/group_albedo_mean(group, region, channel) [1]",
    "mean over takes of their mean albedo",
)
GROUP_ALBEDO_MEAN_LOW = declare(
    "float64 albedo_table/group_albedo_mean_low(group, region, channel) [1]",
    "lower end of the mean's 95 % interval",
)
GROUP_ALBEDO_MEAN_HIGH = declare(
    "float64 albedo_table/group_albedo_mean_high(group, region, channel) [1]",
    "upper end of the mean's 95 % interval",
)
GROUP_EVEN_REFLECTION_ERROR = declare(
    "float64 albedo_table/group_even_reflection_error(group) [1]",
    "largest even_reflection_error of the group's takes: error of its level that no "
    "number of takes reduces, as their prior is the same",
)
GROUP_ALBEDO_STANDARD_DEVIATION = declare(
    "float64 albedo_table/group_albedo_standard_deviation(group, region, channel) [1]",
    "standard deviation between takes of their mean albedo",
)
GROUP_HISTOGRAM = declare(
    "float64 albedo_table/group_histogram(group, region, axis, bin) [1]",
    "mean over takes of albedo_histogram",
)

# effects
EFFECT_COUNT = declare(
    "int32 effects/effect_count(contrast, quantity, side) [1]",
    "subjects with and without; of a number, all",
)
EFFECT = declare(
    "float64 effects/effect(contrast, quantity) [1]",
    "value with an attribute less that without, or change per unit of it; that of the "
    "logarithm for sigma_tr",
)
EFFECT_LOW = declare(
    "float64 effects/effect_low(contrast, quantity) [1]",
    "lower end of the 95 % interval of effect",
)
EFFECT_HIGH = declare(
    "float64 effects/effect_high(contrast, quantity) [1]",
    "upper end of the 95 % interval of effect",
)
EFFECT_PERCENT = declare(
    "float64 effects/effect_percent(contrast, quantity) [%]",
    "effect over the mean without the attribute",
)
EFFECT_PERCENT_LOW = declare(
    "float64 effects/effect_percent_low(contrast, quantity) [%]",
    "lower end of the 95 % interval",
)
EFFECT_PERCENT_HIGH = declare(
    "float64 effects/effect_percent_high(contrast, quantity) [%]",
    "upper end of the 95 % interval",
)
EFFECT_STANDARDISED = declare(
    "float64 effects/effect_standardised(contrast, quantity) [1]",
    "effect over the standard deviation between subjects that the regression leaves",
)
EFFECT_P = declare(
    "float64 effects/effect_p(contrast, quantity) [1]",
    "p value by permutation, of this quantity alone",
)
EFFECT_P_ADJUSTED = declare(
    "float64 effects/effect_p_adjusted(contrast, quantity) [1]",
    "p value adjusted for all quantities of the contrast by the largest statistic",
    "Westfall and Young 1993",
)
EFFECT_P_FALSE_DISCOVERY = declare(
    "float64 effects/effect_p_false_discovery(contrast, quantity) [1]",
    "p value adjusted so that on average this fraction of the stated effects are none",
    "Benjamini and Hochberg 1995",
)
EFFECT_DETECTABLE = declare(
    "float64 effects/effect_detectable(contrast, quantity) [1]",
    "smallest effect that a test at 5 % finds with a probability of 80 %",
)
EFFECT_RELIABILITY = declare(
    "float64 effects/effect_reliability(contrast, quantity) [1]",
    "fraction of the variance between subjects that the errors of the fits and repeated takes "
    "leave; of the mean square of the changes where conditions are compared",
)
ATTRIBUTE_ASSOCIATION = declare(
    "float64 effects/attribute_association(contrast, attribute) [1]",
    "multiple correlation of what is compared with another attribute, adjusted for the "
    "number of its values",
)

# face_model
FACE_MEAN = declare(
    "float32 face_model/face_mean(quantity, v, u) [1]",
    "mean over subjects of position in mm, ln R_d, surface reflectance and ln sigma_tr; "
    "NaN where a subject has none",
)
FACE_MODE = declare(
    "float32 face_model/face_mode(mode, quantity, v, u) [1]",
    "change of face_mean with one standard deviation of a mode",
    "Tipping and Bishop 1999",
)
FACE_SLOPE = declare(
    "float32 face_model/face_slope(term, quantity, v, u) [1]",
    "change of face_mean per unit of a term of the regression",
)
FACE_SCALE = declare(
    "float64 face_model/face_scale(quantity) [1]",
    "root of the total variance of the block of a quantity between subjects",
)
TERM_MEAN = declare(
    "float64 face_model/term_mean(term) [1]", "mean of a term over subjects"
)
NOISE_VARIANCE = declare(
    "float64 face_model/noise_variance() [1]",
    "mean square that the modes leave in subjects held out, over that of face_scale",
)
MODE_VARIANCE_RATIO = declare(
    "float64 face_model/mode_variance_ratio(mode, block) [1]",
    "fraction of the variance of a block between subjects",
)
MODE_LARGEST_SUBJECT = declare(
    "float64 face_model/mode_largest_subject(mode) [1]",
    "largest fraction of the variance of a mode that one subject has",
)
MODE_SCORE = declare(
    "float64 face_model/mode_score(subject, mode) [1]",
    "place of a subject along a mode, in standard deviations",
)
RECONSTRUCTION_ERROR = declare(
    "float64 face_model/reconstruction_error(mode_count, block) [1]",
    "RMS error of subjects held out: distance of points in mm for shape, relative for "
    "albedo and translucency, absolute for gloss",
)
FACE_DISTANCE = declare(
    "float64 face_model/face_distance(subject) [1]",
    "Mahalanobis distance within the modes of the other subjects",
)
FACE_LOG_DENSITY = declare(
    "float64 face_model/face_log_density(subject) [1]",
    "log density of the scaled face in the model of the other subjects",
)

# correlations
COMPONENT_CORRELATION = declare(
    "float64 correlations/component_correlation(pair) [1]",
    "correlation between subjects",
)
COMPONENT_CORRELATION_LOW = declare(
    "float64 correlations/component_correlation_low(pair) [1]",
    "lower end of its 95 % interval",
    "Efron 1987",
)
COMPONENT_CORRELATION_HIGH = declare(
    "float64 correlations/component_correlation_high(pair) [1]",
    "upper end of its 95 % interval",
    "Efron 1987",
)
CORRELATION_P = declare(
    "float64 correlations/correlation_p(pair) [1]",
    "p value by permutation of subjects, of this pair alone",
)
CORRELATION_P_FALSE_DISCOVERY = declare(
    "float64 correlations/correlation_p_false_discovery(pair) [1]",
    "p value adjusted for the pairs of different components; NaN for channels of one",
    "Benjamini and Hochberg 1995",
)
CORRELATION_COUNT = declare(
    "int32 correlations/correlation_count(pair) [1]",
    "subjects with both components",
)

# linear_model
MODEL_ESTIMATE = declare(
    "float64 linear_model/model_estimate(quantity, term) [1]",
    "coefficient of a term, per unit of the quantity",
)
MODEL_ERROR = declare(
    "float64 linear_model/model_error(quantity, term) [1]",
    "standard error of the coefficient",
)
MODEL_ESTIMATE_LOW = declare(
    "float64 linear_model/model_estimate_low(quantity, term) [1]",
    "lower end of the 95 % interval of the coefficient",
)
MODEL_ESTIMATE_HIGH = declare(
    "float64 linear_model/model_estimate_high(quantity, term) [1]",
    "upper end of the 95 % interval of the coefficient",
)
MODEL_RELIABILITY = declare(
    "float64 linear_model/model_reliability(quantity, term) [1]",
    "fraction of the variance that the errors of the fits leave: between subjects for terms "
    "that are constant within them, within subjects for others",
)
MODEL_P = declare(
    "float64 linear_model/model_p(quantity, term) [1]",
    "p value of the coefficient, of this quantity alone",
)
MODEL_P_FALSE_DISCOVERY = declare(
    "float64 linear_model/model_p_false_discovery(quantity, term) [1]",
    "p value adjusted so that on average this fraction of the stated effects of a "
    "term are none",
    "Benjamini and Hochberg 1995",
)
MODEL_P_EQUIVALENCE = declare(
    "float64 linear_model/model_p_equivalence(quantity, term) [1]",
    "p value of the hypothesis that the magnitude of the effect is larger than the margin",
    "Schuirmann 1987",
)
MODEL_DEGREES_OF_FREEDOM = declare(
    "float64 linear_model/model_degrees_of_freedom(quantity, term) [1]",
    "degrees of freedom of the p value, between or within subjects",
    "Schluchter and Elashoff 1990",
)
MODEL_DEVIATION = declare(
    "float64 linear_model/model_deviation(quantity, effect) [1]",
    "standard deviation of a random effect between subjects, and of the residual",
)
MODEL_TAKES = declare(
    "int32 linear_model/model_takes(quantity) [1]",
    "takes with a value and all attributes of the formula",
)
MODEL_SUBJECTS = declare(
    "int32 linear_model/model_subjects(quantity) [1]",
    "subjects of these takes",
)

# plan
PLAN_SUBJECTS = declare(
    "float64 plan/plan_subjects(quantity) [1]",
    "subjects in total with which the effect is found",
)
PLAN_ERROR = declare(
    "float64 plan/plan_error(quantity) [1]",
    "standard error of the term with as many subjects, in the unit of the quantity",
)
BETWEEN_SUBJECT_DEVIATION = declare(
    "float64 plan/between_subject_deviation(quantity) [1]",
    "standard deviation between subjects, from repeated takes",
)
RESIDUAL_DEVIATION = declare(
    "float64 plan/residual_deviation(quantity) [1]",
    "standard deviation between takes of a subject",
)
KNOWN_SUBJECTS = declare(
    "int32 plan/known_subjects(quantity) [1]",
    "subjects from whose takes the deviations come",
)

# repeatability
REPEAT_SUBJECTS = declare(
    "int32 repeatability/repeat_subjects(quantity) [1]",
    "subjects with two values or more",
)
REPEAT_TAKES = declare(
    "int32 repeatability/repeat_takes(quantity) [1]",
    "takes with a value",
)
ICC = declare(
    "float64 repeatability/icc(quantity) [1]",
    "ICC(1): fraction of the variance that is between subjects",
    "Shrout and Fleiss 1979",
)
ICC_LOW = declare(
    "float64 repeatability/icc_low(quantity) [1]",
    "lower end of the 95 % interval of icc",
)
ICC_HIGH = declare(
    "float64 repeatability/icc_high(quantity) [1]",
    "upper end of the 95 % interval of icc",
)
ICC_AGREEMENT = declare(
    "float64 repeatability/icc_agreement(quantity) [1]",
    "ICC(2,1), absolute agreement, of subjects with all visits and repeats that half of them have",
    "McGraw and Wong 1996",
)
ICC_AGREEMENT_LOW = declare(
    "float64 repeatability/icc_agreement_low(quantity) [1]",
    "lower end of the 95 % interval of icc_agreement",
)
ICC_AGREEMENT_HIGH = declare(
    "float64 repeatability/icc_agreement_high(quantity) [1]",
    "upper end of the 95 % interval of icc_agreement",
)
WITHIN_SUBJECT_DEVIATION = declare(
    "float64 repeatability/within_subject_deviation(quantity) [1]",
    "standard deviation between takes of one subject",
)
REPEATABILITY_COEFFICIENT = declare(
    "float64 repeatability/repeatability_coefficient(quantity) [1]",
    "difference that two takes of one subject exceed in 5 % of cases: the smallest "
    "detectable change",
    "Bland and Altman 1986",
)
DETECTABLE_CHANGE_OF_MEAN = declare(
    "float64 repeatability/detectable_change_of_mean(quantity) [1]",
    "smallest detectable change of the mean over the subjects with two values",
    "de Vet et al. 2006",
)
REPEAT_BIAS = declare(
    "float64 repeatability/repeat_bias(quantity) [1]",
    "mean over subjects of the second take less the first",
)
AGREEMENT_LOW = declare(
    "float64 repeatability/agreement_low(quantity) [1]",
    "lower limit of agreement of the second take less the first",
    "Bland and Altman 1986",
)
AGREEMENT_HIGH = declare(
    "float64 repeatability/agreement_high(quantity) [1]",
    "upper limit of agreement of the second take less the first",
    "Bland and Altman 1986",
)


# effect_maps
MAP_EFFECT = declare(
    "float32 effect_maps/map_effect(contrast, quantity, v, u) [1]",
    "value with an attribute less that without, or change per unit of it; that of the "
    "logarithm for sigma_tr",
)
MAP_EFFECT_HALF_WIDTH = declare(
    "float32 effect_maps/map_effect_half_width(contrast, quantity, v, u) [1]",
    "half of the 95 % interval of map_effect",
)
MAP_EFFECT_P = declare(
    "float32 effect_maps/map_effect_p(contrast, quantity, v, u) [1]",
    "p value by permutation, of this texel alone",
)
MAP_EFFECT_P_ADJUSTED = declare(
    "float32 effect_maps/map_effect_p_adjusted(contrast, quantity, v, u) [1]",
    "p value adjusted for all texels and channels of the variable by the largest statistic",
    "Westfall and Young 1993",
)
MAP_EFFECT_COUNT = declare(
    "int32 effect_maps/map_effect_count(contrast, quantity, v, u) [1]",
    "subjects who have the texel",
)

# chromophores
CHROMOPHORE_AXIS = declare(
    "float64 chromophores/chromophore_axis(chromophore, channel) [1]",
    "absorption of a pigment in skin, over that at green",
    "Tsumura et al. 2003",
)
CHROMOPHORE_OFFSET = declare(
    "float64 chromophores/chromophore_offset(channel) [1]",
    "mean -ln R_d over takes, where amounts are 0",
)
CHROMOPHORE_TABLE_ANGLE = declare(
    "float64 chromophores/chromophore_table_angle(chromophore) [deg]",
    "angle between the axis and the table's",
)
CHROMOPHORE_AXIS_SPREAD = declare(
    "float64 chromophores/chromophore_axis_spread(chromophore) [deg]",
    "RMS angle by which independent components turn in bootstrapped samples of texels",
)
TAKE_CHROMOPHORE = declare(
    "float64 chromophores/take_chromophore(take, region, chromophore) [1]",
    "mean over texels of what the pigment takes from ln R_d at green, less the mean of "
    "the takes",
)
TAKE_CHROMOPHORE_DEVIATION = declare(
    "float64 chromophores/take_chromophore_deviation(take, region, chromophore) [1]",
    "standard deviation over texels",
)

# chromophore_maps
TEXEL_CHROMOPHORE = declare(
    "float32 chromophore_maps/texel_chromophore(v, u, chromophore) [1]",
    "what the pigment takes from ln R_d at green, less the mean of the takes",
)

# chromophore_table
GROUP_CHROMOPHORE_COUNT = declare(
    "int32 chromophore_table/group_chromophore_count(group, region, chromophore) [1]",
    "subjects with such a region",
)
GROUP_CHROMOPHORE_MEAN = declare(
    "float64 chromophore_table/group_chromophore_mean(group, region, chromophore) [1]",
    "mean of take_chromophore",
)
GROUP_CHROMOPHORE_MEAN_LOW = declare(
    "float64 chromophore_table/group_chromophore_mean_low(group, region, chromophore) [1]",
    "lower end of the 95 % interval of the mean",
)
GROUP_CHROMOPHORE_MEAN_HIGH = declare(
    "float64 chromophore_table/group_chromophore_mean_high(group, region, chromophore) [1]",
    "upper end of the 95 % interval of the mean",
)
GROUP_CHROMOPHORE_STANDARD_DEVIATION = declare(
    "float64 chromophore_table/group_chromophore_standard_deviation"
    "(group, region, chromophore) [1]",
    "standard deviation between subjects",
)

# coverage
COVERAGE_COUNT = declare(
    "int32 coverage/coverage_count(cell) [1]",
    "subjects with a value, or with all values of a crossing",
)

# brdf_space
GROUP_SUBJECT_COUNT = declare(
    "int32 brdf_space/group_subject_count(group) [1]",
    "subjects of the group",
)
GROUP_COEFFICIENT = declare(
    "float64 brdf_space/group_coefficient(group, component) [1]",
    "mean over subjects of take_coefficient",
    f"{PAPER}, section 10.1",
)
GROUP_BRDF = declare(
    "float32 brdf_space/group_brdf(group, theta_h, theta_d, phi_d) [sr-1]",
    "mean surface BRDF of the group, averaged over the discs of the lights",
    f"{PAPER}, figure 14",
)
TAKE_DISTANCE = declare(
    "float64 brdf_space/take_distance(take, take_2) [1]",
    "distance between the surface BRDFs of two takes over the length of the mean BRDF",
)
TAKE_PLACE = declare(
    "float64 brdf_space/take_place(take, axis) [1]",
    "place in the map of takes, in the units of take_distance",
)
EXPLAINED_FRACTION = declare(
    "float64 brdf_space/explained_fraction(axis) [1]",
    "fraction of the scatter of takes along an axis",
)
MAP_ERROR = declare(
    "float64 brdf_space/map_error() [1]",
    "RMS error of distances in the map over the RMS distance",
)
PAIR_SUBJECT_COUNT = declare(
    "int32 brdf_space/pair_subject_count(pair, side) [1]",
    "subjects of the first and of the second group",
)
PAIR_PERMUTATIONS = declare(
    "int32 brdf_space/pair_permutations(pair) [1]",
    "permutations of group_distance_p; 0 where it is NaN",
)
GROUP_DISTANCE = declare(
    "float64 brdf_space/group_distance(pair) [1]",
    "distance of the mean BRDFs of two groups over the length of the mean BRDF; of "
    "subjects in both if any",
)
GROUP_DISTANCE_NOISE = declare(
    "float64 brdf_space/group_distance_noise(pair) [1]",
    "standard error of group_distance from scatter of subjects",
)
GROUP_DISTANCE_P = declare(
    "float64 brdf_space/group_distance_p(pair) [1]",
    "p value by permutation of subjects, of this pair alone",
)
GROUP_DISTANCE_P_ADJUSTED = declare(
    "float64 brdf_space/group_distance_p_adjusted(pair) [1]",
    "p value adjusted for all pairs by the largest statistic, or by Bonferroni if pairs "
    "are of two kinds",
    "Westfall and Young 1993",
)

# traits
TRAIT_COUNT = declare(
    "int32 traits/trait_count(trait, side) [1]",
    "subjects with and without the trait",
)
TRAIT_BRDF_SHIFT = declare(
    "float64 traits/trait_brdf_shift(trait, component) [1]",
    "mean coefficient with the trait minus the mean without",
    f"{PAPER}, section 11",
)
TRAIT_BRDF_DISTANCE = declare(
    "float64 traits/trait_brdf_distance(trait) [1]",
    "distance of the BRDFs of trait_brdf_shift, over the length of the mean BRDF of the takes",
)
TRAIT_BRDF_DISTANCE_ERROR = declare(
    "float64 traits/trait_brdf_distance_error(trait) [1]",
    "distance that the scatter of subjects alone would give, by bootstrap",
)
TRAIT_QUANTILE_SHIFT = declare(
    "float64 traits/trait_quantile_shift(trait, region, axis, level) [1]",
    "mean quantile of decorrelated colour with the trait minus the mean without, in "
    "standard deviations",
)
TRAIT_TEXTURE_SHIFT = declare(
    "float32 traits/trait_texture_shift(trait, region, axis, part, level) [1]",
    "mean texture_quantile with the trait minus the mean without; NaN where no take is "
    "registered",
    f"{PAPER}, section 11",
)
TRAIT_LOG_SIGMA_TR_SHIFT = declare(
    "float64 traits/trait_log_sigma_tr_shift(trait, channel) [1]",
    "mean log sigma_tr with the trait minus the mean without",
)
TRAIT_BRDF_SHIFT_ERROR = declare(
    "float64 traits/trait_brdf_shift_error(trait, component) [1]",
    "standard error of trait_brdf_shift by bootstrap over subjects",
)
TRAIT_QUANTILE_SHIFT_ERROR = declare(
    "float64 traits/trait_quantile_shift_error(trait, region, axis, level) [1]",
    "standard error of trait_quantile_shift by bootstrap over subjects",
)
TRAIT_LOG_SIGMA_TR_SHIFT_ERROR = declare(
    "float64 traits/trait_log_sigma_tr_shift_error(trait, channel) [1]",
    "standard error of trait_log_sigma_tr_shift by bootstrap over subjects",
)
TAKE_LOG_SIGMA_TR = declare(
    "float64 traits/take_log_sigma_tr(take, channel) [1]",
    "mean over trusted sites of log sigma_tr in mm-1; NaN without one",
)
