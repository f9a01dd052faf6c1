"""Is this rig fit to capture with? The checks, and `check_rig.preflight`, which makes them all in
about 10 s."""
