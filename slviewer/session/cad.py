"""STEP and 3MF models as triangles in mm, parsed in a process of its own; the files state their
units.

STEP surfaces are triangulated by Open CASCADE (the package cascadio).
"""

import io
import os
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from slviewer.errors import SessionError
from slviewer.session.reading import limit_process, run_isolated

PACKAGES = {"step": ("cascadio",), "stp": ("cascadio",), "3mf": ("lxml", "networkx")}
"""What reading a format needs."""
INSTALL_COMMAND = "pip install 'slviewer[cad]'"
CHORD_MM = 0.005
"""Largest distance of the triangles from the surfaces of a STEP model."""
_CHORD_RAD = 0.2
_CPU_S, _CPU_S_PER_MB, _MAX_CPU_S = 10, 5, 60
"""Processor time that a model may take to parse, and more of it for larger files: a small one is
not to explode."""


def require_packages(file_format: str) -> None:
    """Raise SessionError where a package that reads or writes the format is missing."""
    missing = [package for package in PACKAGES[file_format] if find_spec(package) is None]
    if missing:
        raise SessionError(
            f".{file_format} files need the package {missing[0]}: install it with {INSTALL_COMMAND}"
        )


def load_triangles(name: str, file_format: str, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) mm and faces (m, 3) of a model; ``name``: of its file, for messages.

    Raises SessionError for a damaged file, and for one that takes too much memory or time.
    """
    require_packages(file_format)
    cpu_s = min(_CPU_S + len(data) * _CPU_S_PER_MB // 1_000_000, _MAX_CPU_S)
    status, output = run_isolated(__name__, file_format, data=data, cpu_s=cpu_s)
    if status == 1:
        raise SessionError(
            f"{name} holds no surfaces that can be read, or is damaged: export the model again"
        )
    if status != 0:
        raise SessionError(
            f"{name} is damaged, or needs more than 2 GB or {cpu_s} s to read: export the model"
            " again, or as STL"
        )
    with np.load(io.BytesIO(output)) as arrays:
        return arrays["vertices"], arrays["faces"]


def _parse(file_format: str, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) mm and faces (m, 3). Raises what the parsers raise."""
    import trimesh

    if file_format == "3mf":
        scene = trimesh.load_scene(io.BytesIO(data), file_type="3mf")
        scene = scene.convert_units("millimeter")
    else:
        import cascadio

        with tempfile.TemporaryDirectory() as folder:
            model, converted = Path(folder, "model.step"), Path(folder, "model.glb")
            model.write_bytes(data)
            cascadio.step_to_glb(
                str(model), str(converted), CHORD_MM, _CHORD_RAD, use_parallel=False
            )
            scene = trimesh.load_scene(io.BytesIO(converted.read_bytes()), file_type="glb")
        scene.apply_scale(1000.0)  # glTF is in metres
    mesh = scene.to_mesh()
    if mesh.is_empty:
        raise ValueError("no triangles")
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)


if __name__ == "__main__":
    limit_process()
    answer = os.dup(1)
    os.dup2(2, 1)  # what the parsers print is not part of the answer
    found = _parse(sys.argv[1], sys.stdin.buffer.read())
    content = io.BytesIO()
    np.savez(content, vertices=found[0], faces=found[1])
    with os.fdopen(answer, "wb") as file:
        file.write(content.getvalue())
