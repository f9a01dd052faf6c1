"""The captured poses as rows with thumbnails, and as boards in the 3D view."""

from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np

from slviewer.gui.scene import Colour, Stroke, ViewerScene
from slviewer.gui.widgets import Html, Tone, coloured, paragraph, thumbnail, to_html
from slviewer.target.board import Board
from slviewer.wizard.snapshot import PoseView

TONES: dict[str, Tone] = {
    "judging": "info",
    "good": "good",
    "used": "good",
    "refused": "error",
    "excluded": "dim",
    "unused": "warning",
}
COLOURS: dict[str, Colour] = {
    "judging": (34, 139, 230),
    "good": (47, 158, 68),
    "used": (47, 158, 68),
    "refused": (224, 49, 49),
    "excluded": (140, 140, 140),
    "unused": (232, 119, 0),
}
_PICTURE_PX = 160


def pose_table(poses: Sequence[PoseView]) -> Html:
    """List all poses, the latest first, with their state and its reason."""
    if not poses:
        return paragraph(coloured("None yet.", "dim"))
    rows = []
    for pose in reversed(poses):
        rms = f"{pose.rms_px[0]:.2f} / {pose.rms_px[1]:.2f} px" if pose.rms_px is not None else ""
        state = coloured(pose.state, TONES[pose.state], bold=True)
        why = f'<div style="color:var(--mantine-color-dimmed)">{to_html(pose.why or rms)}</div>'
        rows.append(
            '<div style="display:flex;gap:0.6em;align-items:center;padding:0.25em 0;'
            'border-top:1px solid var(--mantine-color-default-border)">'
            f"{thumbnail(pose.thumbnail, 52, pose.name)}"
            f'<div style="min-width:0"><b>{to_html(pose.name)}</b>&ensp;{state}{why}</div></div>'
        )
    return paragraph(Html(f'<div style="max-height:15em;overflow-y:auto">{"".join(rows)}</div>'))


class PoseBoards:
    """Draws the boards of the poses in a layer; `chosen(name)` is called when one is clicked."""

    def __init__(self, scene: ViewerScene, layer: str, chosen: Callable[[str], None]) -> None:
        self._scene, self._layer, self._chosen = scene, layer, chosen
        self._drawn: dict[str, Any] = {}

    def draw(
        self,
        poses: Sequence[PoseView],
        board: Board | None,
        camera: tuple[int, int] | None,
        chosen: str,
    ) -> None:
        """Draw the boards of the poses whose position is known; the chosen one has a thicker
        outline."""
        known = (
            {pose.name: pose for pose in poses if pose.T_camera_board is not None}
            if board is not None
            else {}
        )
        for name in set(self._drawn) - set(known):
            self._scene.remove(self._layer, name)
            del self._drawn[name]
        for name, pose in known.items():
            assert pose.T_camera_board is not None and board is not None
            key = (
                pose.state,
                pose.T_camera_board.tobytes(),
                bool(pose.thumbnail),
                name == chosen,
                str(board),
            )
            if self._drawn.get(name) != key:
                self._drawn[name] = key
                picture = self._scene.board(
                    self._layer,
                    name,
                    pose.T_camera_board,
                    board.outline(),
                    Stroke(COLOURS[pose.state], 4.0 if name == chosen else 2.0),
                    picture=rectified(pose, board, camera),
                    label=name.removeprefix("pose_"),
                )
                if picture is not None:
                    picture.on_click(lambda _event, name=name: self._chosen(name))


def rectified(pose: PoseView, board: Board, camera: tuple[int, int] | None) -> np.ndarray | None:
    """Cut the board's front (h, w, 3) uint8 out of a pose's thumbnail; None where either is
    unknown."""
    if not pose.thumbnail or pose.board_px is None or camera is None:
        return None
    image = cv2.imdecode(np.frombuffer(pose.thumbnail, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        return None
    size = np.ptp(board.outline(), axis=0)
    width, height = _PICTURE_PX, max(1, round(_PICTURE_PX * float(size[1] / size[0])))
    corners = (pose.board_px + 0.5) * image.shape[1] / camera[0] - 0.5
    face = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], np.float32)
    H = cv2.getPerspectiveTransform(corners.astype(np.float32), face)
    return cv2.cvtColor(cv2.warpPerspective(image, H, (width, height)), cv2.COLOR_BGR2RGB)
