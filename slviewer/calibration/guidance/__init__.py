"""Where a calibration needs the board next, and how sure it would be: from information that poses would add."""
