"""Clouds and meshes of other scanners."""

from slviewer.validation.reports.case import Case

CASES: dict[str, Case] = {}
