"""All operations by the names of their commands: whoever looks one up imports them from here."""

from slviewer.pipeline import (
    accept,
    align,
    check,
    merge,
    reconstruct,
    run_plan,
    verify,
)  # each registers its own
from slviewer.pipeline.operation import OPERATIONS

__all__ = ["OPERATIONS", "accept", "align", "check", "merge", "reconstruct", "run_plan", "verify"]
