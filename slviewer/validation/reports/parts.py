"""Scans aligned and judged against models."""

from slviewer.validation.reports.case import Case

CASES: dict[str, Case] = {}
