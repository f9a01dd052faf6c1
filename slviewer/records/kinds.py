"""All kinds of records: whoever looks one up imports this; each registers its own."""

from slviewer import records
from slviewer.entry_points import OPERATION_PLUGINS, import_modules
from slviewer.records.record import RECORDS, Record

import_modules(records)


def all_kinds() -> dict[str, type[Record]]:
    """Return all kinds by name, with those of other packages, whose operations are imported."""
    _ = OPERATION_PLUGINS.others
    return RECORDS
