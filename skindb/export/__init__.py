"""Export of models for other programs: texture maps, measured BRDFs, glTF, USD and Mitsuba 3."""

from skindb.export.bundle import export_bundle
from skindb.export.gltf import export_gltf
from skindb.export.maps import texture_maps

__all__ = ["export_bundle", "export_gltf", "texture_maps"]
