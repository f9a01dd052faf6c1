"""STEP and 3MF models as triangles in mm, parsed in a process of its own; the files state their
units.

STEP surfaces are triangulated by Open CASCADE (the package cascadio). Of a 3MF file, the objects
that its build prints are read, and their components.
"""

import io
import os
import sys
import tempfile
import zipfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.errors import SessionError
from slviewer.session.reading import limit_process, run_isolated

PACKAGES = {"step": ("cascadio",), "stp": ("cascadio",), "3mf": ("lxml", "networkx")}
"""What reading a format needs."""
INSTALL_COMMAND = "pip install 'slviewer[cad]'"
CHORD_MM = 0.005
"""Largest distance of the triangles from the surfaces of a STEP model."""
_CHORD_RAD = 0.2
_UNITS_MM = {
    "micron": 1e-3,
    "millimeter": 1.0,
    "centimeter": 10.0,
    "inch": 25.4,
    "foot": 304.8,
    "meter": 1000.0,
}
_EXTENSIONS = ("/production/", "/material/", "/slice/", "/trianglesets/")
"""Of 3MF: parts of the names of those that leave the triangles as they are."""
_SLICER_CONFIG = "metadata/slic3r_pe_model.config"
"""Where PrusaSlicer names the volumes of an object, whose triangles follow one another."""
_CPU_S, _CPU_S_PER_MB, _MAX_CPU_S = 10, 5, 60
"""Processor time that a model may take to parse, and more of it for larger files: a small one is
not to explode."""


def require_packages(file_format: str) -> None:
    """Raise SessionError where a package that reads the format is missing."""
    missing = [package for package in PACKAGES[file_format] if find_spec(package) is None]
    if missing:
        raise SessionError(
            f".{file_format} files need the package {missing[0]}",
            f"install it with {INSTALL_COMMAND}",
        )


def load_triangles(
    name: str, file_format: str, data: bytes, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) mm and faces (m, 3) of a model; ``name``: of its file, for messages.
    What was skipped or approximated is appended to ``notes``.

    Raises SessionError for a damaged file, and for one that takes too much memory or time.
    """
    require_packages(file_format)
    cpu_s = min(_CPU_S + len(data) * _CPU_S_PER_MB // 1_000_000, _MAX_CPU_S)
    status, output = run_isolated(__name__, file_format, data=data, cpu_s=cpu_s)
    if status == 1:
        raise SessionError(
            f"{name} holds no surfaces that can be read, or is damaged", "export the model again"
        )
    if status != 0:
        raise SessionError(
            f"{name} is damaged, or needs more than 2 GB or {cpu_s} s to read",
            "export the model again, or as STL",
        )
    with np.load(io.BytesIO(output)) as arrays:
        vertices, faces, found = arrays["vertices"], arrays["faces"], arrays["notes"].tolist()
    if not len(faces):
        reason = "; ".join(found) or "it holds no surfaces"
        raise SessionError(
            f"{name} cannot be read as a part: {reason}. Export the part alone, as an object that"
            " is printed, or as STL"
        )
    notes += found
    return vertices, faces


def _parse_step(data: bytes) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return vertices (n, 3) mm, faces (m, 3) and notes. Raises what the parsers raise."""
    import cascadio
    import trimesh

    with tempfile.TemporaryDirectory() as folder:
        model, converted = Path(folder, "model.step"), Path(folder, "model.glb")
        model.write_bytes(data)
        cascadio.step_to_glb(str(model), str(converted), CHORD_MM, _CHORD_RAD, use_parallel=False)
        scene = trimesh.load_scene(io.BytesIO(converted.read_bytes()), file_type="glb")
    scene.apply_scale(1000.0)  # glTF is in metres
    mesh = scene.to_mesh()
    if mesh.is_empty:
        raise ValueError("no triangles")
    notes = [f"its surfaces were triangulated within {CHORD_MM:g} mm"]
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64), notes


def _parse_3mf(data: bytes) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return vertices (n, 3) mm, faces (m, 3) and notes: what is printed, and what was skipped.
    Raises what the parsers raise."""
    package = _Package(data)
    (start,) = (
        relation.get("Target")
        for relation in package.load("_rels/.rels")
        if relation.get("Type", "").endswith("/3dmodel")
    )
    model = package.load(start)
    for prefix in model.get("requiredextensions", "").split():
        if not any(part in model.nsmap[prefix] for part in _EXTENSIONS):
            package.skipped.append(f"it needs the extension {model.nsmap[prefix]}")
            return np.empty((0, 3)), np.empty((0, 3), np.int64), package.skipped
    for item in model.iterfind("{*}build/{*}item"):
        if item.get("printable", "1") in ("0", "false"):
            package.skip(package.find(start, item)[1], "not printed")
        else:
            package.add(start, item, np.eye(4))
    package.skip_unused()
    notes = []
    if skipped := package.skipped:
        named = ", ".join(skipped[:5]) + (", ..." if len(skipped) > 5 else "")
        notes.append(f"objects that are not of the part were skipped: {named}")
    if not package.meshes:
        return np.empty((0, 3)), np.empty((0, 3), np.int64), notes
    vertices, faces = (list(each) for each in zip(*package.meshes, strict=True))
    offsets = np.cumsum([0] + [len(each) for each in vertices[:-1]])
    joined = np.concatenate([each + at for each, at in zip(faces, offsets, strict=True)])
    return _UNITS_MM[model.get("unit", "millimeter")] * np.concatenate(vertices), joined, notes


class _Package:
    """The parts of a 3MF file; ``meshes`` that were added, each (vertices, faces), in the file's
    units, and the objects that were ``skipped``, for notes."""

    def __init__(self, data: bytes) -> None:
        self._archive = zipfile.ZipFile(io.BytesIO(data))
        self._names = {name.strip("/").lower(): name for name in self._archive.namelist()}
        self._models: dict[str, Any] = {}
        self._volumes: dict[str, list[Any]] = {}
        if _SLICER_CONFIG in self._names:
            for each in self.load(_SLICER_CONFIG).iterfind("object"):
                self._volumes[each.get("id")] = list(each.iterfind("volume"))
        self._models.clear()
        self.meshes: list[tuple[np.ndarray, np.ndarray]] = []
        self.skipped: list[str] = []

    def load(self, path: str) -> Any:
        """Return the root element of an XML part."""
        from lxml import etree

        key = path.strip("/").lower()
        if key not in self._models:
            parser = etree.XMLParser(resolve_entities=False, no_network=True, huge_tree=True)
            content = self._archive.read(self._names[key])
            self._models[key] = etree.fromstring(content, parser)
        return self._models[key]

    def find(self, path: str, reference: Any) -> tuple[str, Any]:
        """Return the object that an item or component in the part ``path`` refers to, and the part
        that holds it."""
        other = next((each for key, each in reference.items() if key.endswith("}path")), path)
        for each in self.load(other).iterfind("{*}resources/{*}object"):
            if each.get("id") == reference.get("objectid"):
                return other, each
        raise ValueError("an object is missing")

    def skip(self, described: Any, reason: str) -> None:
        """Note that an object, or a volume of one, is not of the part."""
        label = f"'{described.get('name') or 'object ' + described.get('id', '?')}' ({reason})"
        if label not in self.skipped:
            self.skipped.append(label)

    def add(self, path: str, reference: Any, outer: np.ndarray) -> None:
        """Add the meshes of an item or component, which ``outer`` (4, 4) places."""
        path, described = self.find(path, reference)
        if (kind := described.get("type", "model")) not in ("model", "surface"):
            self.skip(described, "support" if "support" in kind else f"type {kind}")
            return
        inner = np.eye(4)
        if transform := reference.get("transform"):
            inner[:3] = np.array(transform.split(), float).reshape(4, 3).T
        placed = outer @ inner
        for component in described.iterfind("{*}components/{*}component"):
            self.add(path, component, placed)
        for mesh in described.iterfind("{*}mesh"):
            vertices, faces = (
                np.array([[each.get(key) for key in keys] for each in mesh.iterfind(where)], kind)
                for where, keys, kind in (
                    ("{*}vertices/{*}vertex", "xyz", np.float64),
                    ("{*}triangles/{*}triangle", ("v1", "v2", "v3"), np.int64),
                )
            )
            faces = self._keep_part(described, faces)
            mirrored = np.linalg.det(placed[:3, :3]) < 0
            if len(faces):
                placed_vertices = vertices @ placed[:3, :3].T + placed[:3, 3]
                self.meshes.append((placed_vertices, faces[:, ::-1] if mirrored else faces))

    def _keep_part(self, described: Any, faces: np.ndarray) -> np.ndarray:
        """Return the triangles (m, 3) of an object without the volumes that its slicer names as
        modifiers or supports."""
        kept = np.ones(len(faces), bool)
        for volume in self._volumes.get(described.get("id"), ()):
            values = {each.get("key"): each.get("value") for each in volume.iterfind("metadata")}
            modifier = "ParameterModifier" if values.get("modifier") == "1" else "ModelPart"
            if (kind := values.get("volume_type", modifier)) != "ModelPart":
                kept[int(volume.get("firstid")) : int(volume.get("lastid")) + 1] = False
                self.skip({"name": values.get("name", kind)}, kind)
        return faces[kept]

    def skip_unused(self) -> None:
        """Note the objects that neither the build nor another object refers to."""
        used = {
            self.find(path, each)[1]
            for path, model in list(self._models.items())
            for each in model.iter("{*}item", "{*}component")
        }
        for model in list(self._models.values()):
            for described in model.iterfind("{*}resources/{*}object"):
                if described not in used:
                    self.skip(described, "not in the build")


if __name__ == "__main__":
    limit_process()
    answer = os.dup(1)
    os.dup2(2, 1)  # what the parsers print is not part of the answer
    parse = _parse_3mf if sys.argv[1] == "3mf" else _parse_step
    found = parse(sys.stdin.buffer.read())
    content = io.BytesIO()
    np.savez(content, vertices=found[0], faces=found[1], notes=np.array(found[2], str))
    with os.fdopen(answer, "wb") as file:
        file.write(content.getvalue())
