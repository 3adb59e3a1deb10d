"""Work on the takes of a database: read versions, call the scientific packages, commit
what they return.
"""

from typing import Any

import lazy_loader

# the names are listed in __init__.pyi (SPEC 1); each step needs other large packages, and
# a command imports what it uses
_attribute, _, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """A step, or the function of one study: `translucency` is `study` with this name."""
    try:
        return _attribute(name)
    except AttributeError:
        if name.startswith("_") or name not in _attribute("STUDY_FUNCTIONS"):
            raise
        return _attribute("STUDY_FUNCTIONS")[name]


def __dir__() -> list[str]:
    """The steps, and the functions of the studies."""
    return sorted([*__all__, *_attribute("STUDY_FUNCTIONS")])
