"""Rendering of fitted models, comparison with photographs, and the BRDF of a surfel."""

from skindb.render.figures import field_figure
from skindb.render.photographs import (
    compare_images,
    compare_photographs,
    write_comparisons,
)
from skindb.render.rendering import render, render_picture
from skindb.render.scene import Camera, Environment, Lights
from skindb.render.surfels import evaluate
from skindb.schema.notes import NOTHING

__all__ = [
    "NOTHING",
    "Camera",
    "Environment",
    "Lights",
    "compare_images",
    "compare_photographs",
    "evaluate",
    "field_figure",
    "render",
    "render_picture",
    "write_comparisons",
]
