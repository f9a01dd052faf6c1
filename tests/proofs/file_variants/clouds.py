"""PLY, PCD, OBJ, STL and E57 of random form."""

import io
import struct
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tests.proofs.file_variants.variant import (
    Form,
    Points,
    Variant,
    draw_comment,
    draw_shift,
    draw_surface,
    draw_unit,
    end_lines,
    list_faces,
)

_SIZE = 40
_NEW_NAMES = {
    "char": "int8", "uchar": "uint8", "short": "int16", "ushort": "uint16", "int": "int32",
    "uint": "uint32", "float": "float32", "double": "float64",
}  # fmt: skip
_CODES = {
    "char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I",
    "float": "f", "double": "d",
}  # fmt: skip
_ENDS = ("\n", "\r\n")
Property = tuple[str, str, np.ndarray]
"""Name, type (with the type of its length before it in a list), and values, an array or lists."""


def _scale_colours(colours: np.ndarray, kind: str) -> np.ndarray:
    """Return levels of 8 bits as values of a type."""
    if kind in ("float", "double"):
        return colours / 255.0
    return colours.astype(np.int64) * (257 if kind == "ushort" else 1)


def _draw_colours(form: Form, truth: Points) -> list[Property]:
    """Draw the properties of colours; none at times."""
    style = form.draw("colours", "none", "red", "red", "r", "diffuse_red", "alpha")
    if style == "none":
        return []
    kind = form.draw("of", "uchar", "uchar", "float", "ushort", "int")
    assert truth.colours is not None
    names = ["red", "green", "blue"]
    if style == "diffuse_red":
        names = [f"diffuse_{name}" for name in names]
    if style == "r":
        names = ["r", "g", "b"]
    values = _scale_colours(truth.colours, kind)
    found = [(name, kind, values[:, i]) for i, name in enumerate(names)]
    if style in ("r", "alpha"):
        name = "a" if style == "r" else "alpha"
        top = _scale_colours(np.full(len(values), 255, np.uint8), kind)
        found.append((name, kind, top))
    return found


def _draw_extras(form: Form, count: int) -> list[Property]:
    """Draw other properties of vertices."""
    rng, found = form.rng, list[Property]()
    if form.draw("quality", False, True):
        name = form.draw("named", "quality", "confidence", "scalar_Distance")
        found.append((name, form.draw("of", "float", "double"), rng.normal(size=count)))
    kind = form.draw("list", "none", "none", "varying", "constant")
    if kind != "none":
        lengths = rng.integers(0, 5, count) if kind == "varying" else np.full(count, 3)
        lists = np.empty(count, object)
        lists[:] = [rng.integers(0, 99, n) for n in lengths]
        found.append(("visibility", "uchar int", lists))
    if form.draw("flag", False, True):
        found.append(
            ("flags", form.draw("of", "char", "uint", "short"), rng.integers(0, 99, count))
        )
    return found


def _encode_ply_value(value: object, kind: str, order: str) -> bytes | str:
    """Return one value of an element, as text where the order is empty."""
    length, _, item = kind.rpartition(" ")
    values = np.atleast_1d(np.asarray(value))
    if not order:
        shown = {"float": "%.9g", "double": "%.17g"}.get(item, "%d")
        return " ".join([*([str(len(values))] if length else []), *(shown % v for v in values)])
    cast = float if item in ("float", "double") else int
    packed = struct.pack(f"{order}{len(values)}{_CODES[item]}", *map(cast, values))
    return (struct.pack(order + _CODES[length], len(values)) if length else b"") + packed


def _encode_ply(form: Form, elements: Mapping[str, list[Property]], comment: str) -> bytes:
    """Return a PLY in a random order of bytes, with random names of types and line ends."""
    order = form.draw("format", "ascii", "binary_little_endian", "binary_big_endian")
    byte_order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[order]
    names = form.draw("types", "old", "new")
    end = form.draw("end", *_ENDS)
    word = form.draw("said in", "comment", "comment", "obj_info")
    head = f"ply\nformat {order} 1.0\n{word} {comment}\nobj_info num_cols 3\n"
    body: list[bytes] = []
    for element, properties in elements.items():
        head += f"element {element} {len(properties[0][2])}\n"
        for name, kind, _ in properties:
            words = [_NEW_NAMES[word] if names == "new" else word for word in kind.split()]
            head += f"property {'list ' if len(words) > 1 else ''}{' '.join(words)} {name}\n"
        for row in zip(*(values for _, _, values in properties), strict=True):
            encoded = [
                _encode_ply_value(value, kind, byte_order)
                for value, (_, kind, _) in zip(row, properties, strict=True)
            ]
            if byte_order:
                body += encoded  # type: ignore[arg-type]
            else:
                body.append((" ".join(encoded) + end).encode())  # type: ignore[arg-type]
    return end_lines(head + "end_header\n", end) + b"".join(body)


def draw_ply(rng: np.random.Generator) -> Variant:
    """Draw a PLY of points or of a mesh."""
    form, truth = Form(rng), draw_surface(rng, _SIZE)
    kind = form.draw("x", "float", "double", "float", "int")
    unit, mm = ("", 1.0) if kind == "int" else draw_unit(form)
    points = np.round(truth.points * 1000) if kind == "int" else truth.points
    points = points + (draw_shift(form) if kind == "double" else 0)
    numbers = points / mm
    coordinates = [(axis, kind, numbers[:, i]) for i, axis in enumerate("xyz")]
    colours = _draw_colours(form, truth)
    normals: list[Property] = []
    if form.draw("normals", False, True):
        assert truth.normals is not None
        normals = [(f"n{a}", "float", truth.normals[:, i]) for i, a in enumerate("xyz")]
    extras = _draw_extras(form, len(points))
    groups = [coordinates, normals, colours, *([each] for each in extras)]
    if form.draw("shuffled", False, True):
        groups = [groups[i] for i in rng.permutation(len(groups))]
    elements = {"vertex": [each for group in groups for each in group]}
    unused = [[each[0]] for each in extras if each[2].dtype == object]
    scalars = {each[0]: each[2] for each in extras + colours[3:] if each[2].dtype != object}
    corners = form.draw("faces", 0, 0, 3, 4)
    if corners:
        faces = np.empty(len(found := list_faces(_SIZE, corners)), object)
        faces[:] = [np.array(face) for face in found]
        name = form.draw("named", "vertex_indices", "vertex_index")
        lists = form.draw("indices", "uchar int", "uchar uint", "int int")
        elements["face"] = [(name, lists, faces)]
        if form.draw("face flags", False, True):
            elements["face"].append(("group", "uchar", rng.integers(0, 9, len(faces))))
            unused.append(["group", "face"])
        if normals:
            unused.append(["nx", "normals of"])
    if form.draw("camera", False, False, True):
        camera = [("view_px", "float", np.ones(1)), ("view_py", "float", np.ones(1))]
        if form.draw("camera first", False, True):
            elements = {"camera": camera, **elements}
        else:
            elements["camera"] = camera
        unused.append(["camera"])
    truth = Points(
        points,
        truth.colours if colours else None,
        truth.normals if normals and not corners else None,
        scalars,
    )
    content = _encode_ply(form, elements, draw_comment(form, unit))
    return Variant("ply", form.text(), "a.ply", content, truth, unused)


def _compress_lzf(data: bytes) -> bytes:
    """Return LZF with literals and with references to what came 1 to 8191 bytes before."""
    out, literals, i, seen = bytearray(), bytearray(), 0, dict[bytes, int]()

    def flush() -> None:
        for begin in range(0, len(literals), 32):
            run = literals[begin : begin + 32]
            out.append(len(run) - 1)
            out.extend(run)
        literals.clear()

    while i < len(data):
        key = data[i : i + 3]
        before = seen.get(key, -1) if len(key) == 3 else -1
        seen[key] = i
        distance = i - before - 1
        if before < 0 or distance > 8191:
            literals.append(data[i])
            i += 1
            continue
        length = 3
        while length < 264 and i + length < len(data) and data[before + length] == data[i + length]:
            length += 1
        flush()
        if length - 2 < 7:
            out.append(length - 2 << 5 | distance >> 8)
        else:
            out.extend((7 << 5 | distance >> 8, length - 9))
        out.append(distance & 255)
        i += length
    flush()
    return bytes(out)


def draw_pcd(rng: np.random.Generator) -> Variant:
    """Draw a PCD."""
    form, truth = Form(rng), draw_surface(rng, _SIZE)
    assert truth.colours is not None and truth.normals is not None
    count, extras, turned = len(truth.points), list[list[str]](), truth.normals
    kind = form.draw("x", "<f4", "<f8", "<f4")
    unit, mm = draw_unit(form)
    points = truth.points + (draw_shift(form) if kind == "<f8" else 0)
    groups = [[(axis, kind, points[:, i] / mm) for i, axis in enumerate("xyz")]]
    scalars = dict[str, np.ndarray]()
    colours = form.draw("colours", "none", "rgb F", "rgb U", "rgba U", "r g b")
    if colours == "r g b":
        groups.append([(name, "<u1", truth.colours[:, i]) for i, name in enumerate("rgb")])
    elif colours != "none":
        name, letter = colours.split()
        red, green, blue = truth.colours.T.astype(np.uint32)
        packed = red << 16 | green << 8 | blue
        if name == "rgba":
            packed |= np.uint32(255 << 24)
        groups.append(
            [(name, "<u4", packed) if letter == "U" else (name, "<f4", packed.view("f4"))]
        )
    normals = form.draw("normals", False, True)
    if normals:
        names = [f"normal_{axis}" for axis in "xyz"]
        groups.append([(name, "<f4", truth.normals[:, i]) for i, name in enumerate(names)])
        if form.draw("curvature", False, True):
            groups.append([("curvature", "<f4", rng.uniform(size=count))])
            scalars["curvature"] = groups[-1][0][2]
    title = form.draw("title", "FIELDS", "FIELDS", "COLUMNS")
    for name, code in (("intensity", "<f4"), ("label", "<u4"), ("ring", "<u2"), ("t", "<f8")):
        if form.draw(name, False, False, True):
            groups.append([(name, code, rng.integers(0, 99, count))])
            scalars[name] = groups[-1][0][2]
    if form.draw("padding", False, True):
        groups.append([("_", "<u1", rng.integers(0, 9, (count, 4)))])
    if form.draw("fpfh", False, False, False, True):
        groups.append([("fpfh", "<f4", rng.uniform(size=(count, 33)))])
        extras.append(["fpfh"])
    if form.draw("shuffled", False, False, True):
        groups = [groups[i] for i in rng.permutation(len(groups))]
    fields = [each for group in groups for each in group]
    if form.draw("viewpoint", False, False, True):
        view = "1 2 -3 0.5 0.5 0.5 0.5"
        extras.append(["VIEWPOINT"])
        points = points[:, [2, 0, 1]] + mm * np.array([1, 2, -3])  # x to y, y to z, z to x
        turned = truth.normals[:, [2, 0, 1]]
    else:
        view = "0 0 0 1 0 0 0"
    types = {"f": "F", "i": "I", "u": "U"}
    data = form.draw("data", "ascii", "binary", "binary_compressed")
    end = form.draw("end", *_ENDS) if data == "ascii" else "\n"
    width = form.draw("rows", 1, _SIZE)
    head = (
        f"# .PCD v.7 - Point Cloud Data file format\n# {draw_comment(form, unit)}\nVERSION .7\n"
        f"{title} {' '.join(name for name, _, _ in fields)}\n"
        f"SIZE {' '.join(code[2] for _, code, _ in fields)}\n"
        f"TYPE {' '.join(types[code[1]] for _, code, _ in fields)}\n"
        f"COUNT {' '.join(str(v.size // count) for _, _, v in fields)}\n"
        f"WIDTH {count // width}\nHEIGHT {width}\nVIEWPOINT {view}\nPOINTS {count}\nDATA {data}\n"
    )
    columns = [np.asarray(v, code).reshape(count, -1) for _, code, v in fields]
    if data == "ascii":
        shown = []
        for values in columns:
            whole = values.dtype.kind != "f"
            digits = 17
            shown.append([" ".join(f"{v:d}" if whole else f"{v:.{digits}g}" for v in row)
                          for row in values])  # fmt: skip
        body = end_lines("".join(" ".join(row) + "\n" for row in zip(*shown, strict=True)), end)
    elif data == "binary":
        rows = [values.view(np.uint8).reshape(count, -1) for values in columns]
        body = np.hstack(rows).tobytes()
    else:
        plain = b"".join(values.tobytes() for values in columns)
        packed_body = _compress_lzf(plain)
        body = struct.pack("<II", len(packed_body), len(plain)) + packed_body
    truth = Points(
        points, truth.colours if colours != "none" else None, turned if normals else None, scalars
    )
    return Variant("pcd", form.text(), "a.pcd", end_lines(head, end) + body, truth, extras)


def draw_obj(rng: np.random.Generator) -> Variant:
    """Draw an OBJ of points or of a mesh."""
    form, truth = Form(rng), draw_surface(rng, _SIZE)
    assert truth.colours is not None and truth.normals is not None
    comma = form.draw("decimals", ".", ".", ".", ",") == ","
    colours = form.draw("colours", "none", "fractions", "levels")
    extras = list[list[str]]()
    weight = colours == "none" and form.draw("w", False, False, True)
    unit, mm = draw_unit(form)
    points = truth.points + draw_shift(form)
    lines = [f"# {draw_comment(form, unit).replace('1.0', '1')}", "mtllib a.mtl", "o part"]
    for point, colour in zip(points / mm, truth.colours, strict=True):
        row = [f"{v:.8f}" for v in point]
        if colours == "fractions":
            row += [f"{v / 255:.6f}" for v in colour]
        if colours == "levels":
            row += [f"{v}.0" for v in colour]
        row += ["1.0"] if weight else []
        lines.append("v " + " ".join(row))
    normals = form.draw("vn", False, True)
    if normals:
        lines += ["vn " + " ".join(f"{v:.6f}" for v in normal) for normal in truth.normals]
        extras.append(["vn", "normals"])
    texture = form.draw("vt", False, False, True)
    if texture:
        lines += ["vt 0.5 0.5"] * len(truth.points)
        extras.append(["vt", "texture"])
    corners = form.draw("faces", 0, 3, 4)
    if corners:
        negative, count = form.draw("negative", False, True), len(truth.points)
        lines += ["g side", "usemtl grey", "s 1"]
        for face in list_faces(_SIZE, corners):
            words = []
            for i in face:
                k = i - count if negative else i + 1
                words.append(f"{k}" + (f"/{k}" if texture else "/" * normals) + f"/{k}" * normals)
            lines.append("f " + " ".join(words))
    text = "\n".join(lines) + "\n"
    if comma:
        text = text.replace(".", ",").replace("a,mtl", "a.mtl")
        extras.append(["comma"])
    keep = truth.colours if colours != "none" else None
    scalars = {"w": np.ones(len(points))} if weight else {}
    truth = Points(points, keep, scalars=scalars)
    content = end_lines(text, form.draw("end", *_ENDS))
    return Variant("obj", form.text(), "a.obj", content, truth, extras)


def draw_stl(rng: np.random.Generator) -> Variant:
    """Draw an STL."""
    form, truth = Form(rng), draw_surface(rng, _SIZE)
    corners = truth.points[list_faces(_SIZE, 3)].astype(np.float32)
    extras = list[list[str]]()
    if form.draw("binary", True, False):
        colours = form.draw("colours", False, True)
        title = form.draw(
            "header", "made elsewhere", "solid part", "COLOR=\x10\x20\x30\xff", "units cm"
        )
        records = np.zeros(len(corners), "<f4,<f4,<f4,9<f4,<u2")
        records["f3"] = corners.reshape(-1, 9)
        if colours:
            records["f4"] = rng.integers(0, 32768, len(corners)) | 32768
            extras.append(["attribute", "colours"])
        if title.startswith("COLOR"):
            extras.append(["COLOR", "colour"])
        content = title.encode("latin-1").ljust(80) + struct.pack("<I", len(corners))
        points = (10.0 if title == "units cm" else 1.0) * truth.points
        return Variant(
            "stl", form.text(), "a.stl", content + records.tobytes(), Points(points), extras
        )
    solids = form.draw("solids", 1, 2)
    capital = form.draw("capitals", False, True)
    number = form.draw("numbers", "%.5f", "%.9e")
    text = ""
    for k, part in enumerate(np.array_split(corners, solids)):
        text += f"solid part {k}\n"
        for triangle in part:
            text += " facet normal 0 0 0\n  outer loop\n"
            text += "".join(f"   vertex {' '.join(number % v for v in c)}\n" for c in triangle)
            text += "  endloop\n endfacet\n"
        text += f"endsolid part {k}\n"
    content = end_lines(text.upper() if capital else text, form.draw("end", *_ENDS))
    return Variant("stl", form.text(), "a.stl", content, Points(truth.points), extras)


def draw_off(rng: np.random.Generator) -> Variant:
    """Draw an OFF of points or of a mesh."""
    form, truth = Form(rng), draw_surface(rng, _SIZE)
    assert truth.colours is not None and truth.normals is not None
    colours = form.draw("colours", "none", "fractions", "levels", "alpha")
    normals = form.draw("normals", False, True)
    faces = list_faces(_SIZE, corners) if (corners := form.draw("faces", 0, 3, 4)) else []
    unit, mm = draw_unit(form)
    points = truth.points + draw_shift(form)
    title = ("C" if colours != "none" else "") + ("N" if normals else "") + "OFF"
    counts = f"{len(points)} {len(faces)} {form.draw('edges', '0', '0', '12')}"
    lines = [title + form.draw("counts", "\n", " ") + counts, f"# {draw_comment(form, unit)}"]
    for point, normal, colour in zip(points / mm, truth.normals, truth.colours, strict=True):
        row = [f"{v:.8f}" for v in point] + ([f"{v:.6f}" for v in normal] if normals else [])
        if colours == "fractions":
            row += [f"{v / 255:.6f}" for v in colour]
        elif colours != "none":
            row += [f"{v}" for v in colour] + (["255"] if colours == "alpha" else [])
        lines.append(" ".join(row))
    painted = form.draw("of faces", "", "", " 0.1 0.2 0.3") if faces else ""
    lines += [f"{len(face)} {' '.join(map(str, face))}{painted}" for face in faces]
    extras = [["face"]] if painted else []
    if normals and faces:
        extras.append(["normals"])
    scalars = {"alpha": np.full(len(points), 255.0)} if colours == "alpha" else {}
    truth = Points(
        points,
        truth.colours if colours != "none" else None,
        truth.normals if normals and not faces else None,
        scalars,
    )
    content = end_lines("\n".join(lines) + "\n", form.draw("end", *_ENDS))
    return Variant("off", form.text(), "a.off", content, truth, extras)


def _encode_mat4(name: str, values: np.ndarray) -> bytes:
    """Return a matrix of a MAT file of version 4, which has no structs."""
    code = 50 if values.dtype == np.uint8 else 0
    head = struct.pack("<5i", code, *values.shape, 0, len(name) + 1)
    content = values.astype("u1" if code else "<f8").tobytes("F")
    return head + name.encode() + b"\0" + content


def draw_mat(rng: np.random.Generator) -> Variant:
    """Draw variables of MATLAB: version 4 byte by byte, 5 to 7 by scipy; 7.3 is refused."""
    from scipy.io import savemat

    form, truth = Form(rng), draw_surface(rng, _SIZE)
    assert truth.colours is not None and truth.normals is not None
    points, extras = truth.points + draw_shift(form), list[list[str]]()
    version = form.draw("version", "4", "5", "7", "7.3")
    name = form.draw("named", "xyz", "points", "Location", "P", "x y z")
    variables: dict[str, np.ndarray] = {name: points}
    if name == "x y z":
        variables = {axis: points[:, [i]] for i, axis in enumerate("xyz")}
    if colours := form.draw("colours", False, True):
        variables["Color"] = truth.colours
    if normals := form.draw("normals", False, True):
        variables["Normal"] = truth.normals
    scalars = {"Intensity": rng.uniform(size=len(points))} if form.draw("more", False, True) else {}
    variables |= {each: values[:, None] for each, values in scalars.items()}
    if form.draw("another", False, True):
        variables["T_cam"] = np.eye(4)
        extras.append(["T_cam"])
    rows = form.draw("rows", False, True) and version in ("5", "7")
    if rows:
        grid = _SIZE, _SIZE
        variables = {
            each: v if v.size == 16 else v.reshape((*grid, -1)[: 3 if v.shape[1] > 1 else 2])
            for each, v in variables.items()
        }
    found = Points(
        points, truth.colours if colours else None, truth.normals if normals else None, scalars
    )
    if version == "4":
        content = b"".join(_encode_mat4(each, v) for each, v in variables.items())
        return Variant("mat", form.text(), "a.mat", content, found, extras)
    file = io.BytesIO()
    inside = form.draw("inside", False, True)
    savemat(file, {"cloud": variables} if inside else variables, do_compression=version == "7")
    content = file.getvalue()
    if version == "7.3":  # HDF5 behind a header of that name
        content = content.replace(b"MATLAB 5.0", b"MATLAB 7.3", 1)
        return Variant("mat", form.text(), "a.mat", content, None, (), ["7.3"])
    return Variant("mat", form.text(), "a.mat", content, found, extras)


def draw_las(rng: np.random.Generator) -> Variant:
    """Draw a LAS, by its specification: versions 1.2 and 1.4, formats of points 0 to 3 and 6 to 8,
    with extra bytes and the unit of a coordinate system; or packed, as LAZ, by laspy."""
    form, truth = Form(rng), draw_surface(rng, _SIZE)
    assert truth.colours is not None
    kind = form.draw("points", 0, 1, 2, 3, 6, 7)
    minor, size, count = (4 if kind > 5 else 2), 375 if kind > 5 else 227, len(truth.points)
    scale = form.draw("scale", 1e-6, 1e-7)
    shift = draw_shift(form) / 1e3
    raw = np.rint(truth.points / 1e3 / scale)
    points = (raw * scale + shift) * 1e3
    intensity, classes = rng.integers(0, 65536, count), rng.integers(0, 20, count)
    scalars: dict[str, np.ndarray] = {"intensity": intensity, "classification": classes}
    row = [(axis, "<i4") for axis in "xyz"] + [("intensity", "<u2"), ("flags", "u1")]
    row += [("more", "u1")] if kind > 5 else []
    user, angle = ("user", "u1"), ("angle", "<i2" if kind > 5 else "i1")
    row += [("class", "u1"), *((user, angle) if kind > 5 else (angle, user))]
    row += [("source", "<u2"), *([("time", "<f8")] if kind in (1, 3, 6, 7) else [])]
    row += [(name, "<u2") for name in ("red", "green", "blue")] if kind in (2, 3, 7) else []
    extra = form.draw("extra bytes", False, True)
    row += [("reflectance", "<f4")] if extra else []
    records = np.zeros(count, row)
    for axis, values in zip("xyz", raw.T, strict=True):
        records[axis] = values
    records["intensity"], records["class"], records["flags"] = intensity, classes, 0x11
    if kind < 6:
        records["flags"] = 0x09
    if "time" in (records.dtype.names or ()):
        records["time"] = scalars["gps_time"] = rng.uniform(0, 6e5, count)
    if extra:
        records["reflectance"] = rng.normal(size=count)
        scalars["reflectance"] = records["reflectance"]
    wide = form.draw("colours of", 8, 16)
    if has_colours := "red" in (records.dtype.names or ()):
        for name, values in zip(("red", "green", "blue"), truth.colours.T, strict=True):
            records[name] = values.astype(int) * (257 if wide == 16 else 1)
    tables, unit = [], form.draw("system", "none", "none", 9001, 9003)
    if unit != "none":
        tables.append(("LASF_Projection", 34735, struct.pack("<8H", 1, 1, 0, 1, 3076, 0, 1, unit)))
    if extra:
        described = struct.pack("<2sBB32s4s", b"", 9, 0, b"reflectance", b"").ljust(192, b"\0")
        tables.append(("LASF_Spec", 4, described))
    vlrs = b"".join(
        struct.pack("<H16sHH32s", 0, user.encode(), number, len(content), b"") + content
        for user, number, content in tables
    )
    head = struct.pack("<4sHH16sBB32s32s", b"LASF", 0, 0, b"", 1, minor, b"made", b"elsewhere")
    sizes = size, size + len(vlrs), len(tables), kind, records.itemsize, 0 if kind > 5 else count
    head += struct.pack("<HHHIIBHI", 1, 2026, *sizes)
    head += struct.pack("<5I", *([0] * 5 if kind > 5 else [count, 0, 0, 0, 0]))
    low, high = points.min(axis=0) / 1e3, points.max(axis=0) / 1e3
    box = [each for axis in range(3) for each in (high[axis], low[axis])]
    head += struct.pack("<12d", *([scale] * 3), *shift, *box)
    if kind > 5:
        head += struct.pack("<QQIQ15Q", 0, 0, 0, count, count, *([0] * 14))
    truth = Points(points, truth.colours if has_colours else None, scalars=scalars)
    content = head + vlrs + records.tobytes()
    name = "a.las"
    if form.draw("packed", False, True) and find_spec("laspy") and find_spec("lazrs"):
        import laspy

        laspy.read(io.BytesIO(content)).write(packed := io.BytesIO(), do_compress=True)
        name, content = "a.laz", packed.getvalue()
    is_metric = unit != 9003
    reasons = ["laspy"] if is_metric else ["laspy", "feet"]  # named where it is not installed
    return Variant("las", form.text(), name, content, truth if is_metric else None, (), reasons)


def write_e57(fields: Sequence[Property], pose: np.ndarray | None = None, limits: int = 0) -> bytes:
    """Return an E57 of one scan, by the nodes of libe57. ``fields``: of types "double", "float",
    "scaled", or "int 255" by the largest number. ``pose``: a quaternion, then a shift in metres;
    ``limits``: the largest level of a colour that the scan states, 0 for none."""
    from pye57 import E57, libe57

    with TemporaryDirectory() as folder:
        file = E57(str(path := Path(folder, "a.e57")), mode="w")
        image = file.image_file
        image.extensionsAdd("my", "http://example.org/my")
        number = {
            "double": lambda top: libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE),
            "float": lambda top: libe57.FloatNode(image, 0.0, libe57.E57_SINGLE, -1e30, 1e30),
            "scaled": lambda top: libe57.ScaledIntegerNode(image, 0, -(2**40), 2**40, 1e-8),
            "int": lambda top: libe57.IntegerNode(image, 0, 0, top),
        }
        prototype, buffers = libe57.StructureNode(image), libe57.VectorSourceDestBuffer()
        columns = [np.ascontiguousarray(values, np.float64) for _, _, values in fields]
        for (name, kind, _), values in zip(fields, columns, strict=True):
            of, _, top = kind.partition(" ")
            prototype.set(name, number[of](int(top or 0)))
            count = len(values)
            buffers.append(libe57.SourceDestBuffer(image, name, values, count, True, True))
        scan = libe57.StructureNode(image)
        file.data3d.append(scan)
        scan.set("guid", libe57.StringNode(image, "{of a proof}"))
        if limits:
            node = libe57.StructureNode(image)
            for name in ("colorRed", "colorGreen", "colorBlue"):
                node.set(f"{name}Minimum", libe57.IntegerNode(image, 0))
                node.set(f"{name}Maximum", libe57.IntegerNode(image, limits))
            scan.set("colorLimits", node)
        if pose is not None:
            node = libe57.StructureNode(image)
            for part, axes, values in (
                ("rotation", "wxyz", pose[:4]),
                ("translation", "xyz", pose[4:]),
            ):
                inner = libe57.StructureNode(image)
                for axis, value in zip(axes, values, strict=True):
                    inner.set(axis, libe57.FloatNode(image, float(value)))
                node.set(part, inner)
            scan.set("pose", node)
        vector = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
        scan.set("points", vector)
        writer = vector.writer(buffers)
        writer.write(count)
        writer.close()
        file.close()
        return path.read_bytes()


def draw_e57(rng: np.random.Generator) -> Variant:
    """Draw an E57 of one scan."""
    form, truth = Form(rng), draw_surface(rng, _SIZE)
    assert truth.colours is not None
    count, points, metres = len(truth.points), truth.points, truth.points.T / 1e3
    colours = truth.colours
    names = ["cartesianX", "cartesianY", "cartesianZ"]
    places, kind = metres, form.draw("places", "double", "float", "scaled", "polar")
    if kind == "polar":
        reach = np.linalg.norm(metres, axis=0)
        elevation = np.arcsin(metres[2] / reach)
        places = np.stack([reach, np.arctan2(metres[1], metres[0]), elevation])
        names = ["sphericalRange", "sphericalAzimuth", "sphericalElevation"]
    of = "double" if kind == "polar" else kind
    columns = list(zip(names, [of] * 3, places, strict=True))
    top = {"8 bits": 255, "10 bits": 1023, "16 bits": 65535, "fractions": 1}.get(
        form.draw("colours", "none", "8 bits", "10 bits", "16 bits", "fractions"), 0
    )
    if top:
        dark = form.draw("brightest", 1.0, 1.0, 0.5)
        levels = np.rint(colours * dark)
        shown = levels / 255 if top == 1 else np.rint(levels * (top / 255))
        colours = np.rint(255 * shown / top).astype(np.uint8)
        name_of = ("colorRed", "colorGreen", "colorBlue")
        node = "float" if top == 1 else f"int {top}"
        columns += zip(name_of, [node] * 3, shown.T, strict=True)
    limits = top if form.draw("limits", False, True) else 0
    scalars = dict[str, np.ndarray]()
    for name, kind_of, values in (
        ("intensity", form.draw("intensity", "double", "scaled"), rng.uniform(size=count)),
        ("rowIndex", f"int {_SIZE}", np.arange(count) // _SIZE),
        ("timeStamp", "double", np.sort(rng.uniform(0, 60, count))),
        ("my:temperature", "float", np.round(rng.uniform(15, 30, count), 3).astype(np.float32)),
        ("isColorInvalid", "int 1", rng.integers(0, 2, count)),
    ):
        if form.draw(name, False, True):
            columns.append((name, kind_of, values))
            scalars[name.rpartition(":")[2]] = values
    is_valid, extras = np.ones(count, bool), list[list[str]]()
    if form.draw("invalid", False, False, True):
        of_kind = "spherical" if kind == "polar" else "cartesian"
        states = rng.choice([0, 0, 0, 1, 2], count)
        is_valid, extras = states == 0, [["invalid"]]
        columns.append((f"{of_kind}InvalidState", "int 2", states))
    pose = None
    if form.draw("pose", False, True):  # a quarter about z, then shifted
        pose = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5), 0.01, 0.02, 0.03])
        points = np.stack([10 - points[:, 1], 20 + points[:, 0], 30 + points[:, 2]], axis=1)
    content = write_e57(columns, pose, limits)
    truth = Points(
        points[is_valid],
        colours[is_valid] if top else None,
        scalars={name: values[is_valid] for name, values in scalars.items()},
    )
    return Variant("e57", form.text(), "a.e57", content, truth, extras=extras)


def cut(draw: Callable[[np.random.Generator], Variant], rng: np.random.Generator) -> Variant:
    """Draw a variant that ends early, in the last tenth."""
    whole = draw(rng)
    content = whole.content[: int(len(whole.content) * rng.uniform(0.9, 0.99))]
    reasons = ("truncated", "breaks off", "ends", "holds", "damaged", *whole.reasons)
    return Variant("cut", f"{whole.format}: {whole.form}", whole.name, content, reasons=reasons)
