"""How far an instrument is from what an artefact's certificate says.

The ideas are those of VDI/VDE 2634 part 2 and ISO 10360-13: probing error of form and of size,
sphere-spacing error, flatness, in positions throughout the working volume. Conformity with neither
is claimed.
"""
