"""Studies of a population of models: basis size, translucency, albedo, traits, edits,
and the common (u, v).
"""

import lazy_loader

# the names are listed in __init__.pyi (SPEC 1): a fit uses its summaries and no study
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
