"""Diagnosis of calibrations: evidence from frames, poses and the solution; rules that turn it into
a verdict.

`frames` and `numbering` examine one pose, `solution` all of them together; their results are
`evidence`. `rules` turn evidence into findings, each a cause with its remedy.
"""
