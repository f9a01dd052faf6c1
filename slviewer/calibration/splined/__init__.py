"""The third calibration: pinhole and Brown for both devices, a spline field for what their lenses
do beyond that, the board's own shape and every pose, all estimated together from circles and phase,
and compiled for speed.
"""
