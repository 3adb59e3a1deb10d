"""Error against run time of every kernel of the fit, and the stress set; `skindb bench` runs both."""

KERNELS = (  # those with curves; the stress set has the same names
    "surface",
    "refit",
    "normals",
    "albedo",
    "nmf",
    "probe",
    "transport",
    "inverse",
    "subsurface",
    "disc",
    "exposures",
)
