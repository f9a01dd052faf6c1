"""All operations by the names of their commands: whoever looks one up imports them from here."""

from slviewer.pipeline import (  # noqa: F401 (each registers its own)
    accept,
    calibrate,
    compare,
    inspect_parts,
    measure,
    merge,
    reconstruct,
)
from slviewer.pipeline.operation import OPERATIONS as OPERATIONS
