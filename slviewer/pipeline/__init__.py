"""The commands as Python functions, one module for each: `calibrate.py` holds `calibrate`. The
wizard uses the same."""
