"""Variables of a version of kind "capture": samples, surface, dome, probe, photographs."""

from skindb.schema.declaration import PAPER, Use, declare

# samples
REFLECTANCE_SAMPLE = declare(
    "float16 samples/reflectance_sample(surfel, light, camera, channel) [sr-1]",
    "radiance over irradiance facing the light, f_r cos(theta_i); NaN where invisible, "
    "saturated or dark",
    f"{PAPER}, eq. 3",
)
SAMPLE_COUNT = declare(
    "int32 samples/sample_count(surfel) [1]",
    "light and camera pairs with a usable sample",
)
SATURATED_COUNT = declare(
    "int32 samples/saturated_count(surfel) [1]",
    "visible pairs lost because every exposure was saturated",
)
DARK_COUNT = declare(
    "int32 samples/dark_count(surfel) [1]",
    "visible pairs lost because every exposure was below the noise floor",
)
NOISE_FLOOR = declare(
    "float64 samples/noise_floor() [sr-1]",
    "reflectance of one standard deviation of read noise and quantisation, at the "
    "median light and distance",
)
EFFECTIVE_PIXELS = declare(
    "float16 samples/effective_pixels(surfel, camera) [1]",
    "number of equally weighted pixels whose mean is as noisy as a sample; NaN where "
    "there is no sample",
)
RADIANCE_LIMIT = declare(
    "float64 samples/radiance_limit(camera, channel, exposure) [radiance]",
    "radiance below the white level in this exposure and in all shorter ones; from the "
    "longest exposure",
)
RADIANCE_READ_VARIANCE = declare(
    "float64 samples/radiance_read_variance(camera, channel, exposure) [radiance2]",
    "variance by read noise and quantisation of a pixel merged from this exposure and "
    "all shorter ones",
)
RADIANCE_SHOT_VARIANCE = declare(
    "float64 samples/radiance_shot_variance(camera, channel, exposure) [radiance]",
    "variance by photons over radiance of a pixel merged from this exposure and all "
    "shorter ones",
    "Janesick 2007",
)

# surfels
SURFEL_POSITION = declare(
    "float32 surfels/surfel_position(surfel, xyz) [mm]",
    "position in the subject frame, surfels in Morton order",
    uses=Use.COPIED | Use.SAMPLED | Use.MAPPED | Use.SURVIVES_EDIT,
)
SURFEL_NORMAL = declare(
    "float32 surfels/surfel_normal(surfel, xyz) [1]",
    "unit normal of the scan, outwards",
    uses=Use.COPIED | Use.SURVIVES_EDIT,
)
SCAN_NORMAL_ERROR = declare(
    "float64 surfels/scan_normal_error() [degree]",
    "RMS angle of the scan's normals to the true ones, the prior of the normals; 3 where "
    "it is absent, 60 or more without a scan",
    uses=Use.COPIED | Use.SURVIVES_EDIT,
)
SURFEL_AREA = declare(
    "float32 surfels/surfel_area(surfel) [mm2]",
    "a third of the area of the adjacent triangles",
    uses=Use.COPIED | Use.SAMPLED | Use.SURVIVES_EDIT,
)
SURFEL_UV = declare(
    "float32 surfels/surfel_uv(surfel, uv) [1]",
    "texture coordinates, v = 0 at the top row",
    "Floater 2003, equalised as Yoshizawa et al. 2004",
    Use.COPIED | Use.SAMPLED | Use.SURVIVES_EDIT,
)
LIGHT_VISIBLE_FRACTION = declare(
    "float16 surfels/light_visible_fraction(surfel, light) [1]",
    "visible fraction of the light's disc",
)
CAMERA_VISIBLE_FRACTION = declare(
    "float16 surfels/camera_visible_fraction(surfel, camera) [1]",
    "1 where the camera sees the surfel, 0 elsewhere",
)
REGION_MASK = declare(
    "int8 surfels/region_mask(surfel, region) [1]",
    "1 where the surfel belongs to the named region, else 0",
    uses=Use.COPIED | Use.SAMPLED | Use.SURVIVES_EDIT,
    absent=-1,
)
LOBE_STRENGTH_APPLIED = declare(
    "float32 surfels/lobe_strength_applied(surfel, lobe) [1]",
    "strengths, by a calibration from takes, of the lobes of graded widths that surfels with "
    "few samples may share, blended between regions; unknown if absent",
)

# mesh
TRIANGLE = declare(
    "int32 mesh/triangle(face, corner) [1]",
    "surfel indices of the subdivided scan's triangles, counter-clockwise from outside",
)
LANDMARK_POSITION = declare(
    "float32 mesh/landmark_position(landmark, xyz) [mm]",
    "named points of the face, on the surface of the surfels; NaN where that part was "
    "cropped away",
)
LANDMARK_SURFACE_DISTANCE = declare(
    "float32 mesh/landmark_surface_distance(landmark) [mm]",
    "distance of the landmark, as given, from the cleaned scan",
)

# atlas
ATLAS_AREA_LOG2_SD = declare(
    "float64 atlas/atlas_area_log2_sd(region) [1]",
    "standard deviation over the area of log2 of area in the map over area on the face",
)
ATLAS_ANISOTROPY_MEDIAN = declare(
    "float64 atlas/atlas_anisotropy_median(region) [1]",
    "median over the area of the largest over the smallest stretch of the map",
    "Sander et al. 2001",
)
ATLAS_ANISOTROPY_P99 = declare(
    "float64 atlas/atlas_anisotropy_p99(region) [1]",
    "99 % quantile over the area of the largest over the smallest stretch of the map",
    "Sander et al. 2001",
)
ATLAS_FLIPS = declare(
    "int32 atlas/atlas_flips(region) [1]",
    "triangles that are turned over in the map, counted exactly: 0",
)

# detail
DIFFUSE_DETAIL = declare(
    "float16 detail/diffuse_detail(v, u, channel) [1]",
    "R_d of a texel of the atlas over that interpolated between the surfels, minus 1; 0 "
    "where it is not known; only where the photographs are finer than the surfels",
)
DIFFUSE_DETAIL_ERROR = declare(
    "float16 detail/diffuse_detail_error(v, u, channel) [1]",
    "standard error of diffuse_detail; NaN where it is not known",
)
NORMAL_DETAIL = declare(
    "float16 detail/normal_detail(v, u, xyz) [1]",
    "unit normal of a texel minus that interpolated between the surfels; 0 where it is not "
    "known",
)
NORMAL_DETAIL_ERROR = declare(
    "float16 detail/normal_detail_error(v, u, xyz) [1]",
    "standard error of normal_detail; NaN where it is not known",
)

# dome
LIGHT_POSITION = declare(
    "float32 dome/light_position(light, xyz) [mm]",
    "centre of the light's disc",
)
LIGHT_AXIS = declare(
    "float32 dome/light_axis(light, xyz) [1]",
    "unit direction the light shines along",
)
LIGHT_DISC_RADIUS = declare(
    "float32 dome/light_disc_radius(light) [mm]",
    "radius of the light's disc",
)
LIGHT_FALLOFF = declare(
    "float32 dome/light_falloff(light) [1]",
    "exponent n of the angular fall-off cos^n; 0 for an isotropic light",
)
LIGHT_INTENSITY = declare(
    "float32 dome/light_intensity(light, channel) [radiance mm2]",
    "radiant intensity in the units of the frames' radiance times mm2",
    f"{PAPER}, section 5",
)
LIGHT_GAIN_APPLIED = declare(
    "float64 dome/light_gain_applied(light) [1]",
    "gain by a calibration from takes, by which the intensity was multiplied; 1 if absent",
)
LIGHT_OFFSET_APPLIED = declare(
    "float64 dome/light_offset_applied(light, xyz) [mm]",
    "offset by a calibration from takes, which was added to the position; 0 if absent",
)
CAMERA_GAIN_APPLIED = declare(
    "float64 dome/camera_gain_applied(camera, channel) [1]",
    "gain by a calibration from takes, by which the radiance was divided; 1 if absent",
)
LIGHT_POLARISATION = declare(
    "float32 dome/light_polarisation(light) [1]",
    "degree of circular polarisation, 1 right-handed, -1 left-handed, 0 without "
    "polariser; in domes with polarisers alone",
    "Ghosh et al. 2011",
)
CAMERA_POLARISATION = declare(
    "float32 dome/camera_polarisation(camera) [1]",
    "the same of the light that a camera sees; handedness is that along the path of the "
    "light",
    "Ghosh et al. 2011",
)
RELATIVE_REFLECTANCE = declare(
    "int8 dome/relative_reflectance() [1]",
    "1 where neither a white target nor intensities are known: reflectance is relative to "
    "an unknown factor per channel; 0 if absent",
)
CAMERA_POSITION = declare(
    "float32 dome/camera_position(camera, xyz) [mm]",
    "centre of projection",
)
CAMERA_MATRIX = declare(
    "float64 dome/camera_matrix(camera, row, col) [pixel]",
    "intrinsic matrix K, pixel centres at integer + 0.5",
)
CAMERA_ROTATION = declare(
    "float64 dome/camera_rotation(camera, row, col) [1]",
    "R of x_cam = R x + t, OpenCV axes",
)
CAMERA_TRANSLATION = declare(
    "float64 dome/camera_translation(camera, xyz) [mm]",
    "t of x_cam = R x + t",
)
CAMERA_DISTORTION = declare(
    "float64 dome/camera_distortion(camera, coefficient) [1]",
    "k1 k2 p1 p2 k3 of OpenCV's model",
)
CAMERA_SIZE = declare(
    "int32 dome/camera_size(camera, axis) [pixel]",
    "width and height",
)

# light_calibration
CALIBRATED_INTENSITY = declare(
    "float64 light_calibration/calibrated_intensity(light, channel) [radiance mm2]",
    "radiant intensity along the axis of the light, from the white target",
    f"{PAPER}, section 5",
)
CALIBRATED_INTENSITY_ERROR = declare(
    "float64 light_calibration/calibrated_intensity_error(light, channel) [radiance mm2]",
    "its standard error by noise",
)
CALIBRATED_INTENSITY_POSITION_ERROR = declare(
    "float64 light_calibration/calibrated_intensity_position_error(light) [1]",
    "relative standard error of the intensity by the position of the light relative to "
    "the target",
)
GLARE_FRACTION = declare(
    "float64 light_calibration/glare_fraction(light) [1]",
    "light beside the white target over that on it, by which glare may have lowered the "
    "intensity; 0 if no picture shows what is beside the target",
)
CALIBRATED_FALLOFF = declare(
    "float64 light_calibration/calibrated_falloff(light) [1]",
    "exponent n of the angular fall-off cos^n, as stated in the set-up",
)
TARGET_USED_FRACTION = declare(
    "float64 light_calibration/target_used_fraction(light) [1]",
    "fraction of the usable pixels of the target that agree: neither shadowed nor dirty",
)

# position_calibration
CALIBRATED_POSITION = declare(
    "float64 position_calibration/calibrated_position(light, xyz) [mm]",
    "position of the light, from a mirror ball",
)
CALIBRATED_POSITION_ERROR = declare(
    "float64 position_calibration/calibrated_position_error(light, xyz) [mm]",
    "its standard errors by the scatter of the rays; rough where there are two",
)
POSITION_RAY_COUNT = declare(
    "int32 position_calibration/position_ray_count(light) [1]",
    "frames of the ball that show the highlight",
)
POSITION_MISS = declare(
    "float64 position_calibration/position_miss(light) [degree]",
    "rms angle by which the rays miss the position",
)

# rig_calibration
RIG_LIGHT_POSITION = declare(
    "float64 rig_calibration/rig_light_position(light, xyz) [mm]",
    "position of the light in the takes",
)
RIG_LIGHT_GAIN = declare(
    "float64 rig_calibration/rig_light_gain(light) [1]",
    "true over stated intensity, median over the takes; 1 for lights of fewer than "
    "three takes, or if they do not differ by more than the errors of the estimate",
)
RIG_LIGHT_GAIN_ERROR = declare(
    "float64 rig_calibration/rig_light_gain_error(light) [1]",
    "its standard error by the scatter of the takes; NaN where the gain was not estimated",
)
RIG_LIGHT_OFFSET = declare(
    "float64 rig_calibration/rig_light_offset(light, xyz) [mm]",
    "true minus stated position across the direction to the light, median over the "
    "takes; those applied, or else 0, if those of other takes do not predict a take",
)
RIG_LIGHT_ANGLE_ERROR = declare(
    "float64 rig_calibration/rig_light_angle_error(light) [degree]",
    "standard error of the direction by the scatter of the takes; NaN without an offset",
)
RIG_TAKES = declare(
    "int32 rig_calibration/rig_takes(light) [1]",
    "takes in which the light could be estimated",
)
RIG_SPREAD = declare(
    "float64 rig_calibration/rig_spread() [1]",
    "standard deviation over the lights of the logarithms of the gains of a take, without "
    "what is linear over the dome; median of the takes",
)
RIG_SPREAD_LEFT = declare(
    "float64 rig_calibration/rig_spread_left() [1]",
    "the same after division by the common gains of the other takes",
)
RIG_CAMERA_GAIN = declare(
    "float64 rig_calibration/rig_camera_gain(camera, channel) [1]",
    "true over stated sensitivity relative to the median camera, median over the takes; 1 "
    "for cameras of fewer than three takes, or if those of other takes do not predict a "
    "take",
)
RIG_CAMERA_GAIN_ERROR = declare(
    "float64 rig_calibration/rig_camera_gain_error(camera, channel) [1]",
    "its standard error by the scatter of the takes; NaN where the gain was not estimated",
)
RIG_CAMERA_SPREAD = declare(
    "float64 rig_calibration/rig_camera_spread() [1]",
    "standard deviation over cameras and channels of the logarithms of the gains of a "
    "take; median of the takes, NaN for one camera",
)
RIG_CAMERA_SPREAD_LEFT = declare(
    "float64 rig_calibration/rig_camera_spread_left() [1]",
    "the same after division by the common gains of the other takes",
)
RIG_LOBE_STRENGTH = declare(
    "float64 rig_calibration/rig_lobe_strength(region, lobe) [1]",
    "strengths of the lobes of graded widths that the takes have in common, of the face and of "
    "its regions, for surfels with few samples; NaN for fewer than three takes with many",
)
RIG_MISFIT = declare(
    "float64 rig_calibration/rig_misfit(correction) [1]",
    "rms residual of a held-out take with the gains, and the gains and offsets, of the "
    "other takes, over that without; median of the takes",
)

# probe_calibration
CALIBRATED_FIBRE_CENTRE = declare(
    "float64 probe_calibration/calibrated_fibre_centre(fibre, axis) [pixel]",
    "column and row of the face of the fibre",
)
FIBRE_SPOT_RADIUS = declare(
    "float64 probe_calibration/fibre_spot_radius(fibre) [pixel]",
    "radius of its face in the picture",
)
CALIBRATED_FIBRE_GAIN = declare(
    "float64 probe_calibration/calibrated_fibre_gain(fibre, channel) [1]",
    "flat field, with the mean of probe.json",
)
CALIBRATED_FIBRE_GAIN_ERROR = declare(
    "float64 probe_calibration/calibrated_fibre_gain_error(fibre, channel) [1]",
    "its standard error by the repeated frames",
)

# camera_calibration
CALIBRATED_RESPONSE = declare(
    "float64 camera_calibration/calibrated_response(camera, response_level, channel) [1]",
    "relative exposure at values from 0 (black) to 1 (white); NaN in this group: not "
    "photographed",
    "Debevec and Malik 1997",
)
CALIBRATED_READ_NOISE = declare(
    "float64 camera_calibration/calibrated_read_noise(camera) [electron]",
    "read noise",
    "Janesick 2007",
)
CALIBRATED_READ_NOISE_ERROR = declare(
    "float64 camera_calibration/calibrated_read_noise_error(camera) [electron]",
    "its standard error",
)
CALIBRATED_ELECTRONS_PER_VALUE = declare(
    "float64 camera_calibration/calibrated_electrons_per_value(camera) [electron]",
    "electrons per linear value",
)
CALIBRATED_ELECTRONS_PER_VALUE_ERROR = declare(
    "float64 camera_calibration/calibrated_electrons_per_value_error(camera) [electron]",
    "its standard error",
)
NOISE_CHI_SQUARE = declare(
    "float64 camera_calibration/noise_chi_square(camera) [1]",
    "chi-squared of the noise model per degree of freedom",
)
CALIBRATED_VIGNETTE = declare(
    "float64 camera_calibration/calibrated_vignette(camera, coefficient) [1]",
    "a2 a4 a6 of 1 + a2 r^2 + a4 r^4 + a6 r^6",
)
CALIBRATED_VIGNETTE_ERROR = declare(
    "float64 camera_calibration/calibrated_vignette_error(camera, coefficient) [1]",
    "their standard errors",
)
VIGNETTE_RESIDUAL = declare(
    "float64 camera_calibration/vignette_residual(camera) [1]",
    "relative rms deviation of the flat frame from the fit",
)
CALIBRATED_COLOUR_MATRIX = declare(
    "float64 camera_calibration/calibrated_colour_matrix(camera, row, col) [1]",
    "from linear values of the camera to linear sRGB under D65",
)
CALIBRATED_COLOUR_MATRIX_ERROR = declare(
    "float64 camera_calibration/calibrated_colour_matrix_error(camera, row, col) [1]",
    "standard errors by the patches",
)
CHART_DIFFERENCE = declare(
    "float64 camera_calibration/chart_difference(camera) [1]",
    "median CIEDE2000 between the patches and their reference",
)
REPROJECTION_RMS = declare(
    "float64 camera_calibration/reprojection_rms(camera) [pixel]",
    "rms distance of known points from their projections",
)
DEFECT_PIXELS = declare(
    "float64 camera_calibration/defect_pixels(camera) [1]",
    "pixels that are hot, stuck or unusually noisy",
)

# calibration
CAMERA_AGREEMENT = declare(
    "float32 calibration/camera_agreement(camera) [1]",
    "correlation of the roots of what a camera saw and a matt face would show; NaN if "
    "it saw too little",
)
CAMERA_OFFSET = declare(
    "float32 calibration/camera_offset(camera) [mm]",
    "distance on the face of the photographs from the scan",
)
CAMERA_SCALE_ERROR = declare(
    "float32 calibration/camera_scale_error(camera) [1]",
    "how much larger than the scan photographs show the face",
)
LIGHT_AGREEMENT = declare(
    "float32 calibration/light_agreement(light) [1]",
    "the same correlation under one light, in the best camera",
)
CAMERA_BRIGHTNESS = declare(
    "float32 calibration/camera_brightness(camera, channel) [1]",
    "brightness of its photographs relative to those of the median camera; NaN if it "
    "saw too little",
)
LIGHT_BRIGHTNESS = declare(
    "float32 calibration/light_brightness(light) [1]",
    "brightness of the photographs under it relative to the median light; NaN if they "
    "show too little",
)
SCAN_TRANSLATION_ERROR = declare(
    "float32 calibration/scan_translation_error(xyz) [mm]",
    "move of the scan that would bring it to the face",
)
SCAN_ROTATION_ERROR = declare(
    "float32 calibration/scan_rotation_error(xyz) [degree]",
    "rotation of the scan that would, about x, y and z",
)
CAMERA_ROTATION_APPLIED = declare(
    "float32 calibration/camera_rotation_applied(camera, xyz) [degree]",
    "rotation vector in the camera's frame by which it was turned (ingest --refine); 0 "
    "if it was not",
)

# probe
FIBRE_DISTANCE = declare(
    "float32 probe/fibre_distance(fibre) [mm]",
    "distance of the detection fibre from the source fibre",
)
FIBRE_RADIUS = declare(
    "float64 probe/fibre_radius() [mm]",
    "radius of the faces of source and fibres; 0 for points",
)
FIBRE_PROFILE = declare(
    "float32 probe/fibre_profile(site, fibre, channel) [mm-2]",
    "diffuse reflectance R(r) per area; arbitrary units where gain_known is 0",
    f"{PAPER}, section 8",
)
FIBRE_PROFILE_ERROR = declare(
    "float32 probe/fibre_profile_error(site, fibre, channel) [mm-2]",
    "standard error of fibre_profile",
)
GAIN_KNOWN = declare(
    "int8 probe/gain_known() [1]",
    "1 where fibre_profile is in mm-2, 0 where it is known up to a factor",
)
SITE_POSITION = declare(
    "float32 probe/site_position(site, xyz) [mm]",
    "where the probe touched, from regions and landmarks; NaN if unknown",
    uses=Use.SURVIVES_EDIT,
)
SITE_PRESSURE = declare(
    "float64 probe/site_pressure(site) [kPa]",
    "pressure of the suction gauge, mean over time and placements; NaN if unknown",
)
SITE_PLACEMENTS = declare(
    "int32 probe/site_placements(site) [1]",
    "how many times the probe was placed at the site",
)
SITE_REPEATABILITY = declare(
    "float64 probe/site_repeatability(site, channel) [1]",
    "relative standard deviation of profiles between placements, noise taken out; NaN "
    "of a single placement",
)
SITE_ISOTROPY_P_VALUE = declare(
    "float64 probe/site_isotropy_p_value(site, channel) [1]",
    "p value of equal decay of light along all azimuths of the fibres; NaN where "
    "profiles are too noisy",
    f"{PAPER}, figure 10",
)
FIBRE_AZIMUTH = declare(
    "float64 probe/fibre_azimuth(fibre) [degree]",
    "direction of the detection fibre from the source fibre, in the plane of the skin; "
    "NaN if unknown",
)

# sequence
STEP_LIGHT = declare(
    "int32 sequence/step_light(step) [1]",
    "index of the light of each step of the dome",
)
STEP_EXPOSURE = declare(
    "int32 sequence/step_exposure(step) [1]",
    "index of the exposure of each step",
)
STEP_ON = declare(
    "float64 sequence/step_on(step) [s]",
    "when the light went on, since the first one did",
)
STEP_OFF = declare(
    "float64 sequence/step_off(step) [s]",
    "when the light went off",
)
STEP_TRIGGER_COUNT = declare(
    "int32 sequence/step_trigger_count(step) [1]",
    "trigger pulses that the cameras were sent in the step",
)

# photographs
PHOTOGRAPH_RADIANCE = declare(
    "float32 photographs/photograph_radiance(photograph, image_row, image_col, channel) [radiance]",
    "merged radiance of one photograph as taken (distorted), in the capture's own unit; "
    "NaN where saturated",
)
PHOTOGRAPH_LIGHT = declare(
    "int32 photographs/photograph_light(photograph) [1]",
    "index of the photograph's light",
)
PHOTOGRAPH_CAMERA = declare(
    "int32 photographs/photograph_camera(photograph) [1]",
    "index of the photograph's camera",
)
