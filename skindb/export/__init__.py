"""Models for other programs: bundles of maps and tables, and glTF."""
