"""All kinds of records: whoever looks one up imports this; each registers its own."""

from slviewer.entry_points import OPERATION_PLUGINS
from slviewer.records import (  # noqa: F401, each registers its own
    acceptance,
    calibration,
    inspection,
    measurement,
    merge,
    verification,
)
from slviewer.records.record import RECORDS, Record


def all_kinds() -> dict[str, type[Record]]:
    """Return all kinds by name, with those of other packages, whose operations are imported."""
    _ = OPERATION_PLUGINS.plugins
    return RECORDS
