"""Situations that users of calibration, registration and CAD tools reported, rebuilt; each module
has one field's."""
