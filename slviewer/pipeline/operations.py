"""All operations by the names of their commands: whoever looks one up imports them from here."""

from slviewer.pipeline import (  # each registers its own
    accept,
    align,
    calibrate,
    check,
    compare,
    measure,
    merge,
    reconstruct,
    relate,
    run_plan,
    validate,
    verify,
)
from slviewer.pipeline.operation import OPERATIONS

__all__ = [
    "OPERATIONS",
    "accept",
    "align",
    "calibrate",
    "check",
    "compare",
    "measure",
    "merge",
    "reconstruct",
    "relate",
    "run_plan",
    "validate",
    "verify",
]
