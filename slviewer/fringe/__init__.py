"""What is projected, and what it says.

A `sequence.PatternSequence` says which image follows which (`presets` has ready ones, `patterns` renders them);
`decode.decode` turns the frames that a camera took of it into a `phase.PhaseMap`: absolute phase, modulation,
background, measured noise, and a reason for every pixel that is masked. `reference` is the definition in NumPy,
`kernels` the fast way to the same result, `origin` finds the conventions of folders that other tools wrote.
"""
