"""All operations by the names of their commands: whoever looks one up imports them from here."""

from slviewer.pipeline import align, merge, reconstruct, verify  # each registers its own
from slviewer.pipeline.operation import OPERATIONS

__all__ = ["OPERATIONS", "align", "merge", "reconstruct", "verify"]
