from .figures import field_figure
from .photographs import (
    compare_images,
    compare_photographs,
    write_comparisons,
)
from .rendering import render, render_picture
from .scene import Camera, Environment, Lights
from .surfels import evaluate, evaluate_error

__all__ = [
    "Camera",
    "Environment",
    "Lights",
    "compare_images",
    "compare_photographs",
    "evaluate",
    "evaluate_error",
    "field_figure",
    "render",
    "render_picture",
    "write_comparisons",
]
