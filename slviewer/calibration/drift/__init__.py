"""Drift check of a saved calibration from one capture of its board."""
