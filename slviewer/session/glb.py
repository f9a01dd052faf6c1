"""Binary glTF 2.0: one file that browsers, Blender and the programs of phones show in its true size.

Its unit is the metre, y points up, and the viewer looks along -z: vertices are written in metres (not scaled by the
node, since some readers leave nodes out), and the node turns the camera's frame, whose y points down and whose z
points away, by half a turn about x. So an object stands as the camera saw it.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slviewer import __version__
from slviewer.errors import InputError
from slviewer.session.atomic import arriving_file
from slviewer.session.ply import check_faces, pieces
from slviewer.surface.shapes import Mesh, PointSet

METRES = 1e-3
"""Metres in a millimetre."""
_FLOAT, _BYTE, _INDEX = 5126, 5121, 5125
_POINTS, _TRIANGLES = 0, 4
_LARGEST = 2**32 - 1


def write_glb(path: Path, shape: PointSet | Mesh, notes: Sequence[str] = ()) -> None:
    """Writes points or a mesh, their colours, and their normals if all are known (glTF has no word for an unknown one).

    Raises InputError where the file would exceed glTF's 4 GB; SessionError where the disk refuses.
    """
    points, faces = (shape.vertices, shape.faces) if isinstance(shape, Mesh) else (shape.points, None)
    normals = shape.normals if shape.normals is not None and np.isfinite(shape.normals).all() else None
    blocks: list[tuple[str, np.ndarray]] = [("POSITION", points)]
    if normals is not None:
        blocks.append(("NORMAL", normals))
    if shape.colours is not None:
        blocks.append(("COLOR_0", shape.colours))
    if faces is not None:
        check_faces(faces, len(points))
        blocks.append(("indices", faces))
    described, binary_bytes = _described(blocks, notes)
    text = json.dumps(described, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    whole = 12 + 8 + len(text) + 8 + binary_bytes
    if whole > _LARGEST:
        raise InputError(f"{path.name} would have {whole / 1e9:.1f} GB, and glTF ends at 4.3: write it as .ply instead")
    with arriving_file(path, whole) as file:
        file.write(b"glTF" + np.array([2, whole], "<u4").tobytes())
        file.write(np.array([len(text)], "<u4").tobytes() + b"JSON" + text)
        file.write(np.array([binary_bytes], "<u4").tobytes() + b"BIN\0")
        for name, values in blocks:
            for part in pieces(len(values)):
                file.write(_encoded(name, values[part]).tobytes())


def _encoded(name: str, values: np.ndarray) -> np.ndarray:
    """A piece of a block as glTF lays it out; every record takes a multiple of four bytes."""
    if name == "POSITION":
        return in_metres(values)
    if name == "NORMAL":
        length = np.linalg.norm(values, axis=1, keepdims=True)
        return np.where(length > 0, values / np.maximum(length, 1e-12), np.array([0.0, 0.0, 1.0])).astype("<f4")
    if name == "COLOR_0":
        return np.concatenate([values, np.full((len(values), 1), 255, np.uint8)], axis=1)
    return values.astype("<u4")


def in_metres(points: np.ndarray) -> np.ndarray:
    """Points (n, 3) mm as the file holds them."""
    return (points.astype(np.float64) * METRES).astype("<f4")


def _described(blocks: list[tuple[str, np.ndarray]], notes: Sequence[str]) -> tuple[dict[str, Any], int]:
    """(the JSON part, bytes of the binary part)."""
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    attributes: dict[str, int] = {}
    primitive: dict[str, Any] = {"attributes": attributes, "mode": _POINTS, "material": 0}
    offset = 0
    for i, (name, values) in enumerate(blocks):
        accessor: dict[str, Any] = {"bufferView": i, "componentType": _FLOAT, "count": len(values), "type": "VEC3"}
        width = 12
        target = 34962
        if name == "indices":
            accessor |= {"componentType": _INDEX, "count": values.size, "type": "SCALAR"}
            primitive |= {"indices": i, "mode": _TRIANGLES}
            target = 34963
        elif name == "COLOR_0":
            width = 4
            accessor |= {"componentType": _BYTE, "type": "VEC4", "normalized": True}
        elif name == "POSITION":
            ends = in_metres(np.stack([values.min(axis=0), values.max(axis=0)]))
            accessor |= {"min": ends[0].tolist(), "max": ends[1].tolist()}
        if name != "indices":
            attributes[name] = i
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": width * len(values), "target": target})
        accessors.append(accessor)
        offset += width * len(values)
    said = ["vertices in metres, in the frame of the camera", "the node turns y up and z towards the viewer", *notes]
    described = {
        "asset": {"version": "2.0", "generator": f"slviewer {__version__}", "extras": {"notes": said}},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "surface", "rotation": [1, 0, 0, 0]}],
        "meshes": [{"primitives": [primitive]}],
        # scanned surfaces are open: they have no inside that could be left undrawn
        "materials": [{"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1}}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    return described, offset
