"""CAD models as other programs write them."""

from slviewer.validation.reports.case import Case

CASES: dict[str, Case] = {}
