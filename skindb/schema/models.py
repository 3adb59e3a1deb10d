"""Variables of a version of kind "model": the fit, its quality, its basis,
translucency, and data for cohorts.
"""

from __future__ import annotations

from skindb.schema.declaration import PAPER, Variable, declare

MISFIT = "median absolute residual in units of the noise scale of each surfel"
# group of a version -> its variables
MODELS: dict[str, tuple[Variable, ...]] = {
    "fitted": (
        declare(
            "shading_normal",
            "surfel xyz",
            "float32",
            "1",
            "unit normal from the reflectance",
            f"{PAPER}, section 6",
        ),
        declare(
            "normal_disagreement",
            "surfel",
            "float32",
            "degree",
            "angle between the peak-reflectance and the photometric normal",
        ),
        declare(
            "normal_error",
            "surfel",
            "float32",
            "degree",
            (
                "standard error of shading_normal (RMS angle): noise of the samples "
                "and error of the scan's prior"
            ),
        ),
        declare(
            "normal_total_error",
            "surfel",
            "float32",
            "degree",
            (
                "standard error of shading_normal with the error of the model, as "
                "captures with known truth show it"
            ),
        ),
        declare(
            "refractive_index",
            "",
            "float64",
            "1",
            "refractive index eta of the fit",
            f"{PAPER}, eq. 2",
        ),
        declare(
            "diffuse_reflectance",
            "surfel channel",
            "float32",
            "1",
            "diffuse albedo R_d",
            f"{PAPER}, eq. 6",
        ),
        declare(
            "diffuse_reflectance_error",
            "surfel channel",
            "float32",
            "1",
            "standard error of R_d: noise of the samples and error of the normal",
        ),
        declare(
            "diffuse_reflectance_total_error",
            "surfel channel",
            "float32",
            "1",
            (
                "standard error of R_d with errors of lights, cameras, normal and "
                "model, and even_reflection_limit / 1.96"
            ),
        ),
        declare(
            "even_reflection_limit",
            "",
            "float64",
            "1",
            (
                "R_d of the take may be too high by up to this (95 %): the surface "
                "reflects it evenly, without colour"
            ),
            "prior: surface reflection of skin of 4 to 7 %, Anderson and Parrish 1981",
        ),
        declare(
            "dipole_s",
            "surfel channel",
            "float32",
            "1",
            "s = sqrt(3 (1 - alpha')), the inverse of eq. 5",
            f"{PAPER}, eq. 5",
        ),
        declare(
            "dictionary_weight",
            "surfel dictionary",
            "float32",
            "1",
            (
                "non-negative weights of the BRDFs of the dictionary; not unique: "
                "compare BRDFs, not weights"
            ),
            f"{PAPER}, eq. 8",
        ),
        declare(
            "basis_weight",
            "surfel component",
            "float32",
            "1",
            "non-negative weights of the reduced basis",
            f"{PAPER}, section 7",
        ),
        declare(
            "basis_weight_error",
            "surfel component",
            "float32",
            "1",
            (
                "standard error of weights above 0: noise of the samples, errors of "
                "R_d and normal; NaN at the bound 0"
            ),
        ),
        declare(
            "surface_reflectance",
            "surfel",
            "float32",
            "1",
            "fraction of light along the normal that the surface reflects, by the reduced basis",
        ),
        declare(
            "surface_reflectance_error",
            "surfel",
            "float32",
            "1",
            "standard error of surface_reflectance, from the same sources as basis_weight_error",
        ),
        declare(
            "sigma_tr",
            "surfel channel",
            "float32",
            "mm-1",
            "effective transport coefficient; its inverse is the translucency",
            f"{PAPER}, eq. 9",
        ),
        declare("fit_status", "surfel", "uint8", "1", "outcome of the fit"),
        declare(
            "fit_residual",
            "surfel",
            "float32",
            "1",
            "relative RMS residual of the fit by the reduced basis",
        ),
        declare(
            "fit_residual_perceptual",
            "surfel",
            "float32",
            "1",
            "relative RMS residual of the fit by the reduced basis in cube-root space",
        ),
        declare(
            "dictionary_residual",
            "surfel",
            "float32",
            "1",
            "relative RMS residual of the fit by the whole dictionary",
        ),
        declare(
            "dictionary_residual_perceptual",
            "surfel",
            "float32",
            "1",
            "relative RMS residual of the fit by the whole dictionary in cube-root space",
        ),
        declare(
            "fit_samples",
            "surfel",
            "int32",
            "1",
            "samples used by the fit of the dictionary",
        ),
        declare(
            "fit_iterations",
            "surfel",
            "int32",
            "1",
            "steps of the active set in the fit of the dictionary",
        ),
        declare(
            "fit_condition",
            "surfel",
            "float32",
            "1",
            (
                "squared ratio of the extreme pivots of the active BRDFs: a lower "
                "bound of their condition number"
            ),
        ),
        declare(
            "kkt_residual",
            "surfel",
            "float32",
            "1",
            "relative KKT residual of the non-negative solution: its certificate",
        ),
        declare(
            "held_out_error",
            "surfel",
            "float32",
            "1",
            "relative RMS error of predicted samples under held-out lights, in the fitted cameras",
        ),
        declare(
            "held_out_error_perceptual",
            "surfel",
            "float32",
            "1",
            "relative RMS error of predicted samples under held-out lights in cube-root space",
        ),
        declare(
            "held_out_camera_error",
            "surfel",
            "float32",
            "1",
            "relative RMS error of predicted samples in held-out cameras, under the fitted lights",
        ),
        declare(
            "held_out_camera_error_perceptual",
            "surfel",
            "float32",
            "1",
            "relative RMS error of predicted samples in held-out cameras in cube-root space",
        ),
        declare(
            "outlier_fraction",
            "surfel",
            "float32",
            "1",
            "fraction of samples that the model does not explain: motion, hair",
        ),
    ),
    "light_gains": (
        declare(
            "light_gain",
            "light",
            "float64",
            "1",
            (
                "how much brighter the light is than its intensity says; samples were "
                "divided by it (fit --light-gains)"
            ),
        ),
    ),
    "held_out": (
        declare(
            "light_held_out",
            "light",
            "int8",
            "1",
            "1 for lights that were held out of the fit, else 0",
        ),
        declare(
            "camera_held_out",
            "camera",
            "int8",
            "1",
            "1 for cameras that were held out of the fit, else 0",
        ),
    ),
    "outliers": (
        declare(
            "light_outlier_fraction",
            "light",
            "float32",
            "1",
            "fraction of the light's samples that are outliers",
        ),
        declare(
            "light_misfit",
            "light",
            "float32",
            "1",
            f"{MISFIT}, under a light; a moved face raises it",
        ),
        declare(
            "camera_outlier_fraction",
            "camera",
            "float32",
            "1",
            "fraction of the camera's samples that are outliers",
        ),
        declare(
            "camera_misfit",
            "camera",
            "float32",
            "1",
            f"{MISFIT}, in a camera; a displaced camera raises it",
        ),
        declare(
            "frame_misfit", "light camera", "float32", "1", f"{MISFIT}, in a photograph"
        ),
    ),
    "prediction": (
        declare(
            "prediction_surfels",
            "region status",
            "int32",
            "1",
            "surfels of the region with this status",
        ),
        declare(
            "prediction_fraction",
            "region status",
            "float64",
            "1",
            "fraction of the region's surfels with this status",
        ),
        declare(
            "prediction_outlier_fraction",
            "region status",
            "float64",
            "1",
            "mean over the area of outlier_fraction",
        ),
        declare(
            "prediction_error",
            "region status samples space statistic",
            "float64",
            "1",
            (
                "median and 95 % quantile over the area of the relative RMS errors of "
                "fitted and held-out samples"
            ),
        ),
    ),
    "basis": (
        declare(
            "basis_mixture",
            "component dictionary",
            "float32",
            "1",
            "rows of H: the reduced basis as mixtures of the BRDFs of the dictionary",
            f"{PAPER}, section 7",
        ),
        declare(
            "basis_brdf",
            "component theta_h theta_d phi_d",
            "float32",
            "sr-1",
            (
                "tables of the reduced basis; phi_d runs over its whole period from 0 "
                "to pi, both ends included"
            ),
            f"{PAPER}, section 7",
        ),
        declare(
            "mean_dictionary_weight",
            "dictionary",
            "float32",
            "1",
            "area-weighted mean of dictionary_weight over fitted surfels",
        ),
        declare(
            "disc_angular_radius",
            "",
            "float64",
            "rad",
            "angular radius of the lights that basis_brdf is averaged over; 0 for point lights",
        ),
    ),
    "translucency": (
        declare(
            "site_absorption",
            "site channel",
            "float32",
            "mm-1",
            "sigma_a of the fitted profile",
            f"{PAPER}, section 8",
        ),
        declare(
            "site_reduced_scattering",
            "site channel",
            "float32",
            "mm-1",
            "sigma_s' of the fitted profile",
            f"{PAPER}, section 8",
        ),
        declare(
            "site_sigma_tr",
            "site channel",
            "float32",
            "mm-1",
            "effective transport coefficient of the fitted profile",
            f"{PAPER}, eq. 9",
        ),
        declare(
            "site_sigma_tr_error",
            "site channel",
            "float32",
            "mm-1",
            "standard error of sigma_tr from the errors of the fibres",
        ),
        declare(
            "site_sigma_tr_model_error",
            "site channel",
            "float32",
            "mm-1",
            "change of sigma_tr that the error of the profile's own model can cause",
        ),
        declare(
            "site_sigma_tr_total_error",
            "site channel",
            "float32",
            "mm-1",
            "standard error of sigma_tr: errors of the fibres and of the model in quadrature",
        ),
        declare(
            "site_correlation",
            "site channel",
            "float32",
            "1",
            "correlation of the errors of log sigma_tr, log sigma_s'",
        ),
        declare(
            "site_best_exponent",
            "site channel parameter",
            "float32",
            "1",
            "exponents a, b of sigma_tr^a sigma_s'^b, the product that the profile determines best",
        ),
        declare(
            "site_gain",
            "site channel",
            "float32",
            "1",
            "gain of the probe found by the fit; 1 where it is known",
        ),
        declare(
            "site_residual",
            "site channel",
            "float32",
            "1",
            "RMS of the log residual over the fibres used",
        ),
        declare(
            "site_misfit",
            "site channel",
            "float32",
            "1",
            (
                "RMS log residual of the clearly measured fibres that the errors of "
                "fibres and model leave unexplained"
            ),
        ),
        declare(
            "site_chi_squared",
            "site channel",
            "float32",
            "1",
            (
                "squared residuals over the errors of fibres and model, per degree of "
                "freedom; far above 1: another medium"
            ),
        ),
        declare(
            "site_fibres_used",
            "site channel",
            "int32",
            "1",
            "fibres above the noise floor",
        ),
        declare("site_status", "site channel", "uint8", "1", "outcome of the fit"),
    ),
    "sample": (
        declare(
            "surfel_index",
            "surfel",
            "int64",
            "1",
            "index among the surfels of the model; -1 where there is none",
        ),
    ),
    "tables": (
        declare(
            "region_surfels", "region", "int64", "1", "trusted surfels of the region"
        ),
        declare(
            "region_area",
            "region",
            "float64",
            "mm2",
            "area of the trusted surfels of the region",
        ),
        declare(
            "region_diffuse_reflectance",
            "region channel",
            "float64",
            "1",
            "area-weighted mean of R_d over the trusted surfels of the region",
        ),
        declare(
            "region_diffuse_reflectance_error",
            "region channel",
            "float64",
            "1",
            "standard error of the mean from the independent errors of its surfels",
        ),
        declare(
            "region_diffuse_reflectance_total_error",
            "region channel",
            "float64",
            "1",
            "standard error of the mean with the errors that its surfels have in common",
        ),
        declare(
            "region_diffuse_covariance",
            "region channel channel_2",
            "float64",
            "1",
            (
                "area-weighted covariance of R_d between channels over the trusted "
                "surfels of the region"
            ),
        ),
        declare(
            "region_surface_reflectance",
            "region",
            "float64",
            "1",
            "area-weighted mean of surface_reflectance over the trusted surfels of the region",
        ),
        declare(
            "region_surface_reflectance_error",
            "region",
            "float64",
            "1",
            "standard error of the mean from the independent errors of its surfels",
        ),
        declare(
            "mean_basis_weight",
            "component",
            "float64",
            "1",
            (
                "area-weighted mean of basis_weight; each model has its own basis, so "
                "takes are not comparable"
            ),
        ),
        declare(
            "median_error",
            "measure",
            "float64",
            "1",
            "median over surfels of residuals and of errors at held-out lights and cameras",
        ),
    ),
}
