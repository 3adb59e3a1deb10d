"""Models for other programs: maps, measured BRDFs, glTF."""

from skindb.export.bundle import export_bundle
from skindb.export.gltf import export_gltf
from skindb.export.maps import texture_maps

__all__ = ["export_bundle", "export_gltf", "texture_maps"]
