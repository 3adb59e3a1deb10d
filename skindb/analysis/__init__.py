"""What a population of models says: basis size, translucency, albedo, traits, edits; one (u, v) for all."""

from skindb.analysis.albedo import albedo_histograms, albedo_table, plot_albedo
from skindb.analysis.basis_size import basis_size_curve, plot_basis_size
from skindb.analysis.edit import apply_traits
from skindb.analysis.masks import mask_agreement, region_masks, take_masks
from skindb.analysis.population_basis import population_basis
from skindb.analysis.registration import correspondence_error, corresponding_points, register
from skindb.analysis.traits import plot_traits, trait_vectors
from skindb.analysis.translucency import plot_translucency, translucency_table

__all__ = [
    "albedo_histograms",
    "albedo_table",
    "apply_traits",
    "basis_size_curve",
    "correspondence_error",
    "corresponding_points",
    "mask_agreement",
    "plot_albedo",
    "plot_basis_size",
    "plot_traits",
    "plot_translucency",
    "population_basis",
    "region_masks",
    "register",
    "take_masks",
    "trait_vectors",
    "translucency_table",
]
