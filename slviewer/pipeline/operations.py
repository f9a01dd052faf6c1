"""All operations by the names of their commands: whoever looks one up imports them from here."""

from slviewer.pipeline import align, check, merge, reconstruct, verify  # each registers its own
from slviewer.pipeline.operation import OPERATIONS

__all__ = ["OPERATIONS", "align", "check", "merge", "reconstruct", "verify"]
