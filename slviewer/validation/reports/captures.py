"""Captures of other cameras and projectors."""

from slviewer.validation.reports.case import Case

CASES: dict[str, Case] = {}
