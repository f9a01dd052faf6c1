"""Whether a saved calibration is still good, from one capture of its board."""
