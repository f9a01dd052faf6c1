"""Examination of a capture: which explanation of all its frames fits them best."""
