"""Why a calibration is not what it should be: evidence from frames, poses and the solution, and the cause behind it.

`frames` and `numbering` look at one pose, `solution` at all of them together; their results are plain `evidence`.
`rules` turn evidence into findings, each a cause with its remedy, and `verdict` is what the operator reads.
"""
