"""What a version of kind model holds: the fit, how good it is, its basis, translucency."""

from __future__ import annotations

from skindb.schema.declaration import PAPER, Variable, declare

MISFIT = "median of absolute residuals over the scale of their surfel's noise"
# group of a version -> its variables
MODELS: dict[str, tuple[Variable, ...]] = {
    "fitted": (
        declare(
            "shading_normal", "surfel xyz", "float32", "1", "unit normal from the reflectance", f"{PAPER}, section 6"
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
            "standard error of shading_normal, the RMS angle: noise of the samples and error of the scan's prior",
        ),
        declare(
            "normal_total_error",
            "surfel",
            "float32",
            "degree",
            "the same with the error of the model, as captures with known truth show it",
        ),
        declare("diffuse_reflectance", "surfel channel", "float32", "1", "diffuse albedo R_d", f"{PAPER}, eq. 6"),
        declare(
            "diffuse_reflectance_error",
            "surfel channel",
            "float32",
            "1",
            "standard error of R_d: noise of the samples, error of the normal",
        ),
        declare(
            "diffuse_reflectance_total_error",
            "surfel channel",
            "float32",
            "1",
            "the same with the error of the model, as captures with known truth show it",
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
            "basis_weight",
            "surfel basis",
            "float32",
            "1",
            "non-negative weights of the measured BRDFs; not unique, compare BRDFs instead",
            f"{PAPER}, eq. 8",
        ),
        declare(
            "reduced_weight",
            "surfel component",
            "float32",
            "1",
            "non-negative weights of the reduced basis",
            f"{PAPER}, section 7",
        ),
        declare(
            "reduced_weight_error",
            "surfel component",
            "float32",
            "1",
            "standard error of weights above 0: noise of the samples, errors of R_d and normal; NaN at the bound 0",
        ),
        declare(
            "surface_reflectance",
            "surfel",
            "float32",
            "1",
            "share of light along the normal that the surface reflects, of the reduced basis",
        ),
        declare(
            "surface_reflectance_error",
            "surfel",
            "float32",
            "1",
            "standard error of surface_reflectance; as the weights'",
        ),
        declare(
            "effective_transport",
            "surfel channel",
            "float32",
            "mm-1",
            "sigma_tr; its inverse is the translucency",
            f"{PAPER}, eq. 9",
        ),
        declare("fit_status", "surfel", "uint8", "1", "what became of the fit"),
        declare("fit_residual", "surfel", "float32", "1", "relative RMS residual of the reduced fit, linear"),
        declare(
            "fit_residual_perceptual",
            "surfel",
            "float32",
            "1",
            "relative RMS residual of the reduced fit between cube roots",
        ),
        declare(
            "full_basis_residual", "surfel", "float32", "1", "relative RMS residual of the fit with every basis, linear"
        ),
        declare(
            "full_basis_residual_perceptual",
            "surfel",
            "float32",
            "1",
            "relative RMS residual of the fit with every basis between cube roots",
        ),
        declare("fit_samples", "surfel", "int32", "1", "samples the fit with every basis used"),
        declare("fit_iterations", "surfel", "int32", "1", "steps of the active set in the fit with every basis"),
        declare(
            "fit_condition",
            "surfel",
            "float32",
            "1",
            "squared ratio of the extreme pivots of the active bases: a lower bound of their condition number",
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
            "relative RMS error of predicted samples under lights the fit did not see, of cameras it saw",
        ),
        declare(
            "held_out_error_perceptual",
            "surfel",
            "float32",
            "1",
            "the same error between cube roots",
        ),
        declare(
            "held_out_camera_error",
            "surfel",
            "float32",
            "1",
            "relative RMS error of predicted samples of cameras the fit did not see, under lights it saw",
        ),
        declare(
            "held_out_camera_error_perceptual",
            "surfel",
            "float32",
            "1",
            "the same error between cube roots",
        ),
        declare("outlier_share", "surfel", "float32", "1", "share of samples the model does not explain: motion, hair"),
    ),
    "outliers": (
        declare("light_outlier_share", "light", "float32", "1", "share of the light's samples that are outliers"),
        declare("light_misfit", "light", "float32", "1", f"{MISFIT}, under a light; a moved face raises it"),
        declare("camera_outlier_share", "camera", "float32", "1", "share of the camera's samples that are outliers"),
        declare("camera_misfit", "camera", "float32", "1", f"{MISFIT}, of a camera; a knocked camera raises it"),
        declare("frame_misfit", "light camera", "float32", "1", f"{MISFIT}, of a photograph"),
    ),
    "prediction": (
        declare("prediction_surfels", "region status", "int32", "1", "surfels of the region with this status"),
        declare("prediction_share", "region status", "float64", "1", "share of the region's surfels with this status"),
        declare("prediction_outlier_share", "region status", "float64", "1", "mean over the area of outlier_share"),
        declare(
            "prediction_error",
            "region status samples space statistic",
            "float64",
            "1",
            "median and 95 % over the area of the relative RMS errors of fitted and held-out samples",
        ),
    ),
    "basis": (
        declare(
            "component_weight",
            "component basis",
            "float32",
            "1",
            "rows of H: the reduced basis as mixtures of the measured BRDFs",
            f"{PAPER}, section 7",
        ),
        declare(
            "basis_brdf",
            "component theta_h theta_d phi_d",
            "float32",
            "sr-1",
            "tables of the reduced basis",
            f"{PAPER}, section 7",
        ),
        declare(
            "mean_basis_weight", "basis", "float32", "1", "mean of basis_weight over fitted surfels, area weighted"
        ),
    ),
    "translucency": (
        declare(
            "site_absorption", "site channel", "float32", "mm-1", "sigma_a of the profile fitted", f"{PAPER}, section 8"
        ),
        declare(
            "site_reduced_scattering",
            "site channel",
            "float32",
            "mm-1",
            "sigma_s' of the profile fitted",
            f"{PAPER}, section 8",
        ),
        declare(
            "site_effective_transport",
            "site channel",
            "float32",
            "mm-1",
            "sigma_tr of the profile fitted",
            f"{PAPER}, eq. 9",
        ),
        declare(
            "site_effective_transport_error",
            "site channel",
            "float32",
            "mm-1",
            "standard error of sigma_tr by the errors of the fibres; the model's own is apart",
        ),
        declare(
            "site_effective_transport_model_error",
            "site channel",
            "float32",
            "mm-1",
            "what the error of the profile that was fitted can move sigma_tr",
        ),
        declare("site_gain", "site channel", "float32", "1", "gain of the probe found by the fit; 1 where it is known"),
        declare("site_residual", "site channel", "float32", "1", "RMS of the log residual over the fibres used"),
        declare(
            "site_chi_squared",
            "site channel",
            "float32",
            "1",
            "squared residuals over the errors of fibres and model, per degree of freedom; far above 1: another medium",
        ),
        declare("site_fibres_used", "site channel", "int32", "1", "fibres above the noise floor"),
        declare("site_status", "site channel", "uint8", "1", "what became of the fit"),
    ),
}
