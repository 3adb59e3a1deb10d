"""Variables of a version of kind "model": the fit, its quality, its basis,
translucency, and data for cohorts.
"""

from skindb.schema.declaration import PAPER, FitStatus, ProbeStatus, Use, declare

MISFIT = "median absolute residual in units of the noise scale of each surfel"

# fitted
SHADING_NORMAL = declare(
    "float32 fitted/shading_normal(surfel, xyz) [1]",
    "unit normal from the reflectance",
    f"{PAPER}, section 6",
    Use.SAMPLED | Use.SURVIVES_EDIT,
)
NORMAL_ERROR = declare(
    "float32 fitted/normal_error(surfel) [degree]",
    "standard error of shading_normal (RMS angle): noise of the samples and error of "
    "the scan's prior",
    uses=Use.SAMPLED,
)
NORMAL_TOTAL_ERROR = declare(
    "float32 fitted/normal_total_error(surfel) [degree]",
    "standard error of shading_normal with the error of the model, as captures with "
    "known truth show it",
    uses=Use.EXPORTED,
)
REFRACTIVE_INDEX = declare(
    "float64 fitted/refractive_index() [1]",
    "refractive index eta of the fit",
    f"{PAPER}, eq. 2",
    Use.SURVIVES_EDIT,
)
DIFFUSE_REFLECTANCE = declare(
    "float32 fitted/diffuse_reflectance(surfel, channel) [1]",
    "diffuse albedo R_d",
    f"{PAPER}, eq. 6",
    Use.SAMPLED | Use.MAPPED | Use.SURVIVES_EDIT,
)
DIFFUSE_REFLECTANCE_ERROR = declare(
    "float32 fitted/diffuse_reflectance_error(surfel, channel) [1]",
    "standard error of R_d: noise of the samples and error of the normal",
    uses=Use.EXPORTED | Use.SAMPLED,
)
DIFFUSE_REFLECTANCE_TOTAL_ERROR = declare(
    "float32 fitted/diffuse_reflectance_total_error(surfel, channel) [1]",
    "standard error of R_d with errors of lights, cameras, normal and model, and "
    "even_reflection_error",
    uses=Use.EXPORTED | Use.SAMPLED | Use.MAPPED,
)
EVEN_REFLECTION = declare(
    "float64 fitted/even_reflection() [1]",
    "fraction of light that the surface reflects as if it were diffuse, without colour, "
    "at all surfels; it is not part of R_d, and pictures add it",
    "prior by condition: measured spectra and refractive indices of skin",
    Use.SURVIVES_EDIT,
)
EVEN_REFLECTION_ERROR = declare(
    "float64 fitted/even_reflection_error() [1]",
    "standard error of even_reflection, which R_d has in common in all surfels and "
    "channels of the take",
)
INTER_REFLECTION = declare(
    "uint8 fitted/inter_reflection() [1]",
    "1 if the samples were fitted without light from other parts of the face (one diffuse "
    "bounce), which pictures therefore add, else 0",
    uses=Use.SURVIVES_EDIT,
)
DIPOLE_S = declare(
    "float32 fitted/dipole_s(surfel, channel) [1]",
    "s = sqrt(3 (1 - alpha')), the inverse of eq. 5",
    f"{PAPER}, eq. 5",
    Use.SURVIVES_EDIT,
)
DICTIONARY_WEIGHT = declare(
    "float32 fitted/dictionary_weight(surfel, dictionary) [1]",
    "non-negative weights of the BRDFs of the dictionary; not unique: compare BRDFs, "
    "not weights",
    f"{PAPER}, eq. 8",
    Use.SAMPLED,
)
BASIS_WEIGHT = declare(
    "float32 fitted/basis_weight(surfel, component) [1]",
    "non-negative weights of the reduced basis",
    f"{PAPER}, section 7",
    Use.SAMPLED | Use.SURVIVES_EDIT | Use.SURFACE,
)
BASIS_WEIGHT_ERROR = declare(
    "float32 fitted/basis_weight_error(surfel, component) [1]",
    "standard error of weights above 0: noise of the samples, errors of R_d and normal; "
    "NaN at the bound 0",
    uses=Use.SAMPLED,
)
LOBE_STRENGTH = declare(
    "float32 fitted/lobe_strength(surfel) [1]",
    "factor on the GGX lobe of a surfel, which reflects by the Fresnel equations at 1",
    uses=Use.SAMPLED | Use.SURVIVES_EDIT | Use.SURFACE,
)
LOBE_ROUGHNESS = declare(
    "float32 fitted/lobe_roughness(surfel) [1]",
    "width alpha of the GGX lobe, which includes that of the lights",
    "Walter et al. 2007",
    Use.SAMPLED | Use.SURVIVES_EDIT | Use.SURFACE,
)
LOBE_STRENGTH_ERROR = declare(
    "float32 fitted/lobe_strength_error(surfel) [1]",
    "standard error of lobe_strength: noise of the samples, errors of R_d and normal; "
    "NaN without a lobe",
    uses=Use.SAMPLED,
)
LOBE_ROUGHNESS_ERROR = declare(
    "float32 fitted/lobe_roughness_error(surfel) [1]",
    "standard error of lobe_roughness, from the same sources",
    uses=Use.SAMPLED,
)
SURFACE_REFLECTANCE = declare(
    "float32 fitted/surface_reflectance(surfel) [1]",
    "fraction of light along the normal that the surface reflects, by the mixture of all "
    "BRDFs or by its lobe",
    uses=Use.SAMPLED | Use.MAPPED,
)
SURFACE_REFLECTANCE_ERROR = declare(
    "float32 fitted/surface_reflectance_error(surfel) [1]",
    "standard error of surface_reflectance, from the same sources as basis_weight_error",
    uses=Use.EXPORTED | Use.SAMPLED,
)
GLOSSINESS = declare(
    "float32 fitted/glossiness(surfel) [1]",
    "fraction of surface_reflectance at half vectors within 20 degrees of the normal, the "
    "narrow of two lobes; 0.7 for a GGX lobe of roughness 0.28",
    uses=Use.MAPPED,
)
GLOSSINESS_ERROR = declare(
    "float32 fitted/glossiness_error(surfel) [1]",
    "standard error of glossiness, from the same sources; NaN for a single basis BRDF",
)
SIGMA_TR = declare(
    "float32 fitted/sigma_tr(surfel, channel) [mm-1]",
    "effective transport coefficient; its inverse is the translucency",
    f"{PAPER}, eq. 9",
    Use.SAMPLED | Use.MAPPED | Use.SURVIVES_EDIT,
)
FIT_STATUS = declare(
    "uint8 fitted/fit_status(surfel) [1]",
    "outcome of the fit",
    uses=Use.SURVIVES_EDIT,
    statuses=FitStatus,
)
DICTIONARY_RESIDUAL = declare(
    "float32 fitted/dictionary_residual(surfel) [1]",
    "relative RMS residual of the fit by the whole dictionary",
    uses=Use.REPORTED | Use.EXPORTED,
)
DICTIONARY_RESIDUAL_PERCEPTUAL = declare(
    "float32 fitted/dictionary_residual_perceptual(surfel) [1]",
    "relative RMS residual of the fit by the whole dictionary in cube-root space",
)
FIT_RESIDUAL = declare(
    "float32 fitted/fit_residual(surfel) [1]",
    "relative RMS residual of the fit by the reduced basis",
    uses=Use.REPORTED | Use.EXPORTED | Use.SAMPLED,
)
FIT_RESIDUAL_PERCEPTUAL = declare(
    "float32 fitted/fit_residual_perceptual(surfel) [1]",
    "relative RMS residual of the fit by the reduced basis in cube-root space",
    uses=Use.REPORTED | Use.EXPORTED | Use.SAMPLED,
)
FIT_SAMPLES = declare(
    "int32 fitted/fit_samples(surfel) [1]",
    "samples used by the fit of the surface; normal and R_d are fitted with one lobe for "
    "4 to 11, and with lobes of eight widths for 12 or more",
)
SMALLEST_HALF_ANGLE = declare(
    "float32 fitted/smallest_half_angle(surfel) [degree]",
    "smallest angle between the normal and a half vector of the samples that were fitted",
)
FIT_ITERATIONS = declare(
    "int32 fitted/fit_iterations(surfel) [1]",
    "steps of the active set in the fit of the dictionary",
)
FIT_CONDITION = declare(
    "float32 fitted/fit_condition(surfel) [1]",
    "squared ratio of the extreme pivots of the active BRDFs: a lower bound of their "
    "condition number",
)
KKT_RESIDUAL = declare(
    "float32 fitted/kkt_residual(surfel) [1]",
    "relative KKT residual of the non-negative solution: its certificate",
    uses=Use.REPORTED | Use.EXPORTED,
)
HELD_OUT_ERROR = declare(
    "float32 fitted/held_out_error(surfel) [1]",
    "relative RMS error of predicted samples under held-out lights, in the fitted cameras",
    uses=Use.REPORTED | Use.EXPORTED | Use.SAMPLED,
)
HELD_OUT_ERROR_PERCEPTUAL = declare(
    "float32 fitted/held_out_error_perceptual(surfel) [1]",
    "relative RMS error of predicted samples under held-out lights in cube-root space",
    uses=Use.REPORTED,
)
HELD_OUT_CAMERA_ERROR = declare(
    "float32 fitted/held_out_camera_error(surfel) [1]",
    "relative RMS error of predicted samples in held-out cameras, under the fitted lights",
    uses=Use.REPORTED | Use.EXPORTED | Use.SAMPLED,
)
HELD_OUT_CAMERA_ERROR_PERCEPTUAL = declare(
    "float32 fitted/held_out_camera_error_perceptual(surfel) [1]",
    "relative RMS error of predicted samples in held-out cameras in cube-root space",
    uses=Use.REPORTED,
)
OUTLIER_FRACTION = declare(
    "float32 fitted/outlier_fraction(surfel) [1]",
    "fraction of samples that the model does not explain: motion, hair",
    uses=Use.REPORTED | Use.SAMPLED,
)

# light_gains
LIGHT_GAIN = declare(
    "float64 light_gains/light_gain(light) [1]",
    "how much brighter the light is than its intensity says; samples were divided by it "
    "(fit --light-gains)",
)

# held_out
LIGHT_HELD_OUT = declare(
    "int8 held_out/light_held_out(light) [1]",
    "1 for lights that were held out of the fit, else 0",
)
CAMERA_HELD_OUT = declare(
    "int8 held_out/camera_held_out(camera) [1]",
    "1 for cameras that were held out of the fit, else 0",
)

# outliers
LIGHT_OUTLIER_FRACTION = declare(
    "float32 outliers/light_outlier_fraction(light) [1]",
    "fraction of the light's samples that are outliers",
)
LIGHT_MISFIT = declare(
    "float32 outliers/light_misfit(light) [1]",
    f"{MISFIT}, under a light; a moved face raises it",
)
CAMERA_OUTLIER_FRACTION = declare(
    "float32 outliers/camera_outlier_fraction(camera) [1]",
    "fraction of the camera's samples that are outliers",
)
CAMERA_MISFIT = declare(
    "float32 outliers/camera_misfit(camera) [1]",
    f"{MISFIT}, in a camera; a displaced camera raises it",
)
FRAME_MISFIT = declare(
    "float32 outliers/frame_misfit(light, camera) [1]",
    f"{MISFIT}, in a photograph",
)

# prediction
PREDICTION_SURFELS = declare(
    "int32 prediction/prediction_surfels(region, status) [1]",
    "surfels of the region with this status",
)
PREDICTION_FRACTION = declare(
    "float64 prediction/prediction_fraction(region, status) [1]",
    "fraction of the region's surfels with this status",
)
PREDICTION_OUTLIER_FRACTION = declare(
    "float64 prediction/prediction_outlier_fraction(region, status) [1]",
    "mean over the area of outlier_fraction",
)
PREDICTION_ERROR = declare(
    "float64 prediction/prediction_error(region, status, samples, space, statistic) [1]",
    "median and 95 % quantile over the area of the relative RMS errors of fitted and "
    "held-out samples",
)

# basis
BASIS_MIXTURE = declare(
    "float32 basis/basis_mixture(component, dictionary) [1]",
    "rows of H: the reduced basis as mixtures of the BRDFs of the dictionary",
    f"{PAPER}, section 7",
)
BASIS_BRDF = declare(
    "float32 basis/basis_brdf(component, theta_h, theta_d, phi_d) [sr-1]",
    "tables of the reduced basis; phi_d runs over its whole period from 0 to pi, both "
    "ends included",
    f"{PAPER}, section 7",
)
MEAN_DICTIONARY_WEIGHT = declare(
    "float32 basis/mean_dictionary_weight(dictionary) [1]",
    "area-weighted mean of dictionary_weight over fitted surfels",
)
LOBE_INDEX = declare(
    "float64 basis/lobe_index() [1]",
    "refractive index of the Fresnel term of the GGX lobes, which models with it have "
    "instead of tables",
)
DISC_ANGULAR_RADIUS = declare(
    "float64 basis/disc_angular_radius() [rad]",
    "angular radius of the lights that basis_brdf is averaged over; 0 for point lights",
)

# translucency
SITE_ABSORPTION = declare(
    "float32 translucency/site_absorption(site, channel) [mm-1]",
    "sigma_a of the fitted profile",
    f"{PAPER}, section 8",
)
SITE_REDUCED_SCATTERING = declare(
    "float32 translucency/site_reduced_scattering(site, channel) [mm-1]",
    "sigma_s' of the fitted profile",
    f"{PAPER}, section 8",
)
SITE_SIGMA_TR = declare(
    "float32 translucency/site_sigma_tr(site, channel) [mm-1]",
    "effective transport coefficient of the fitted profile",
    f"{PAPER}, eq. 9",
    Use.SAMPLED | Use.SURVIVES_EDIT,
)
SITE_SIGMA_TR_ERROR = declare(
    "float32 translucency/site_sigma_tr_error(site, channel) [mm-1]",
    "standard error of sigma_tr from the errors of the fibres",
    uses=Use.SAMPLED,
)
SITE_SIGMA_TR_MODEL_ERROR = declare(
    "float32 translucency/site_sigma_tr_model_error(site, channel) [mm-1]",
    "change of sigma_tr that the error of the profile's own model can cause",
    uses=Use.SAMPLED,
)
SITE_SIGMA_TR_TOTAL_ERROR = declare(
    "float32 translucency/site_sigma_tr_total_error(site, channel) [mm-1]",
    "standard error of sigma_tr: errors of the fibres and of the model in quadrature",
    uses=Use.SAMPLED,
)
SITE_GAIN = declare(
    "float32 translucency/site_gain(site, channel) [1]",
    "gain of the probe found by the fit; 1 where it is known",
)
SITE_RESIDUAL = declare(
    "float32 translucency/site_residual(site, channel) [1]",
    "RMS of the log residual over the fibres used",
)
SITE_MISFIT = declare(
    "float32 translucency/site_misfit(site, channel) [1]",
    "RMS log residual of the clearly measured fibres that the errors of fibres and "
    "model leave unexplained",
)
SITE_CHI_SQUARED = declare(
    "float32 translucency/site_chi_squared(site, channel) [1]",
    "squared residuals over the errors of fibres and model, per degree of freedom; far "
    "above 1: another medium",
)
SITE_FIBRES_USED = declare(
    "int32 translucency/site_fibres_used(site, channel) [1]",
    "fibres above the noise floor",
)
SITE_STATUS = declare(
    "uint8 translucency/site_status(site, channel) [1]",
    "outcome of the fit",
    uses=Use.SAMPLED | Use.SURVIVES_EDIT,
    statuses=ProbeStatus,
    absent=ProbeStatus.NOT_MEASURED,
)

# sample
SURFEL_INDEX = declare(
    "int64 sample/surfel_index(surfel) [1]",
    "index among the surfels of the model; -1 where there is none",
    absent=-1,
)

# tables
REGION_SURFELS = declare(
    "int64 tables/region_surfels(region) [1]",
    "trusted surfels of the region",
)
REGION_AREA = declare(
    "float64 tables/region_area(region) [mm2]",
    "area of the trusted surfels of the region",
)
REGION_DIFFUSE_REFLECTANCE = declare(
    "float64 tables/region_diffuse_reflectance(region, channel) [1]",
    "area-weighted mean of R_d over the trusted surfels of the region",
)
REGION_DIFFUSE_REFLECTANCE_ERROR = declare(
    "float64 tables/region_diffuse_reflectance_error(region, channel) [1]",
    "standard error of the mean from the independent errors of its surfels",
)
REGION_DIFFUSE_REFLECTANCE_TOTAL_ERROR = declare(
    "float64 tables/region_diffuse_reflectance_total_error(region, channel) [1]",
    "standard error of the mean with the errors that its surfels have in common",
)
REGION_SURFACE_REFLECTANCE = declare(
    "float64 tables/region_surface_reflectance(region) [1]",
    "area-weighted mean of surface_reflectance over the trusted surfels of the region that "
    "were seen near their highlight",
)
REGION_SURFACE_REFLECTANCE_ERROR = declare(
    "float64 tables/region_surface_reflectance_error(region) [1]",
    "standard error of the mean, from its scatter between patches of the region",
)
REGION_SURFACE_REFLECTANCE_TOTAL_ERROR = declare(
    "float64 tables/region_surface_reflectance_total_error(region) [1]",
    "standard error of the mean with the errors of the model, which takes have in common",
)
REGION_GLOSSINESS = declare(
    "float64 tables/region_glossiness(region) [1]",
    "mean of glossiness over the same surfels, weighted by the light that they reflect",
)
REGION_GLOSSINESS_ERROR = declare(
    "float64 tables/region_glossiness_error(region) [1]",
    "standard error of the mean, from its scatter between patches of the region",
)
REGION_GLOSSINESS_TOTAL_ERROR = declare(
    "float64 tables/region_glossiness_total_error(region) [1]",
    "standard error of the mean with the errors of the model, which takes have in common",
)
REGION_ALBEDO_CONTRAST = declare(
    "float64 tables/region_albedo_contrast(region, channel) [1]",
    "RMS deviation of log R_d at wavelengths of 10 to 25 mm, without noise",
)
REGION_ALBEDO_CONTRAST_ERROR = declare(
    "float64 tables/region_albedo_contrast_error(region, channel) [1]",
    "standard error of the contrast, from its scatter between patches of the region",
)
REGION_NORMAL_SLOPE = declare(
    "float64 tables/region_normal_slope(region) [1]",
    "RMS slope of the normals against smooth ones at wavelengths of 10 to 25 mm, without "
    "noise",
)
REGION_NORMAL_SLOPE_ERROR = declare(
    "float64 tables/region_normal_slope_error(region) [1]",
    "standard error of the slope, from its scatter between patches of the region",
)
