"""The one list of stored variables."""

from __future__ import annotations

from dataclasses import dataclass

SCHEMA_VERSION = 1


@dataclass(frozen=True)
class Variable:
    """Declaration of a stored variable."""

    name: str
    dims: tuple[str, ...]
    dtype: str
    units: str
    doc: str
    source: str = "skindb"


def _v(name: str, dims: str, dtype: str, units: str, doc: str, source: str = "skindb") -> Variable:
    return Variable(name, tuple(dims.split()), dtype, units, doc, source)


PAPER = "Weyrich et al. 2005"
MISFIT = "median of absolute residuals over the scale of their surfel's noise"

# group of a version -> its variables
GROUPS: dict[str, tuple[Variable, ...]] = {
    "samples": (
        _v(
            "reflectance_sample",
            "surfel light camera channel",
            "float16",
            "sr-1",
            "radiance over irradiance facing the light, f_r cos(theta_i); NaN where invisible, saturated or dark",
            f"{PAPER}, eq. 3",
        ),
        _v("sample_count", "surfel", "int32", "1", "light and camera pairs with a usable sample"),
        _v("saturated_count", "surfel", "int32", "1", "visible pairs lost because every exposure was saturated"),
        _v("dark_count", "surfel", "int32", "1", "visible pairs lost because every exposure was below the noise floor"),
    ),
    "surfels": (
        _v("surfel_position", "surfel xyz", "float32", "mm", "position in the subject frame, surfels in Morton order"),
        _v("surfel_normal", "surfel xyz", "float32", "1", "unit normal of the scan, outwards"),
        _v("surfel_area", "surfel", "float32", "mm2", "a third of the area of the adjacent triangles"),
        _v(
            "soft_light_count",
            "surfel",
            "int32",
            "1",
            "lights whose disc it sees in part, at the soft edge of a shadow",
        ),
        _v(
            "surfel_radius",
            "surfel",
            "float32",
            "mm",
            "radius of the disc that covers the gap to the neighbours: 0.7 of the longest edge",
            "Zwicker et al. 2001",
        ),
        _v(
            "surfel_uv",
            "surfel uv",
            "float32",
            "1",
            "texture coordinates, v = 0 at the top row",
            "Desbrun et al. 2002 or Floater 2003, equalised as Yoshizawa et al. 2004",
        ),
        _v("light_visible_fraction", "surfel light", "float16", "1", "visible share of the light's disc"),
        _v(
            "camera_visible_fraction",
            "surfel camera",
            "float16",
            "1",
            "1 where the camera sees the surfel, 0 elsewhere",
        ),
        _v("region_mask", "surfel region", "bool", "1", "surfel belongs to the named region"),
    ),
    "mesh": (
        _v(
            "triangle",
            "face corner",
            "int32",
            "1",
            "surfel indices of the subdivided scan's triangles, counter-clockwise from outside",
        ),
        _v(
            "landmark_position",
            "landmark xyz",
            "float32",
            "mm",
            "named points of the face, on the surface of the surfels; NaN where that was cropped away",
        ),
        _v(
            "landmark_surface_distance",
            "landmark",
            "float32",
            "mm",
            "distance of the landmark as given from the cleaned scan",
        ),
    ),
    "atlas": (
        _v(
            "atlas_area_log2_sd",
            "region",
            "float64",
            "1",
            "standard deviation over the area of log2 of area in the map over area on the face",
        ),
        _v(
            "atlas_anisotropy_median",
            "region",
            "float64",
            "1",
            "median over the area of the largest over the smallest stretch of the map",
            "Sander et al. 2001",
        ),
        _v("atlas_anisotropy_p99", "region", "float64", "1", "99 % quantile of the same", "Sander et al. 2001"),
        _v("atlas_flips", "region", "int32", "1", "triangles turned over in the map, counted exactly: 0"),
    ),
    "dome": (
        _v("light_position", "light xyz", "float32", "mm", "centre of the light's disc"),
        _v("light_axis", "light xyz", "float32", "1", "unit direction the light shines along"),
        _v("light_disc_radius", "light", "float32", "mm", "radius of the light's disc"),
        _v(
            "light_falloff",
            "light",
            "float32",
            "1",
            "exponent n of the angular fall-off cos^n; 0 for an isotropic light",
        ),
        _v(
            "light_intensity",
            "light channel",
            "float32",
            "radiance mm2",
            "radiant intensity in the units of the frames' radiance times mm2",
            f"{PAPER}, section 5",
        ),
        _v("camera_position", "camera xyz", "float32", "mm", "centre of projection"),
        _v("camera_matrix", "camera row col", "float64", "pixel", "intrinsic matrix K, pixel centres at integer + 0.5"),
        _v("camera_rotation", "camera row col", "float64", "1", "R of x_cam = R x + t, OpenCV axes"),
        _v("camera_translation", "camera xyz", "float64", "mm", "t of x_cam = R x + t"),
        _v("camera_distortion", "camera coefficient", "float64", "1", "k1 k2 p1 p2 k3 of OpenCV's model"),
        _v("camera_size", "camera axis", "int32", "pixel", "width and height"),
    ),
    "probe": (
        _v("fibre_distance", "fibre", "float32", "mm", "distance of the detection fibre from the source fibre"),
        _v(
            "fibre_profile",
            "site fibre channel",
            "float32",
            "mm-2",
            "diffuse reflectance R(r) per area; arbitrary units where gain_known is 0",
            f"{PAPER}, section 8",
        ),
        _v("fibre_profile_error", "site fibre channel", "float32", "mm-2", "standard error of fibre_profile"),
        _v(
            "site_position",
            "site xyz",
            "float32",
            "mm",
            "where the probe touched, from regions and landmarks; NaN if unknown",
        ),
    ),
    "photographs": (
        _v(
            "photograph_radiance",
            "photograph image_row image_col channel",
            "float16",
            "radiance",
            "merged radiance of one photograph as taken (distorted); NaN where saturated",
        ),
        _v("photograph_light", "photograph", "int32", "1", "index of the photograph's light"),
        _v("photograph_camera", "photograph", "int32", "1", "index of the photograph's camera"),
    ),
    "fitted": (
        _v("shading_normal", "surfel xyz", "float32", "1", "unit normal from the reflectance", f"{PAPER}, section 6"),
        _v(
            "normal_disagreement",
            "surfel",
            "float32",
            "degree",
            "angle between the peak-reflectance and the photometric normal",
        ),
        _v(
            "normal_error",
            "surfel",
            "float32",
            "degree",
            "standard error of shading_normal, the RMS angle: noise of the samples and error of the scan's prior",
        ),
        _v(
            "normal_total_error",
            "surfel",
            "float32",
            "degree",
            "the same with the error of the model, as captures with known truth show it",
        ),
        _v("diffuse_reflectance", "surfel channel", "float32", "1", "diffuse albedo R_d", f"{PAPER}, eq. 6"),
        _v(
            "diffuse_reflectance_error",
            "surfel channel",
            "float32",
            "1",
            "standard error of R_d: noise of the samples, error of the normal",
        ),
        _v(
            "diffuse_reflectance_total_error",
            "surfel channel",
            "float32",
            "1",
            "the same with the error of the model, as captures with known truth show it",
        ),
        _v(
            "dipole_s",
            "surfel channel",
            "float32",
            "1",
            "s = sqrt(3 (1 - alpha')), the inverse of eq. 5",
            f"{PAPER}, eq. 5",
        ),
        _v(
            "basis_weight",
            "surfel basis",
            "float32",
            "1",
            "non-negative weights of the measured BRDFs; not unique, compare BRDFs instead",
            f"{PAPER}, eq. 8",
        ),
        _v(
            "reduced_weight",
            "surfel component",
            "float32",
            "1",
            "non-negative weights of the reduced basis",
            f"{PAPER}, section 7",
        ),
        _v(
            "reduced_weight_error",
            "surfel component",
            "float32",
            "1",
            "standard error of weights above 0: noise of the samples, errors of R_d and normal; NaN at the bound 0",
        ),
        _v(
            "surface_reflectance",
            "surfel",
            "float32",
            "1",
            "share of light along the normal that the surface reflects, of the reduced basis",
        ),
        _v(
            "surface_reflectance_error",
            "surfel",
            "float32",
            "1",
            "standard error of surface_reflectance; as the weights'",
        ),
        _v(
            "effective_transport",
            "surfel channel",
            "float32",
            "mm-1",
            "sigma_tr; its inverse is the translucency",
            f"{PAPER}, eq. 9",
        ),
        _v("fit_status", "surfel", "uint8", "1", "what became of the fit"),
        _v("fit_residual", "surfel", "float32", "1", "relative RMS residual of the reduced fit, linear"),
        _v(
            "fit_residual_perceptual",
            "surfel",
            "float32",
            "1",
            "relative RMS residual of the reduced fit between cube roots",
        ),
        _v(
            "full_basis_residual", "surfel", "float32", "1", "relative RMS residual of the fit with every basis, linear"
        ),
        _v(
            "full_basis_residual_perceptual",
            "surfel",
            "float32",
            "1",
            "relative RMS residual of the fit with every basis between cube roots",
        ),
        _v("fit_samples", "surfel", "int32", "1", "samples the fit with every basis used"),
        _v("fit_iterations", "surfel", "int32", "1", "steps of the active set in the fit with every basis"),
        _v(
            "fit_condition",
            "surfel",
            "float32",
            "1",
            "squared ratio of the extreme pivots of the active bases: a lower bound of their condition number",
        ),
        _v(
            "kkt_residual",
            "surfel",
            "float32",
            "1",
            "relative KKT residual of the non-negative solution: its certificate",
        ),
        _v(
            "held_out_error",
            "surfel",
            "float32",
            "1",
            "relative RMS error of predicted samples under lights the fit did not see, of cameras it saw",
        ),
        _v(
            "held_out_error_perceptual",
            "surfel",
            "float32",
            "1",
            "the same error between cube roots",
        ),
        _v(
            "held_out_camera_error",
            "surfel",
            "float32",
            "1",
            "relative RMS error of predicted samples of cameras the fit did not see, under lights it saw",
        ),
        _v(
            "held_out_camera_error_perceptual",
            "surfel",
            "float32",
            "1",
            "the same error between cube roots",
        ),
        _v("outlier_share", "surfel", "float32", "1", "share of samples the model does not explain: motion, hair"),
    ),
    "outliers": (
        _v("light_outlier_share", "light", "float32", "1", "share of the light's samples that are outliers"),
        _v("light_misfit", "light", "float32", "1", f"{MISFIT}, under a light; a moved face raises it"),
        _v("camera_outlier_share", "camera", "float32", "1", "share of the camera's samples that are outliers"),
        _v("camera_misfit", "camera", "float32", "1", f"{MISFIT}, of a camera; a knocked camera raises it"),
        _v("frame_misfit", "light camera", "float32", "1", f"{MISFIT}, of a photograph"),
    ),
    "prediction": (
        _v("prediction_surfels", "region status", "int32", "1", "surfels of the region with this status"),
        _v("prediction_share", "region status", "float64", "1", "share of the region's surfels with this status"),
        _v("prediction_outlier_share", "region status", "float64", "1", "mean over the area of outlier_share"),
        _v(
            "prediction_error",
            "region status samples space statistic",
            "float64",
            "1",
            "median and 95 % over the area of the relative RMS errors of fitted and held-out samples",
        ),
    ),
    "basis": (
        _v(
            "component_weight",
            "component basis",
            "float32",
            "1",
            "rows of H: the reduced basis as mixtures of the measured BRDFs",
            f"{PAPER}, section 7",
        ),
        _v(
            "basis_brdf",
            "component theta_h theta_d phi_d",
            "float32",
            "sr-1",
            "tables of the reduced basis",
            f"{PAPER}, section 7",
        ),
        _v("mean_basis_weight", "basis", "float32", "1", "mean of basis_weight over fitted surfels, area weighted"),
    ),
    "translucency": (
        _v(
            "site_absorption", "site channel", "float32", "mm-1", "sigma_a of the profile fitted", f"{PAPER}, section 8"
        ),
        _v(
            "site_reduced_scattering",
            "site channel",
            "float32",
            "mm-1",
            "sigma_s' of the profile fitted",
            f"{PAPER}, section 8",
        ),
        _v(
            "site_effective_transport",
            "site channel",
            "float32",
            "mm-1",
            "sigma_tr of the profile fitted",
            f"{PAPER}, eq. 9",
        ),
        _v(
            "site_effective_transport_error",
            "site channel",
            "float32",
            "mm-1",
            "standard error of sigma_tr by the errors of the fibres; the model's own is apart",
        ),
        _v(
            "site_effective_transport_model_error",
            "site channel",
            "float32",
            "mm-1",
            "what the error of the profile that was fitted can move sigma_tr",
        ),
        _v("site_gain", "site channel", "float32", "1", "gain of the probe found by the fit; 1 where it is known"),
        _v("site_residual", "site channel", "float32", "1", "RMS of the log residual over the fibres used"),
        _v(
            "site_chi_squared",
            "site channel",
            "float32",
            "1",
            "squared residuals over the errors of fibres and model, per degree of freedom; far above 1: another medium",
        ),
        _v("site_fibres_used", "site channel", "int32", "1", "fibres above the noise floor"),
        _v("site_status", "site channel", "uint8", "1", "what became of the fit"),
    ),
    "translucency_table": (
        _v("sigma_tr_count", "group site channel", "int32", "1", "takes with a fitted sigma_tr", f"{PAPER}, table 2"),
        _v("sigma_tr_mean", "group site channel", "float64", "mm-1", "mean of sigma_tr", f"{PAPER}, table 2"),
        _v("sigma_tr_mean_low", "group site channel", "float64", "mm-1", "lower end of the 95 % interval of the mean"),
        _v("sigma_tr_mean_high", "group site channel", "float64", "mm-1", "upper end of the 95 % interval of the mean"),
        _v("sigma_tr_standard_deviation", "group site channel", "float64", "mm-1", "standard deviation of sigma_tr"),
        _v("sigma_tr_deviation_low", "group site channel", "float64", "mm-1", "lower end of its 95 % interval"),
        _v("sigma_tr_deviation_high", "group site channel", "float64", "mm-1", "upper end of its 95 % interval"),
        _v("sigma_tr_variance", "group site channel", "float64", "mm-2", "variance of sigma_tr, unbiased"),
        _v(
            "sigma_tr_measurement_error",
            "group site channel",
            "float64",
            "mm-1",
            "RMS of the standard errors of the takes, a part of the standard deviation",
        ),
    ),
    "dictionary_report": (
        _v("normal_albedo", "basis", "float64", "1", "share of the light reflected at normal incidence"),
        _v("largest_albedo", "basis", "float64", "1", "the same, the largest over incidences up to 85 degrees"),
        _v("energy_excess", "basis", "float64", "1", "largest albedo above 1, before or after the light's disc"),
        _v("reciprocity_error", "basis", "float64", "1", "relative rms difference when both directions are exchanged"),
        _v("one_sided_error", "basis", "float64", "1", "the same between disc averages around either direction"),
        _v("disc_quadrature_error", "basis", "float64", "1", "relative rms error of the rule over the light's disc"),
        _v("disc_table_error", "basis", "float64", "1", "the same of the averaged tables between their nodes"),
        _v("interpolation_error", "basis", "float64", "1", "relative rms error of the tables against their source"),
        _v("hole_share", "basis", "float64", "1", "unmeasured nodes above the horizon, which continue neighbours"),
    ),
    "registration": (
        _v(
            "common_uv",
            "surfel uv",
            "float32",
            "1",
            "texture coordinates in the space all takes share, warped by landmarks; may leave [0, 1] at the rim",
            f"{PAPER}, section 10.2",
        ),
        _v("common_landmark", "landmark uv", "float32", "1", "where landmarks lie in the space all takes share"),
        _v(
            "landmark_residual",
            "landmark",
            "float32",
            "1",
            "distance of the warped landmark from common_landmark, in texture coordinates; NaN where it is missing",
        ),
        _v(
            "landmark_prediction_error",
            "landmark",
            "float32",
            "1",
            "distance of common_landmark from where the warp by the other landmarks puts it; large: clicked wrong",
        ),
        _v(
            "landmark_used",
            "landmark",
            "bool",
            "1",
            "0: missing, not finite, or so near to one before it that their mean counts",
        ),
    ),
    "basis_size": (
        _v(
            "relative_error",
            "k",
            "float64",
            "1",
            "reconstruction error of reflectance over that of every basis",
            f"{PAPER}, figure 15",
        ),
        _v("relative_error_low", "k", "float64", "1", "lower end of the 95 % bootstrap interval over surfels"),
        _v("relative_error_high", "k", "float64", "1", "upper end of the 95 % bootstrap interval over surfels"),
    ),
    "population_basis": (
        _v(
            "population_weight",
            "component basis",
            "float32",
            "1",
            "rows of H common to the population",
            f"{PAPER}, section 10.1",
        ),
        _v(
            "take_coefficient",
            "take component",
            "float64",
            "1",
            "mean surface BRDF of a take in the common basis",
            f"{PAPER}, section 10.1",
        ),
    ),
    "albedo": (
        _v("colour_mean", "channel", "float64", "1", "mean diffuse reflectance over takes"),
        _v(
            "colour_axis",
            "axis channel",
            "float64",
            "1",
            "rows: decorrelated colour axes over their standard deviation",
            "Heeger and Bergen 1995, section 3.5",
        ),
        _v("histogram_edge", "axis edge", "float64", "1", "bin edges, shared by all takes"),
        _v(
            "albedo_histogram",
            "take region axis bin",
            "float64",
            "1",
            "share of the region's area per bin",
            f"{PAPER}, section 10.2",
        ),
        _v("albedo_mean", "take region channel", "float64", "1", "area-weighted mean diffuse reflectance"),
    ),
    "albedo_table": (
        _v("group_albedo_count", "group region channel", "int32", "1", "takes with such a region"),
        _v("group_albedo_mean", "group region channel", "float64", "1", "mean over takes of their mean albedo"),
        _v("group_albedo_mean_low", "group region channel", "float64", "1", "lower end of the mean's 95 % interval"),
        _v("group_albedo_mean_high", "group region channel", "float64", "1", "upper end of the mean's 95 % interval"),
        _v("group_albedo_standard_deviation", "group region channel", "float64", "1", "between takes"),
        _v("group_histogram", "group region axis bin", "float64", "1", "mean over takes of albedo_histogram"),
    ),
    "traits": (
        _v("trait_count", "trait side", "int32", "1", "takes with and without the trait"),
        _v(
            "trait_brdf_shift",
            "trait component",
            "float64",
            "1",
            "mean coefficient with the trait less without",
            f"{PAPER}, section 11",
        ),
        _v(
            "trait_histogram_shift",
            "trait region axis bin",
            "float64",
            "1",
            "mean histogram with the trait less without",
            f"{PAPER}, section 11",
        ),
        _v(
            "trait_quantile_shift",
            "trait region axis level",
            "float64",
            "1",
            "mean quantile of decorrelated colour with the trait less without, in standard deviations",
        ),
        _v(
            "trait_log_sigma_tr_shift", "trait channel", "float64", "1", "mean log sigma_tr with the trait less without"
        ),
        _v(
            "take_log_sigma_tr",
            "take channel",
            "float64",
            "1",
            "mean over trusted sites of log sigma_tr in mm-1; NaN without one",
        ),
    ),
}
VARIABLES: dict[str, Variable] = {variable.name: variable for group in GROUPS.values() for variable in group}
