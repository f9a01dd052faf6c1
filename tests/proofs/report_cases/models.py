"""CAD models as other programs write them."""

import io
import struct
import zipfile
from functools import partial

import numpy as np
import trimesh

from slviewer.session.nominal import read_nominal
from tests.proofs.report_cases.case import Case, Outcome, Workplace, read_refusal

_U = [(12, 9), (8, 9), (8, 5), (4, 5), (4, 9), (0, 9), (0, 0), (12, 0)]
"""Outline of a prism, anticlockwise: a slot in its upper side."""
_PRISM, _BOX = 184.0, 1000.0
"""Volumes, mm^3."""


def _prism() -> tuple[np.ndarray, list[list[int]]]:
    """Return vertices (n, 3) and polygons, which face outwards, of the prism with a slot."""
    n = len(_U)
    vertices = np.array([(x, y, z) for z in (0.0, 2.0) for x, y in _U])
    sides = [[i, (i + 1) % n, n + (i + 1) % n, n + i] for i in range(n)]
    return vertices, [list(range(n))[::-1], list(range(n, 2 * n)), *sides]


def _obj(corner: str, first: int = 1, wrap: str = " ", bodies: int = 1) -> bytes:
    """Return prisms as OBJ: the form of a ``corner``, the index of the ``first`` vertex, and what
    stands between two corners."""
    vertices, faces = _prism()
    lines = []
    for k in range(bodies):
        lines += [f"v {x + 20 * k} {y} {z}" for x, y, z in vertices]
        lines += ["f " + wrap.join(corner.format(i + first) for i in face) for face in faces]
    return "\n".join([*lines, "l 1 2", "p 1", ""]).encode()


def _ply() -> bytes:
    """Return the prism as a binary PLY, whose polygons have four and eight corners."""
    vertices, faces = _prism()
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{axes}element face"
        f" {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    body = b"".join(struct.pack(f"<B{len(face)}i", len(face), *face) for face in faces)
    return header.encode() + vertices.astype("<f4").tobytes() + body


def _3mf(build: str, objects: str = "") -> bytes:
    """Return a 3MF file of a box (object 1), a pin that supports it (2), and other objects."""
    meshes: list[str] = []
    for kind, size in (("model", (20, 10, 5)), ("support", (3, 3, 40))):
        box = trimesh.creation.box(size)
        points = "".join('<vertex x="{}" y="{}" z="{}"/>'.format(*v) for v in box.vertices)
        faces = "".join('<triangle v1="{}" v2="{}" v3="{}"/>'.format(*f) for f in box.faces)
        meshes.append(
            f'<object id="{len(meshes) + 1}" type="{kind}"><mesh><vertices>{points}</vertices>'
            f"<triangles>{faces}</triangles></mesh></object>"
        )
    space = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr(
            "_rels/.rels",
            '<Relationships><Relationship Target="/3D/3dmodel.model" Type="http://schemas.'
            'microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>',
        )
        archive.writestr(
            "3D/3dmodel.model",
            f'<model unit="millimeter" xmlns="{space}"><resources>{"".join(meshes)}{objects}'
            f"</resources><build>{build}</build></model>",
        )
    return content.getvalue()


def _stl(header: bytes, rest: bytes = b"") -> bytes:
    """Return a box as binary STL with this header and more bytes at its end."""
    content: bytes = trimesh.creation.box((20, 10, 5)).export(file_type="stl")
    return header.ljust(80, b" ") + content[80:] + rest


def _text_stl(start: bytes = b"", end: bytes = b"\n", point: bytes = b".") -> bytes:
    """Return a box as text STL: what stands before it, ends its lines, and is its point."""
    text: str = trimesh.creation.box((20, 10, 5)).export(file_type="stl_ascii")
    return start + text.encode().replace(b".", point).replace(b"\n", end)


def _read(name: str, content: bytes, volume: float, bodies: int, place: Workplace) -> Outcome:
    """Read a model; compare its volume, bodies and closedness with those that were written."""
    (path := place.folder / name).write_bytes(content)
    model = read_nominal(path)
    mesh = trimesh.Trimesh(model.mesh.vertices, model.mesh.faces, process=False)
    holds = model.closed and mesh.body_count == bodies and abs(mesh.volume / volume - 1) < 1e-4
    kind = "closed" if model.closed else "open"
    measured = [f"{mesh.volume:.2f} mm^3, {mesh.body_count} bodies, {kind}", *model.notes]
    return Outcome("; ".join(measured), f"{volume:.2f} mm^3, {bodies} bodies, closed", bool(holds))


def _refuse(name: str, content: bytes, fact: str, place: Workplace) -> Outcome:
    """Read a model that must be refused with ``fact`` in its reason."""
    (path := place.folder / name).write_bytes(content)
    said = read_refusal(lambda: read_nominal(path), "read")
    return Outcome(said, f"refused: {fact}", fact in said and "export" in said)


_NESTED = (
    '<object id="3"><components><component objectid="1" transform="1 0 0 0 1 0 0 0 1 40 0 0"/>'
    '<component objectid="2"/></components></object><object id="4"><components><component'
    ' objectid="3"/><component objectid="3" transform="-1 0 0 0 1 0 0 0 1 0 0 0"/></components>'
    "</object>"
)
_SUPPORTED = '<item objectid="1"/><item objectid="2"/>'
_UNPRINTED = '<item objectid="1"/><item objectid="1" printable="0"/>'
CASES: dict[str, Case] = {
    "obj-concave": partial(_read, "a.obj", _obj("{}"), _PRISM, 1),
    "obj-concave-continued": partial(_read, "a.obj", _obj("{}", wrap=" \\\n"), _PRISM, 1),
    "ply-concave": partial(_read, "a.ply", _ply(), _PRISM, 1),
    "obj-relative": partial(_read, "a.obj", _obj("{}", -16, bodies=3), 3 * _PRISM, 3),
    "obj-relative-texture": partial(_read, "a.obj", _obj("{0}/{0}/{0}", -16), _PRISM, 1),
    "obj-relative-normal": partial(_read, "a.obj", _obj("{0}//{0}", -16, bodies=2), 2 * _PRISM, 2),
    "3mf-support": partial(_read, "a.3mf", _3mf(_SUPPORTED), _BOX, 1),
    "3mf-not-printed": partial(_read, "a.3mf", _3mf(_UNPRINTED), _BOX, 1),
    "3mf-nested-mirrored": partial(
        _read, "a.3mf", _3mf('<item objectid="4"/>', _NESTED), 2 * _BOX, 2
    ),
    "stl-trailing-bytes": partial(_read, "a.stl", _stl(b"solid part", bytes(4)), _BOX, 1),
    "stl-byte-order-mark": partial(_read, "a.stl", _text_stl(b"\xef\xbb\xbf"), _BOX, 1),
    "stl-carriage-returns": partial(_read, "a.stl", _text_stl(end=b"\r"), _BOX, 1),
    "stl-decimal-commas": partial(_read, "a.stl", _text_stl(point=b","), _BOX, 1),
    "stl-truncated": partial(_refuse, "a.stl", _stl(b"solid part")[:-60], "holds 10"),
    "stl-truncated-text": partial(_refuse, "a.stl", _text_stl()[:-200], "truncated"),
}
