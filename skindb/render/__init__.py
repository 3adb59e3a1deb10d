"""Rendering of fitted models, comparison with photographs, and the BRDF of a surfel."""

import lazy_loader

# the names are listed in __init__.pyi (SPEC 1): a fit uses the texels and no picture
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
