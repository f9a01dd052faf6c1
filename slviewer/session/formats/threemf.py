"""3MF: zipped XML, mm as it states, triangles alone, for printers and CAD.

Reading one takes the packages of `session.cad`; writing takes none.
"""

import io
import zipfile
from collections.abc import Sequence
from xml.sax.saxutils import escape

import numpy as np

from slviewer import __version__
from slviewer.session.shape_format import DECIMALS, Shape, ShapeFormat, Sizes, split_shape, writing

_HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'
_CORE = "http://schemas.microsoft.com/3dmanufacturing"
_PACKAGE = "http://schemas.openxmlformats.org/package/2006"
_TYPES = (
    f'{_HEAD}<Types xmlns="{_PACKAGE}/content-types"><Default Extension="rels"'
    ' ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model"'
    ' ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>'
)
_RELATIONS = (
    f'{_HEAD}<Relationships xmlns="{_PACKAGE}/relationships"><Relationship Id="rel0"'
    f' Target="/3D/3dmodel.model" Type="{_CORE}/2013/01/3dmodel"/></Relationships>'
)


def _encode(shape: Shape, notes: Sequence[str]) -> bytes:
    points, faces = split_shape(shape)
    assert faces is not None
    vertex = " ".join(f'{axis}="%.{DECIMALS}f"' for axis in "xyz")
    model = "".join(
        (
            f'{_HEAD}<model unit="millimeter" xmlns="{_CORE}/core/2015/02">',
            f'<metadata name="Application">slviewer {__version__}</metadata>',
            f'<metadata name="Description">{escape("; ".join(notes))}</metadata>',
            '<resources><object id="1" type="model"><mesh><vertices>',
            _format_rows(f"<vertex {vertex}/>", points),
            "</vertices><triangles>",
            _format_rows('<triangle v1="%d" v2="%d" v3="%d"/>', faces),
            "</triangles></mesh></object></resources>",
            '<build><item objectid="1"/></build></model>',
        )
    )
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("[Content_Types].xml", _TYPES)
        archive.writestr("_rels/.rels", _RELATIONS)
        archive.writestr("3D/3dmodel.model", model)
    return content.getvalue()


def _format_rows(row: str, values: np.ndarray) -> str:
    """Return a row of text for each of ``values`` (n, 3)."""
    return "".join(row % tuple(each) for each in values.tolist())


FORMAT = ShapeFormat(
    "3mf",
    "mm, as the file states; the triangles alone",
    Sizes(1500, 14, face=7),
    writing(_encode),
    takes_meshes=True,
)
