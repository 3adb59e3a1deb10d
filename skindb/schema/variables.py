"""The one list of stored variables."""

from __future__ import annotations

from skindb.schema.captures import CAPTURES
from skindb.schema.declaration import Variable
from skindb.schema.models import MODELS
from skindb.schema.studies import STUDIES

SCHEMA_VERSION = 2

# group of a version -> its variables
GROUPS: dict[str, tuple[Variable, ...]] = CAPTURES | MODELS | STUDIES
VARIABLES: dict[str, Variable] = {
    variable.name: variable for group in GROUPS.values() for variable in group
}
