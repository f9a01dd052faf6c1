"""Vector drawings in mm as SVG or PDF: a few filled shapes to exact scale, and text."""

from dataclasses import dataclass, field

import numpy as np

from slviewer.geometry.rigid import Mask

MM_PER_POINT = 25.4 / 72
LARGEST_PDF_MM = 14_400 * MM_PER_POINT
"""Side of the largest page that PDF viewers accept."""
ARC_CONTROL = 0.5522847498
"""Handles of a quarter circle's Bezier curve over its radius; the curve leaves the circle by 0.03 %
of it at most."""


@dataclass
class Drawing:
    """Black shapes on a page of ``width`` x ``height`` mm; x to the right, y down from the top left
    corner, mm."""

    width: float
    height: float
    circles: list[tuple[float, float, float]] = field(default_factory=list)
    """(x, y, radius)"""
    rectangles: list[tuple[float, float, float, float]] = field(default_factory=list)
    """(x, y, width, height)"""
    texts: list[tuple[float, float, float, str]] = field(default_factory=list)
    """(x, y of the baseline, size of the letters, ASCII text)"""

    def add_cells(self, black: Mask, left: float, top: float, side: float) -> None:
        """Add the black cells (m, m) bool of a square of ``side`` mm at (left, top), neighbours in
        a row merged."""
        cell = side / len(black)
        for i, row in enumerate(np.pad(black, ((0, 0), (1, 1))).astype(int)):
            starts, ends = np.nonzero(np.diff(row) == 1)[0], np.nonzero(np.diff(row) == -1)[0]
            self.rectangles += [
                (left + a * cell, top + i * cell, (b - a) * cell, cell)
                for a, b in zip(starts, ends, strict=True)
            ]

    def svg(self) -> bytes:
        """The drawing as an SVG file whose user unit is the millimetre."""
        squares = "".join(
            f"M{_mm(x)} {_mm(y)}h{_mm(w)}v{_mm(h)}h{_mm(-w)}z" for x, y, w, h in self.rectangles
        )
        lines = [
            (
                f'<svg xmlns="http://www.w3.org/2000/svg" width="{_mm(self.width)}mm"'
                f' height="{_mm(self.height)}mm" viewBox="0 0 {_mm(self.width)}'
                f' {_mm(self.height)}">'
            ),
            f'<rect width="{_mm(self.width)}" height="{_mm(self.height)}" fill="white"/>',
            *(f'<circle cx="{_mm(x)}" cy="{_mm(y)}" r="{_mm(r)}"/>' for x, y, r in self.circles),
            f'<path d="{squares}"/>',
            *(
                f'<text x="{_mm(x)}" y="{_mm(y)}" font-size="{_mm(size)}" font-family="Helvetica,'
                f' Arial, sans-serif">{text}</text>'
                for x, y, size, text in self.texts
            ),
            "</svg>",
        ]
        return "\n".join(lines).encode("ascii")

    def pdf(self) -> bytes:
        """The drawing as a PDF file of one page; its content is in mm, after one change of
        units."""
        scale = 1 / MM_PER_POINT
        lines = [f"{scale:.10f} 0 0 {-scale:.10f} 0 {self.height * scale:.6f} cm"]
        for x, y, r in self.circles:
            h = ARC_CONTROL * r
            lines += [
                f"{_mm(x + r)} {_mm(y)} m",
                _curve(x + r, y + h, x + h, y + r, x, y + r),
                _curve(x - h, y + r, x - r, y + h, x - r, y),
                _curve(x - r, y - h, x - h, y - r, x, y - r),
                _curve(x + h, y - r, x + r, y - h, x + r, y),
                "f",
            ]
        lines += [f"{_mm(x)} {_mm(y)} {_mm(w)} {_mm(h)} re" for x, y, w, h in self.rectangles]
        lines += ["f"] * bool(self.rectangles)  # one path, so that touching cells show no seams
        lines += [
            f"BT /F1 {_mm(size)} Tf 1 0 0 -1 {_mm(x)} {_mm(y)} Tm ({text}) Tj ET"
            for x, y, size, text in self.texts
        ]
        content = "\n".join(lines)
        page = f"0 0 {self.width * scale:.6f} {self.height * scale:.6f}"
        objects = (
            "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
            "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
            f"<< /Type /Page /Parent 2 0 R /MediaBox [{page}] /Contents 4 0 R "
            "/Resources << /Font << /F1 5 0 R >> >> >>",
            f"<< /Length {len(content)} >>\nstream\n{content}\nendstream",
            "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
        )
        body, table = "%PDF-1.7\n", "xref\n0 6\n0000000000 65535 f \n"
        for number, text in enumerate(objects, 1):
            table += f"{len(body):010d} 00000 n \n"
            body += f"{number} 0 obj\n{text}\nendobj\n"
        trailer = f"trailer\n<< /Size 6 /Root 1 0 R >>\nstartxref\n{len(body)}\n%%EOF\n"
        return (body + table + trailer).encode("ascii")


def _mm(value: float) -> str:
    """A length to a hundredth of a micrometre, without an exponent."""
    return f"{value:.5f}".rstrip("0").rstrip(".")


def _curve(*coordinates: float) -> str:
    """Return a PDF operator for a Bezier curve."""
    return " ".join(_mm(c) for c in coordinates) + " c"
