"""Calibrations that begin from a known lens."""

from slviewer.validation.reports.case import Case

CASES: dict[str, Case] = {}
