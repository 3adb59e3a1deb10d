"""The names of all stored variables as constants, and their declarations.

Code refers to a stored variable as ``variables.DIFFUSE_REFLECTANCE``.
"""

from skindb.schema.captures import *  # noqa: F403
from skindb.schema.declaration import DECLARED, Variable
from skindb.schema.models import *  # noqa: F403
from skindb.schema.studies import *  # noqa: F403

SCHEMA_VERSION = 2

VARIABLES: dict[str, Variable] = DECLARED
# group of a version -> its variables
GROUPS: dict[str, tuple[Variable, ...]] = {
    group: tuple(declared for declared in VARIABLES.values() if declared.group == group)
    for group in dict.fromkeys(declared.group for declared in VARIABLES.values())
}
