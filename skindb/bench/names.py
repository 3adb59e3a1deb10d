"""Names of the kernels that have curves of error against run time; the stress set has the same names."""

KERNELS = (
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
    "pyramid",
    "textures",
    "components",
    "permutations",
)
