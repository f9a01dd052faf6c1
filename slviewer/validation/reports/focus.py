"""A rig that changed after its calibration."""

from slviewer.validation.reports.case import Case

CASES: dict[str, Case] = {}
