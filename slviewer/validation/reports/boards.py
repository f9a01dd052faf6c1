"""Printed boards of other makers and sizes."""

from slviewer.validation.reports.case import Case

CASES: dict[str, Case] = {}
