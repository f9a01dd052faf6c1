"""slviewer: a camera and a projector as a metrology-grade 3D scanner.

``import slviewer as sl`` gives what a notebook needs, imported when it is first used. On a session,
a folder that holds captures and results, work `import_captures`, `calibrate`, `reconstruct`,
`verify`, `merge`, `mesh` and `measure`, named after their commands. On arrays, without a session,
work `read_captures`, `decode`, `detect_board`, `calibrate_frames`, `reconstruct_cloud`,
`evaluate_plane`, `evaluate_sphere`, `align_clouds`, `fuse_clouds`, `mesh_cloud`, `draw_error_maps`
and `write_ply`. `show` opens a cloud, a merge or a mesh in a 3D view.

Conventions, the same everywhere:

=================  =================================================================================
image              ``(h, w)``, uint8 or uint16; a texture may be ``(h, w, 3)`` RGB; a stack is ``(n,
                   h, w)``, C-contiguous, filled in place as frames arrive
pixel              ``(u, v)`` = (column, row); ``(0, 0)`` is the centre of the top-left pixel; the
                   same for the projector
lengths, angles    mm; rad, unless a name ends in ``_deg``; a doubtful quantity carries its unit in
                   its name
fringe image       ``I_k = A + B cos(phi + 2 pi k / n)``, k = 0 ... n-1; so ``phi = atan2(-sum I_k
                   sin, sum I_k cos)``, ``B = 2/n hypot(...)``
absolute phase     ``phi = 2 pi u_p / period_px``, zero at the centre of projector column 0 (row 0
                   for axis y)
axis               ``x`` = the pattern varies along projector columns (vertical stripes), ``y`` =
                   along rows
transform          ``T_projector_camera`` maps camera-frame points into the projector frame: ``X_p =
                   R X_c + t``
invalid            NaN in float maps and clouds, False in masks (True = valid)
depth ranges       R1 in front of the calibrated depths, R2 inside, R3 behind
=================  =================================================================================

"The Letter" is Vargas, Romero, Zhang and Marrugo, *Pixel-wise rational model for a structured light
system*, Optics Letters 2023; symbols follow it, and docstrings cite its equation or step.
"""

import ast
from importlib import import_module
from pathlib import Path
from typing import Any

try:  # written by the build from the git tag
    from slviewer._version import version as __version__
except ImportError:  # a checkout that was never built or installed
    __version__ = "0.2.0.dev0"

_STUB = Path(__file__).with_suffix(".pyi").read_text("utf-8")
_EXPORTS = {
    each.asname or each.name: (node.module, each.name)
    for node in ast.walk(ast.parse(_STUB))
    if isinstance(node, ast.ImportFrom)
    for each in node.names
}
"""{public name: its module, and its name there}."""

__all__ = sorted(_EXPORTS)


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, original = _EXPORTS[name]
    imported = vars(import_module(module))
    if original not in imported:  # a module itself
        return import_module(f"{module}.{original}")
    return imported[original]


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
