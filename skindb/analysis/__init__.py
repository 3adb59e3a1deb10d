"""What a population of models says: basis size, translucency, albedo, traits, edits."""

from skindb.analysis.albedo import albedo_histograms, albedo_table, plot_albedo
from skindb.analysis.basis_size import basis_size_curve, plot_basis_size
from skindb.analysis.edit import apply_traits
from skindb.analysis.population_basis import population_basis
from skindb.analysis.traits import plot_traits, trait_vectors
from skindb.analysis.translucency import plot_translucency, translucency_table

__all__ = [
    "albedo_histograms",
    "albedo_table",
    "apply_traits",
    "basis_size_curve",
    "plot_albedo",
    "plot_basis_size",
    "plot_traits",
    "plot_translucency",
    "population_basis",
    "trait_vectors",
    "translucency_table",
]
