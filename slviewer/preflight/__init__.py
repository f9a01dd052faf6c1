"""Is this rig fit to capture with? One file for each kind of check, and `run`, which makes them all in about 10 s."""
