"""The live image: saturated pixels, the detected board, and where to hold it next."""

import cv2
import numpy as np

from slviewer.gui.widgets import PICTURE_PX, Html, Picture, coloured, fitted, paragraph, to_html
from slviewer.target.board import Board
from slviewer.wizard.snapshot import PreviewView

_DETECTED, _GHOST, _CLIPPED = (60, 220, 90), (40, 190, 255), (255, 0, 80)


class LiveImage(Picture):
    """The live image in a panel, with what is to be seen in it."""

    def draw(self, preview: PreviewView) -> None:
        """Show a frame and its exposure."""
        self.set(draw_preview(preview), legend(preview, exposure_html(preview)))

    def draw_board(
        self, preview: PreviewView, board: Board | None, ghost_px: np.ndarray | None = None
    ) -> None:
        """Show a frame with the detected board, and where to hold it next."""
        hint = "" if ghost_px is None else "Dashed blue: hold the board here"
        lines = board_html(preview, board), exposure_html(preview), coloured(hint, "info")
        self.set(draw_preview(preview, board, ghost_px), legend(preview, *lines))


def draw_preview(
    preview: PreviewView, board: Board | None = None, ghost_px: np.ndarray | None = None
) -> np.ndarray:
    """Draw the frame (h, w, 3) uint8 with saturated pixels, the detected board and the suggested
    outline marked.

    The board's features are joined row by row; `ghost_px` is the outline (4, 2) of the suggested
    pose, in camera px.
    """
    picture = fitted(preview.image)
    clipped = preview.image >= 255
    if clipped.any():
        mask = cv2.resize(
            clipped.astype(np.uint8), picture.shape[1::-1], interpolation=cv2.INTER_NEAREST
        )
        picture[mask > 0] = _CLIPPED
    to_picture = preview.scale * PICTURE_PX / preview.image.shape[1]
    if ghost_px is not None and np.isfinite(ghost_px).all():
        _draw_dashed_outline(picture, ghost_px * to_picture)
    if preview.board:
        _draw_features(picture, preview.board.pixels * to_picture, board)
        corners = np.round(preview.board.outline * to_picture * 16).astype(np.int32)
        cv2.polylines(picture, [corners], True, _DETECTED, 2, cv2.LINE_AA, shift=4)
    return picture


def exposure_html(preview: PreviewView) -> Html:
    """Describe whether the frame is well exposed, and what to do."""
    if preview.brightness == "saturated":
        share = 100 * preview.saturated
        return coloured(f"{share:.1f} % saturated (red): lower the exposure", "error", bold=True)
    if preview.brightness == "dim":
        return coloured(
            f"Dim, peak at {100 * preview.brightest:.0f} %: raise the exposure", "warning"
        )
    return coloured(f"Well exposed, peak at {100 * preview.brightest:.0f} %", "good")


def board_html(preview: PreviewView, board: Board | None) -> Html:
    """Describe whether the board is detected, or why not."""
    if board is None:
        return coloured("No board is chosen", "dim")
    if preview.board is None:
        missing = preview.missing or "searching for the board …"
        return coloured(f"{missing[:1].upper()}{missing[1:]}", "warning")
    detected, total = len(preview.board.pixels), len(board.points)
    return coloured(f"Board detected: {detected} of {total} features", "good")


def legend(preview: PreviewView, *lines: Html) -> Html:
    """Return lines below the image, the frame rate beside the first."""
    rate = coloured(f"{preview.frames_per_s:.0f} frames/s", "dim")
    first = (
        '<div style="display:flex;justify-content:space-between;gap:1em">'
        f'<span>{lines[0]}</span><span style="white-space:nowrap">{rate}</span></div>'
    )
    return paragraph(Html(first + "".join(f"<div>{line}</div>" for line in lines[1:])))


def histogram_chart(preview: PreviewView) -> Html:
    """Return a bar chart of the grey levels; the last bar is red: saturated pixels."""
    # the few bright pixels matter most
    shares = np.sqrt(preview.histogram / max(float(preview.histogram.max()), 1e-9))
    bars = "".join(
        f'<rect x="{4 * k}" y="{40 - 40 * share:.1f}" width="3.4" height="{40 * share:.1f}" '
        f'fill="var(--mantine-color-{"red-6" if k == len(shares) - 1 else "blue-5"})"/>'
        for k, share in enumerate(shares)
    )
    axis = "".join(
        f'<span style="color:var(--mantine-color-dimmed);font-size:0.75rem">{to_html(text)}</span>'
        for text in ("dark", "grey level", "saturated")
    )
    return paragraph(
        Html(
            f'<svg viewBox="0 0 {4 * len(shares)} 40" preserveAspectRatio="none"'
            ' style="width:100%;height:48px;display:block;border-bottom:1px solid'
            f' var(--mantine-color-dimmed)">{bars}</svg><div'
            f' style="display:flex;justify-content:space-between">{axis}</div>'
        )
    )


def _draw_features(picture: np.ndarray, pixels: np.ndarray, board: Board | None) -> None:
    """Draw the detected features (n, 2) px, joined row by row where all were detected."""
    at = np.round(pixels * 16).astype(np.int32)
    if board and len(pixels) == len(board.points):
        columns = board.features[0]
        for row in at.reshape(-1, columns, 2):
            cv2.polylines(picture, [row], False, _DETECTED, 1, cv2.LINE_AA, shift=4)
    for point in at:
        cv2.circle(picture, (int(point[0]), int(point[1])), 40, _DETECTED, -1, cv2.LINE_AA, shift=4)


def _draw_dashed_outline(picture: np.ndarray, corners: np.ndarray) -> None:
    """Draw a closed dashed outline through corners (n, 2) px."""
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        dashes = max(2, int(np.linalg.norm(end - start) / 14))
        for k in range(dashes):
            a, b = (start + (end - start) * (k + part) / dashes for part in (0.0, 0.6))
            ends = [tuple(int(v) for v in np.round(p * 16)) for p in (a, b)]
            cv2.line(picture, ends[0], ends[1], _GHOST, 3, cv2.LINE_AA, shift=4)
