"""Calibration boards: their notation, detection in an image, and printable sheets."""
