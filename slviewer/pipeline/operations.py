"""All operations by the names of their commands: whoever looks one up imports them from here."""

from slviewer import pipeline
from slviewer.entry_points import OPERATION_PLUGINS, import_modules
from slviewer.pipeline.operation import OPERATIONS as OPERATIONS

import_modules(pipeline, "\n@operation(")
_ = OPERATION_PLUGINS.plugins
