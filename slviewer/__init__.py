"""slviewer: a camera and a projector as a metrology-grade 3D scanner.

Conventions, the same everywhere:

=================  ==========================================================================================
image              ``(h, w)``, uint8 or uint16; a texture may be ``(h, w, 3)`` RGB; a stack is ``(n, h, w)``,
                   C-contiguous, filled in place as frames arrive
pixel              ``(u, v)`` = (column, row); ``(0, 0)`` is the centre of the top-left pixel; the same for the
                   projector
lengths, angles    mm; rad, unless a name ends in ``_deg``; a doubtful quantity carries its unit in its name
fringe image       ``I_k = A + B cos(phi + 2 pi k / n)``, k = 0 ... n-1; so
                   ``phi = atan2(-sum I_k sin, sum I_k cos)``, ``B = 2/n hypot(...)``
absolute phase     ``phi = 2 pi u_p / period_px``, zero at the centre of projector column 0 (row 0 for axis y)
axis               ``x`` = the pattern varies along projector columns (vertical stripes), ``y`` = along rows
transform          ``T_projector_camera`` maps camera-frame points into the projector frame: ``X_p = R X_c + t``
invalid            NaN in float maps and clouds, False in masks (True = valid)
depth ranges       R1 in front of the calibrated depths, R2 inside, R3 behind
=================  ==========================================================================================

"The Letter" is Vargas, Romero, Zhang and Marrugo, *Pixel-wise rational model for structured light system*,
Optics Letters 2023; symbols follow it, and docstrings cite its equation or step.

Data flows one way: geometry, fringe, target, calibration, reconstruction, registration, surface, evaluation,
inspection, simulation, devices, session, report, pipeline, preflight, wizard, server, gui, validation, and the
command line at the end. A package imports only from those before it.
"""

__version__ = "0.1.0"
