"""Every stored variable, declared once: name, dims, dtype, units, one sentence, source."""

from skindb.schema.declaration import (
    IDENTIFIED,
    Explained,
    FitStatus,
    ProbeStatus,
    TexelStatus,
    Use,
    Variable,
    flag_attrs,
    names_of,
)
from skindb.schema.label import check, dataset, fitted_of, label, text_labels
from skindb.schema.notes import note_lines
from skindb.schema.variables import GROUPS, SCHEMA_VERSION, VARIABLES

__all__ = [
    "GROUPS",
    "IDENTIFIED",
    "SCHEMA_VERSION",
    "VARIABLES",
    "Explained",
    "FitStatus",
    "ProbeStatus",
    "TexelStatus",
    "Use",
    "Variable",
    "check",
    "dataset",
    "fitted_of",
    "flag_attrs",
    "label",
    "names_of",
    "note_lines",
    "text_labels",
]
