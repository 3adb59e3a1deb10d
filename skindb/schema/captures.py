"""Variables of a version of kind "capture": samples, surface, dome, probe, photographs."""

from __future__ import annotations

from skindb.schema.declaration import PAPER, Variable, declare

# group of a version -> its variables
CAPTURES: dict[str, tuple[Variable, ...]] = {
    "samples": (
        declare(
            "reflectance_sample",
            "surfel light camera channel",
            "float16",
            "sr-1",
            (
                "radiance over irradiance facing the light, f_r cos(theta_i); NaN "
                "where invisible, saturated or dark"
            ),
            f"{PAPER}, eq. 3",
        ),
        declare(
            "sample_count",
            "surfel",
            "int32",
            "1",
            "light and camera pairs with a usable sample",
        ),
        declare(
            "saturated_count",
            "surfel",
            "int32",
            "1",
            "visible pairs lost because every exposure was saturated",
        ),
        declare(
            "dark_count",
            "surfel",
            "int32",
            "1",
            "visible pairs lost because every exposure was below the noise floor",
        ),
        declare(
            "single_exposure_count",
            "surfel",
            "int32",
            "1",
            (
                "usable samples of which no pixel has a second exposure, neither white "
                "nor dark, that would confirm it"
            ),
        ),
        declare(
            "noise_floor",
            "",
            "float64",
            "sr-1",
            (
                "reflectance of one standard deviation of read noise and quantisation, "
                "at the median light and distance"
            ),
        ),
        declare(
            "shot_noise",
            "",
            "float64",
            "sr-1",
            "variance by photons over reflectance, at the median light and "
            "distance, where the longest exposure is "
            "not saturated; 0 if electrons are not known",
        ),
        declare(
            "effective_pixels",
            "surfel camera",
            "float16",
            "1",
            (
                "number of equally weighted pixels whose mean is as noisy as a sample; "
                "NaN where there is no sample"
            ),
        ),
        declare(
            "radiance_limit",
            "camera channel exposure",
            "float64",
            "radiance",
            (
                "radiance below the white level in this exposure and in all shorter "
                "ones; from the longest exposure"
            ),
        ),
        declare(
            "radiance_read_variance",
            "camera channel exposure",
            "float64",
            "radiance2",
            (
                "variance by read noise and quantisation of a pixel merged from this "
                "exposure and all shorter ones"
            ),
        ),
        declare(
            "radiance_shot_variance",
            "camera channel exposure",
            "float64",
            "radiance",
            (
                "variance by photons over radiance of a pixel merged from this "
                "exposure and all shorter ones"
            ),
            "Janesick 2007",
        ),
    ),
    "surfels": (
        declare(
            "surfel_position",
            "surfel xyz",
            "float32",
            "mm",
            "position in the subject frame, surfels in Morton order",
        ),
        declare(
            "surfel_normal",
            "surfel xyz",
            "float32",
            "1",
            "unit normal of the scan, outwards",
        ),
        declare(
            "surfel_area",
            "surfel",
            "float32",
            "mm2",
            "a third of the area of the adjacent triangles",
        ),
        declare(
            "soft_light_count",
            "surfel",
            "int32",
            "1",
            "lights whose disc is partly visible from the surfel, at the soft edge of a shadow",
        ),
        declare(
            "surfel_radius",
            "surfel",
            "float32",
            "mm",
            "radius of the disc that covers the gap to the neighbours: 0.7 of the longest edge",
            "Zwicker et al. 2001",
        ),
        declare(
            "surfel_uv",
            "surfel uv",
            "float32",
            "1",
            "texture coordinates, v = 0 at the top row",
            "Desbrun et al. 2002 or Floater 2003, equalised as Yoshizawa et al. 2004",
        ),
        declare(
            "light_visible_fraction",
            "surfel light",
            "float16",
            "1",
            "visible fraction of the light's disc",
        ),
        declare(
            "camera_visible_fraction",
            "surfel camera",
            "float16",
            "1",
            "1 where the camera sees the surfel, 0 elsewhere",
        ),
        declare(
            "region_mask",
            "surfel region",
            "int8",
            "1",
            "1 where the surfel belongs to the named region, else 0",
        ),
    ),
    "mesh": (
        declare(
            "triangle",
            "face corner",
            "int32",
            "1",
            "surfel indices of the subdivided scan's triangles, counter-clockwise from outside",
        ),
        declare(
            "landmark_position",
            "landmark xyz",
            "float32",
            "mm",
            (
                "named points of the face, on the surface of the surfels; NaN where "
                "that part was cropped away"
            ),
        ),
        declare(
            "landmark_surface_distance",
            "landmark",
            "float32",
            "mm",
            "distance of the landmark, as given, from the cleaned scan",
        ),
    ),
    "atlas": (
        declare(
            "atlas_area_log2_sd",
            "region",
            "float64",
            "1",
            "standard deviation over the area of log2 of area in the map over area on the face",
        ),
        declare(
            "atlas_anisotropy_median",
            "region",
            "float64",
            "1",
            "median over the area of the largest over the smallest stretch of the map",
            "Sander et al. 2001",
        ),
        declare(
            "atlas_anisotropy_p99",
            "region",
            "float64",
            "1",
            "99 % quantile over the area of the largest over the smallest stretch of the map",
            "Sander et al. 2001",
        ),
        declare(
            "atlas_flips",
            "region",
            "int32",
            "1",
            "triangles that are turned over in the map, counted exactly: 0",
        ),
    ),
    "dome": (
        declare(
            "light_position", "light xyz", "float32", "mm", "centre of the light's disc"
        ),
        declare(
            "light_axis",
            "light xyz",
            "float32",
            "1",
            "unit direction the light shines along",
        ),
        declare(
            "light_disc_radius", "light", "float32", "mm", "radius of the light's disc"
        ),
        declare(
            "light_falloff",
            "light",
            "float32",
            "1",
            "exponent n of the angular fall-off cos^n; 0 for an isotropic light",
        ),
        declare(
            "light_intensity",
            "light channel",
            "float32",
            "radiance mm2",
            "radiant intensity in the units of the frames' radiance times mm2",
            f"{PAPER}, section 5",
        ),
        declare(
            "camera_position", "camera xyz", "float32", "mm", "centre of projection"
        ),
        declare(
            "camera_matrix",
            "camera row col",
            "float64",
            "pixel",
            "intrinsic matrix K, pixel centres at integer + 0.5",
        ),
        declare(
            "camera_rotation",
            "camera row col",
            "float64",
            "1",
            "R of x_cam = R x + t, OpenCV axes",
        ),
        declare(
            "camera_translation", "camera xyz", "float64", "mm", "t of x_cam = R x + t"
        ),
        declare(
            "camera_distortion",
            "camera coefficient",
            "float64",
            "1",
            "k1 k2 p1 p2 k3 of OpenCV's model",
        ),
        declare("camera_size", "camera axis", "int32", "pixel", "width and height"),
    ),
    "light_calibration": (
        declare(
            "calibrated_intensity",
            "light channel",
            "float64",
            "radiance mm2",
            "radiant intensity along the axis of the light, from the white target",
            f"{PAPER}, section 5",
        ),
        declare(
            "calibrated_intensity_error",
            "light channel",
            "float64",
            "radiance mm2",
            "its standard error by noise",
        ),
        declare(
            "calibrated_intensity_position_error",
            "light",
            "float64",
            "1",
            (
                "relative standard error of the intensity by the position of the light "
                "relative to the target"
            ),
        ),
        declare(
            "glare_fraction",
            "light",
            "float64",
            "1",
            "light beside the white target over that on it, by which glare may "
            "have lowered the intensity; 0 if no "
            "picture shows what is beside the target",
        ),
        declare(
            "calibrated_falloff",
            "light",
            "float64",
            "1",
            "exponent n of the angular fall-off cos^n",
        ),
        declare(
            "calibrated_falloff_error",
            "light",
            "float64",
            "1",
            "its standard error; 0 where it was given",
        ),
        declare(
            "target_used_fraction",
            "light",
            "float64",
            "1",
            "fraction of the usable pixels of the target that agree: neither shadowed nor dirty",
        ),
    ),
    "position_calibration": (
        declare(
            "calibrated_position",
            "light xyz",
            "float64",
            "mm",
            "position of the light, from a mirror ball",
        ),
        declare(
            "calibrated_position_error",
            "light xyz",
            "float64",
            "mm",
            "its standard errors by the scatter of the rays; rough where there are two",
        ),
        declare(
            "position_ray_count",
            "light",
            "int32",
            "1",
            "frames of the ball that show the highlight",
        ),
        declare(
            "position_miss",
            "light",
            "float64",
            "degree",
            "rms angle by which the rays miss the position",
        ),
    ),
    "probe_calibration": (
        declare(
            "calibrated_fibre_centre",
            "fibre axis",
            "float64",
            "pixel",
            "column and row of the face of the fibre",
        ),
        declare(
            "fibre_spot_radius",
            "fibre",
            "float64",
            "pixel",
            "radius of its face in the picture",
        ),
        declare(
            "calibrated_fibre_gain",
            "fibre channel",
            "float64",
            "1",
            "flat field, with the mean of probe.json",
        ),
        declare(
            "calibrated_fibre_gain_error",
            "fibre channel",
            "float64",
            "1",
            "its standard error by the repeated frames",
        ),
    ),
    "camera_calibration": (
        declare(
            "calibrated_response",
            "camera response_level channel",
            "float64",
            "1",
            (
                "relative exposure at values from 0 (black) to 1 (white); NaN in this "
                "group: not photographed"
            ),
            "Debevec and Malik 1997",
        ),
        declare(
            "calibrated_read_noise",
            "camera",
            "float64",
            "electron",
            "read noise",
            "Janesick 2007",
        ),
        declare(
            "calibrated_read_noise_error",
            "camera",
            "float64",
            "electron",
            "its standard error",
        ),
        declare(
            "calibrated_electrons_per_value",
            "camera",
            "float64",
            "electron",
            "electrons per linear value",
        ),
        declare(
            "calibrated_electrons_per_value_error",
            "camera",
            "float64",
            "electron",
            "its standard error",
        ),
        declare(
            "noise_chi_square",
            "camera",
            "float64",
            "1",
            "chi-squared of the noise model per degree of freedom",
        ),
        declare(
            "calibrated_vignette",
            "camera coefficient",
            "float64",
            "1",
            "a2 a4 a6 of 1 + a2 r^2 + a4 r^4 + a6 r^6",
        ),
        declare(
            "calibrated_vignette_error",
            "camera coefficient",
            "float64",
            "1",
            "their standard errors",
        ),
        declare(
            "vignette_residual",
            "camera",
            "float64",
            "1",
            "relative rms deviation of the flat frame from the fit",
        ),
        declare(
            "calibrated_colour_matrix",
            "camera row col",
            "float64",
            "1",
            "from linear values of the camera to linear sRGB under D65",
        ),
        declare(
            "calibrated_colour_matrix_error",
            "camera row col",
            "float64",
            "1",
            "standard errors by the patches",
        ),
        declare(
            "chart_difference",
            "camera",
            "float64",
            "1",
            "median CIEDE2000 between the patches and their reference",
        ),
        declare(
            "edge_blur",
            "camera",
            "float64",
            "pixel",
            "standard deviation of the blur, aperture of a pixel included",
        ),
        declare("edge_blur_error", "camera", "float64", "pixel", "its standard error"),
        declare(
            "veiling_glare",
            "camera",
            "float64",
            "1",
            "fraction of the light that the lens spreads evenly",
        ),
        declare(
            "reprojection_rms",
            "camera",
            "float64",
            "pixel",
            "rms distance of known points from their projections",
        ),
        declare(
            "reprojection_max",
            "camera",
            "float64",
            "pixel",
            "largest of these distances",
        ),
        declare(
            "dark_level",
            "camera channel",
            "float64",
            "value",
            "mean value of dark frames",
        ),
        declare(
            "dark_level_error",
            "camera channel",
            "float64",
            "value",
            "its standard error",
        ),
        declare(
            "defect_pixels",
            "camera",
            "float64",
            "1",
            "pixels that are hot, stuck or unusually noisy",
        ),
    ),
    "calibration": (
        declare(
            "camera_agreement",
            "camera",
            "float32",
            "1",
            (
                "correlation of the roots of what a camera saw and a matt face would "
                "show; NaN if it saw too little"
            ),
        ),
        declare(
            "camera_offset",
            "camera",
            "float32",
            "mm",
            "distance on the face of the photographs from the scan",
        ),
        declare(
            "camera_scale_error",
            "camera",
            "float32",
            "1",
            "how much larger than the scan photographs show the face",
        ),
        declare(
            "light_agreement",
            "light",
            "float32",
            "1",
            "the same correlation under one light, in the best camera",
        ),
        declare(
            "camera_brightness",
            "camera channel",
            "float32",
            "1",
            (
                "brightness of its photographs relative to those of the median camera; "
                "NaN if it saw too little"
            ),
        ),
        declare(
            "light_brightness",
            "light",
            "float32",
            "1",
            (
                "brightness of the photographs under it relative to the median light; "
                "NaN if they show too little"
            ),
        ),
        declare(
            "scan_translation_error",
            "xyz",
            "float32",
            "mm",
            "move of the scan that would bring it to the face",
        ),
        declare(
            "scan_rotation_error",
            "xyz",
            "float32",
            "degree",
            "rotation of the scan that would, about x, y and z",
        ),
        declare(
            "camera_rotation_applied",
            "camera xyz",
            "float32",
            "degree",
            (
                "rotation vector in the camera's frame by which it was turned (ingest "
                "--refine); 0 if it was not"
            ),
        ),
    ),
    "probe": (
        declare(
            "fibre_distance",
            "fibre",
            "float32",
            "mm",
            "distance of the detection fibre from the source fibre",
        ),
        declare(
            "fibre_radius",
            "",
            "float64",
            "mm",
            "radius of the faces of source and fibres; 0 for points",
        ),
        declare(
            "fibre_profile",
            "site fibre channel",
            "float32",
            "mm-2",
            "diffuse reflectance R(r) per area; arbitrary units where gain_known is 0",
            f"{PAPER}, section 8",
        ),
        declare(
            "fibre_profile_error",
            "site fibre channel",
            "float32",
            "mm-2",
            "standard error of fibre_profile",
        ),
        declare(
            "gain_known",
            "",
            "int8",
            "1",
            "1 where fibre_profile is in mm-2, 0 where it is known up to a factor",
        ),
        declare(
            "site_position",
            "site xyz",
            "float32",
            "mm",
            "where the probe touched, from regions and landmarks; NaN if unknown",
        ),
        declare(
            "site_pressure",
            "site",
            "float64",
            "kPa",
            "pressure of the suction gauge, mean over time and placements; NaN if unknown",
        ),
        declare(
            "site_placements",
            "site",
            "int32",
            "1",
            "how many times the probe was placed at the site",
        ),
        declare(
            "site_repeatability",
            "site channel",
            "float64",
            "1",
            (
                "relative standard deviation of profiles between placements, noise "
                "taken out; NaN of a single placement"
            ),
        ),
        declare(
            "site_isotropy_p_value",
            "site channel",
            "float64",
            "1",
            (
                "p value of equal decay of light along all azimuths of the fibres; NaN "
                "where profiles are too noisy"
            ),
            f"{PAPER}, figure 10",
        ),
        declare(
            "placement_profile",
            "site placement fibre channel",
            "float32",
            "mm-2",
            (
                "profile of each placement of the probe, in the units of "
                "fibre_profile; NaN where there are fewer"
            ),
        ),
        declare(
            "fibre_azimuth",
            "fibre",
            "float64",
            "degree",
            (
                "direction of the detection fibre from the source fibre, in the plane "
                "of the skin; NaN if unknown"
            ),
        ),
        declare(
            "pressure_time",
            "site placement pressure_sample",
            "float64",
            "s",
            "time of a reading of the gauge since the probe touched; NaN where there are fewer",
        ),
        declare(
            "pressure",
            "site placement pressure_sample",
            "float64",
            "kPa",
            "reading of the suction gauge",
        ),
    ),
    "sequence": (
        declare(
            "step_light",
            "step",
            "int32",
            "1",
            "index of the light of each step of the dome",
        ),
        declare(
            "step_exposure", "step", "int32", "1", "index of the exposure of each step"
        ),
        declare(
            "step_on",
            "step",
            "float64",
            "s",
            "when the light went on, since the first one did",
        ),
        declare("step_off", "step", "float64", "s", "when the light went off"),
        declare(
            "step_trigger_count",
            "step",
            "int32",
            "1",
            "trigger pulses that the cameras were sent in the step",
        ),
    ),
    "photographs": (
        declare(
            "photograph_radiance",
            "photograph image_row image_col channel",
            "float32",
            "radiance",
            (
                "merged radiance of one photograph as taken (distorted), in the "
                "capture's own unit; NaN where saturated"
            ),
        ),
        declare(
            "photograph_light",
            "photograph",
            "int32",
            "1",
            "index of the photograph's light",
        ),
        declare(
            "photograph_camera",
            "photograph",
            "int32",
            "1",
            "index of the photograph's camera",
        ),
    ),
}
