"""Pattern sequences, and decoding of the frames that a camera takes of them.

A `sequence.PatternSequence` describes which image follows which (`presets` has ready-made ones,
`patterns` renders them); `decode.decode` converts the captured frames to a `phase.PhaseMap`:
absolute phase, modulation, background, measured noise, and a reason for every pixel that is masked.
`kernels` decode, `tests/decode_reference.py` is their definition in NumPy, `origin` estimates the
conventions of captures from other tools.
"""
