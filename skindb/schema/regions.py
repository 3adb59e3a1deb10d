"""Names of regions that every take has."""

FACE = "face"  # every surfel of a take
