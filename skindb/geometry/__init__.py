"""Geometry as numbers: meshes, rays, cameras and texture maps."""
