"""Names of the kernels that have curves of error against CPU time; the stress set uses
the same names.
"""

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
