"""Step 3: hold the board where it is suggested, and capture; each pose is judged at once."""

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import cv2
import numpy as np
import viser

from slviewer.calibration.next_pose import GOAL_POSES, Coverage
from slviewer.gui.capture_inputs import ImportInputs
from slviewer.gui.panel import Confirmation, RestoreButton, StepPanel
from slviewer.gui.scene import GHOST, Colour
from slviewer.gui.widgets import (
    Html,
    LiveImage,
    Sound,
    Text,
    Tone,
    coloured,
    note,
    paragraph,
    thumbnail,
    to_html,
)
from slviewer.target.board import Board
from slviewer.wizard.snapshot import PoseView, PreviewView, SessionView, Snapshot

_DRAG_S = 0.15  # between two requests while a board is dragged
_QUIET_S = 1.0  # after which the gizmo follows the board again
_COLOURS = (
    "var(--mantine-color-gray-light)",
    "var(--mantine-color-green-3)",
    "var(--mantine-color-green-6)",
)
_TILTS = {(1, 1): "●", (0, 1): "▲", (1, 2): "▶", (2, 1): "▼", (1, 0): "◀"}
"""Place (row, column) and arrow of each of the coverage's tilts: facing, then the side that is
farther away."""
_GOOD: tuple[Tone, Colour] = ("good", (47, 158, 68))
_STATES: dict[str, tuple[Tone, Colour]] = {
    "judging": ("info", (34, 139, 230)),
    "good": _GOOD,
    "used": _GOOD,
    "refused": ("error", (224, 49, 49)),
    "excluded": ("dim", (140, 140, 140)),
    "unused": ("warning", (232, 119, 0)),
}
"""{state of a pose: tone of its name, colour of its board in 3D}."""
_PICTURE_PX = 160
_HEADING = "color:var(--mantine-color-dimmed);margin-bottom:0.2em"
"""Style of the name of a chart."""


def coverage_chart(coverage: Coverage) -> Html:
    """Return three small charts side by side, that of a second camera's image below the first's; a
    field is full once GOAL_POSES poses cover it."""
    images = _draw_grid(coverage.cells)
    if coverage.second is not None:
        images += f'<div style="{_HEADING}">Second camera</div>{_draw_grid(coverage.second)}'
    depths = "".join(
        f'<div style="display:flex;align-items:center;gap:0.4em">{_draw_field(n, 44, 15)}'
        f"<span>{name}</span></div>"
        for name, n in zip(("near", "middle", "far"), coverage.depths, strict=True)
    )
    tilts = np.full((3, 3), -1)
    for place, n in zip(_TILTS, coverage.tilts, strict=True):
        tilts[place] = n
    near, far = coverage.range_mm
    charts = "".join(
        f'<div><div style="{_HEADING}">{to_html(title)}</div>{chart}</div>'
        for title, chart in (
            ("Image", images),
            (f"Depth, {near:.0f}–{far:.0f} mm", depths),
            ("Tilt", _draw_grid(tilts, _TILTS)),
        )
    )
    title = coloured(
        f"Coverage {100 * coverage.share:.0f} %",
        "good" if coverage.share > 0.9 else "plain",
        bold=True,
    )
    return paragraph(
        Html(
            f"<div>{title}</div><div"
            f' style="display:flex;justify-content:space-between;gap:0.8em">{charts}</div>'
        )
    )


def _draw_grid(counts: np.ndarray, marks: dict[tuple[int, int], str] | None = None) -> str:
    """Return a chart of counts (rows, columns), with a mark in some fields; -1: no field."""
    rows = "".join(
        '<div style="display:flex;gap:2px;margin-bottom:2px">'
        + "".join(_draw_field(n, 17, 17, (marks or {}).get((i, j), "")) for j, n in enumerate(row))
        + "</div>"
        for i, row in enumerate(counts)
    )
    return f"<div>{rows}</div>"


def _draw_field(count: int, width: int, height: int, mark: str = "") -> str:
    """Return one field of a chart, coloured by its count; transparent where negative."""
    colour = "transparent" if count < 0 else _COLOURS[min(int(count), GOAL_POSES)]
    style = f"width:{width}px;height:{height}px;border-radius:2px;background:{colour};font-size:9px"
    return f'<div style="{style};line-height:{height}px;text-align:center">{mark}</div>'


_NEXT, _BOARD, _HANDLE = "next pose", "simulated board", "handle of the board"
"""What is drawn beside the poses, as the list of the view names it."""


class PosesPanel(StepPanel):
    """Panel of the step Poses."""

    key = "poses"

    _board: Board | None = None
    _drawn_session: SessionView | None = None
    _is_counting = False
    _dragged = _sent = 0.0
    _ghost_px: np.ndarray | None = None
    _image: np.ndarray | None = None
    _world: np.ndarray | None = None
    _target = ""

    def build(self) -> None:
        """Create the live image, the buttons, the coverage and the list of poses."""
        gui, operator = self._gui, self._operator
        self._world_layer = self._scene.layer("poses/simulated board")
        self._T_board_centre = np.eye(4)  # mm; the board's handle is at its centre
        self._states: dict[str, str] = {}
        self._drawn_poses: dict[str, Any] = {}
        self._picture = LiveImage(gui)
        self._countdown = Text(gui)
        self._accuracy = Text(gui)
        self._coverage = Text(gui)
        self._other_object = Text(gui)
        self._capture = self.button(
            "Capture pose", operator.capture_pose, "camera", None, hint="Key: C"
        )
        self._place = self.button(
            "Place board", operator.place_at_suggestion, "target-arrow",
            hint="Moves the simulated board to the suggested pose",
        )  # fmt: skip
        self._hotkey = gui.add_command(
            "Capture pose", hotkey="C", icon=viser.Icon.CAMERA, disabled=True
        )
        self.react(self._hotkey.on_trigger, operator.capture_pose)
        self._hands_free = self.setting(
            self.checkbox(
                "Hands-free",
                "Captures whenever the board is held still; a simulated one moves on by itself",
            ),
            operator.set_hands_free,
        )
        self._wanted = self.setting(
            self.number(
                "Precision, mm",
                0.0,
                0.0,
                10.0,
                0.001,
                (
                    "Goal: predicted standard deviation of a measured point at which no further "
                    "pose is suggested; 0: the default"
                ),
            ),
            lambda sigma: operator.set_wanted_sigma(float(sigma) or None),
        )
        with gui.add_folder("Captured poses"):
            self._table = Text(gui)
            self._chosen = self.choice(
                "Pose", follow=lambda session: [pose.name for pose in session.poses]
            )
            self._detail = Text(gui)
            self._actions = {
                "Exclude": operator.exclude,
                "Include": operator.include,
                "Retake": operator.retake_pose,
                "Delete": self._delete,
            }
            self._group = self.button_group("Action", tuple(self._actions), self._request_action)
            self._question = Confirmation(self)
            self._restore = RestoreButton(self)
        ImportInputs(self, "calibration")
        self._sound = Sound(gui)

    def draw(self) -> None:
        """Show the poses, coverage and suggestion."""
        snapshot, session = self.snapshot, self.session
        if session.target != self._target:
            self._target = session.target
            self._board = Board.parse(self._target) if self._target else None
            if self._board:
                self._T_board_centre[:3, 3] = self._board.outline().mean(axis=0)
            self._world = None
        self._capture.disabled = snapshot.rig.state != "open" or self._board is None
        self._picture.is_large = self.is_ready
        self._place.visible = snapshot.world is not None
        is_planned = session.suggestion is not None and session.pending_plan is None
        # a board that is moved while it is captured makes no pose
        self._place.disabled = not is_planned or snapshot.rig.capture is not None
        self._hands_free.update(snapshot.hands_free)
        self._draw_world(snapshot)
        if session is not self._drawn_session:
            self._drawn_session = session
            self._draw_session(session)
        self._draw_choice()

    def _draw_session(self, session: SessionView) -> None:
        """Show the poses and what they cover, and choose the newest one."""
        poses = session.poses
        self._coverage.set(coverage_chart(session.coverage) if session.coverage else "")
        self._draw_accuracy(session)
        self._draw_ghost(session)
        self._image = session.plan.image if session.plan else None
        self._play_sound(poses, self.snapshot.hands_free)
        self._chosen.offer_names(pose.name for pose in reversed(poses))
        self._chosen.handle.visible = self._group.visible = bool(poses)
        self._table.set(pose_table(poses))
        self._restore.offer(session.deleted_poses)

    def draw_preview(self, preview: PreviewView) -> None:
        """Show the live image with the detected board, and the countdown of a hands-free
        capture."""
        is_wanted = self.snapshot.step(self.key).state != "done"
        self._picture.draw_board(
            preview, self._board, self._ghost_px, self._image, is_wanted=is_wanted
        )
        count = preview.countdown_s
        if count is not None and not self._is_counting:
            self._sound.play("tick")
        self._is_counting = count is not None
        text = "" if count is None else to_html(f"Hold still: {max(count, 0):.1f} s")
        bold = Html(f'<b style="font-size:1.3rem">{text}</b>' if text else "")
        self._countdown.write(bold, "info")

    def show(self, visible: bool) -> None:
        """Show or hide the layers; the hotkey works only while shown."""
        super().show(visible)
        self._hotkey.disabled = not visible
        self._drawn_session = None

    # drawing

    def _draw_accuracy(self, session: SessionView) -> None:
        """Show the predicted standard deviation and the goal."""
        plan, text = session.plan, ""
        if plan:
            self._wanted.update(round(session.wanted_mm, 3))
        if plan and plan.sigma_mm is not None:
            text = f"Predicted sigma {plan.sigma_mm:.3f} mm, goal {session.wanted_mm:.3f} mm"
            if session.enough:
                text += ": reached."
            elif plan.sigma_next_mm:
                text += f"; {plan.sigma_next_mm:.3f} mm with the next pose"
        self._accuracy.write(text, "good" if session.enough else "info")

    def _draw_ghost(self, session: SessionView) -> None:
        """Draw the suggested pose in 3D, and store its outline for the live image."""
        suggestion = None if session.enough else session.suggestion
        self._ghost_px = suggestion.outline_px if suggestion else None
        if suggestion is None or self._board is None:
            self.layer.remove(_NEXT)
        else:
            T, outline = suggestion.T_camera_board, self._board.outline()
            self.layer.board(_NEXT, T, outline, GHOST, 4.0, label=_NEXT)

    def _draw_world(self, snapshot: Snapshot) -> None:
        """Draw the simulated board and its handle, or which other object is in view."""
        world, layer = snapshot.world, self._world_layer
        standing = world.standing if world else "board"
        text = "" if standing == "board" else f"In view: the {standing}. Place the board first."
        self._other_object.write(text, "warning")
        if world is None or text or self._board is None:
            if self._world is not None:
                layer.clear()
                self._world = None
            return
        T, centre = world.T_camera_object, self._T_board_centre
        if self._world is None:
            layer.board(_BOARD, T, self._board.outline(), (130, 130, 130), 3.0)
            layer.gizmo(_HANDLE, T @ centre, self._drag_board, self._place_board)
        elif not np.array_equal(T, self._world):
            layer.move(_BOARD, T)
            if time.monotonic() - self._dragged > _QUIET_S:
                layer.move(_HANDLE, T @ centre)
        self._world = T

    def _draw_choice(self) -> None:
        """Show the details of the chosen pose, and all poses in 3D."""
        self._draw_boards(self.session.poses, self.snapshot.rig.camera)
        pose = self.snapshot.pose(self._chosen.value)
        if pose is None:
            self._detail.set("")
            return
        lines = [
            Html(f"<b>{to_html(pose.name)}</b>"),
            coloured(pose.state, _STATES[pose.state][0], bold=True),
        ]
        if pose.rms_px:
            camera, projector = pose.rms_px
            calibration = self.session.calibration
            model = calibration.label if calibration else ""
            other = calibration.reprojection.other if calibration else "projector"
            rms = f"Reprojection RMS, {model}: camera {camera:.3f} px, {other} {projector:.3f} px"
            lines.append(to_html(rms))
        if pose.T_camera_board is not None:
            about = "" if pose.state == "used" else "about "
            lines.append(coloured(f"Distance {about}{pose.T_camera_board[2, 3]:.0f} mm", "dim"))
        frame = self.context.offer_frame(pose.name)
        picture = thumbnail(pose.thumbnail, 150, pose.name, frame)
        text = "".join(f"<div>{line}</div>" for line in lines)
        self._detail.set(
            paragraph(Html(f'<div style="display:flex;gap:0.8em">{picture}<div>{text}</div></div>'))
        )

    def _draw_boards(self, poses: Sequence[PoseView], camera: tuple[int, int] | None) -> None:
        """Draw the boards of the poses whose position is known; the chosen one has a thicker
        outline."""
        board, chosen = self._board, self._chosen.value
        known = {pose.name: pose for pose in poses if board and pose.T_camera_board is not None}
        for name in set(self._drawn_poses) - set(known):
            self.layer.remove(name)
            del self._drawn_poses[name]
        for name, pose in known.items():
            T, is_chosen = pose.T_camera_board, name == chosen
            assert T is not None and board
            key = (pose.state, T.tobytes(), bool(pose.thumbnail), is_chosen, str(board))
            if self._drawn_poses.get(name) != key:
                self._drawn_poses[name] = key
                colour, width = _STATES[pose.state][1], 4.0 if is_chosen else 2.0
                # boards lie close together: the names of all of them would lie on each other
                image, label = rectified(pose, board, camera), name if is_chosen else ""
                picture = self.layer.board(
                    name, T, board.outline(), colour, width, picture=image, label=label
                )
                if picture is not None:
                    self.react(picture.on_click, partial(self._chosen.choose, name))

    def _play_sound(self, poses: tuple[PoseView, ...], hands_free: bool) -> None:
        """Play a sound for the result of the last pose, as the operator is looking at the board."""
        states: dict[str, str] = {pose.name: pose.state for pose in poses}
        if hands_free and self._states:
            news = [state for name, state in states.items() if self._states.get(name, "") != state]
            if "refused" in news:
                self._sound.play("bad")
            elif "good" in news:
                self._sound.play("good")
            elif "judging" in news:
                self._sound.play("captured")
        self._states = states

    # requests

    def _request_action(self, action: str) -> None:
        """Request the action of a button for the chosen pose: exclude, include, retake or
        delete."""
        if name := self._chosen.value:
            self._actions[action](name)
        else:
            self.context.notify("info", "Capture a pose first.")

    def _delete(self, name: str) -> None:
        """Request that a pose be deleted, after a question where the calibration uses it."""
        pose = self.snapshot.pose(name)
        if pose is None or pose.state != "used":
            self._operator.delete(name)
            return
        self._question.ask(
            f"The calibration uses {name}. Without it the calibration is out of date, and so are"
            " the clouds and merges made with it.",
            f"Delete {name}",
            partial(self._operator.delete, name),
        )

    def _drag_board(self, T_camera_centre: np.ndarray) -> None:
        """Move the simulated board while its handle is dragged, at most every `_DRAG_S`."""
        self._dragged = time.monotonic()
        if self._dragged - self._sent > _DRAG_S:
            self._sent = self._dragged
            self._place_board(T_camera_centre)

    def _place_board(self, T_camera_centre: np.ndarray) -> None:
        """Place the simulated board where its handle is, T (4, 4) mm of the board's centre."""
        self._operator.place("board", T_camera_centre @ np.linalg.inv(self._T_board_centre))


def pose_table(poses: Sequence[PoseView]) -> Html:
    """List all poses, the latest first, with their state and its reason."""
    if not poses:
        return note("None yet.")
    rows = []
    for pose in reversed(poses):
        rms = f"{pose.rms_px[0]:.2f} / {pose.rms_px[1]:.2f} px" if pose.rms_px else ""
        state = coloured(pose.state, _STATES[pose.state][0], bold=True)
        why = f'<div style="color:var(--mantine-color-dimmed)">{to_html(pose.why or rms)}</div>'
        rows.append(
            '<div style="display:flex;gap:0.6em;align-items:center;padding:0.25em 0;'
            'border-top:1px solid var(--mantine-color-default-border)">'
            f"{thumbnail(pose.thumbnail, 52, pose.name)}"
            f'<div style="min-width:0"><b>{to_html(pose.name)}</b>&ensp;{state}{why}</div></div>'
        )
    return paragraph(Html(f'<div style="max-height:15em;overflow-y:auto">{"".join(rows)}</div>'))


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
