"""Step 3: hold the board where it is suggested, and capture; each pose is judged at once."""

import time
from typing import Any

import numpy as np
import viser

from slviewer.calibration.next_pose import GOAL_POSES, Coverage
from slviewer.gui.import_inputs import ImportInputs
from slviewer.gui.inputs import Choice, RestoreButton, SessionValue, change
from slviewer.gui.panel import PanelContext, StepPanel
from slviewer.gui.pose_list import TONES, PoseBoards, pose_table
from slviewer.gui.preview import board_html, draw_preview, exposure_html, legend
from slviewer.gui.scene import GHOST, Stroke
from slviewer.gui.widgets import (
    Html,
    Picture,
    Sound,
    Text,
    alert,
    coloured,
    paragraph,
    thumbnail,
    to_html,
)
from slviewer.target.board import Board
from slviewer.wizard.snapshot import PoseView, PreviewView, SessionView, Snapshot

LAYER, WORLD = "poses", "board"
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


def coverage_chart(coverage: Coverage) -> Html:
    """Return three small charts side by side; a field is full once GOAL_POSES poses cover it."""
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
        f'<div><div style="color:var(--mantine-color-dimmed);margin-bottom:0.2em">{to_html(title)}'
        f"</div>{chart}</div>"
        for title, chart in (
            ("Image", _draw_grid(coverage.cells)),
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


class PosesPanel(StepPanel):
    """Panel of the step Poses."""

    key = "poses"
    layers = (LAYER, WORLD)

    def __init__(self, context: PanelContext) -> None:
        super().__init__(context)
        self._board: Board | None = None
        self._states: dict[str, str] = {}
        self._drawn_session: Any = None
        self._is_counting = False
        self._dragged = self._sent = 0.0
        self._ghost_px: np.ndarray | None = None
        self._world: np.ndarray | None = None
        self._target = self._latest = ""

    def build(self) -> None:
        """Create the live image, the buttons, the coverage and the list of poses."""
        gui, context, operator = self._gui, self._context, self._operator
        self._boards = PoseBoards(context.scene, LAYER, self._select_pose)
        self._picture = Picture(gui)
        self._countdown = Text(gui)
        self._other_object = Text(gui)
        self._place = context.button(
            "Place board", operator.place_at_suggestion, viser.Icon.TARGET_ARROW, "cyan",
            visible=False,
            hint="Moves the simulated board to the suggested pose",
        )  # fmt: skip
        self._capture = context.button(
            "Capture pose", operator.capture_pose, viser.Icon.CAMERA, None, hint="Key: C"
        )
        self._hotkey = gui.add_command(
            "Capture pose", hotkey="C", icon=viser.Icon.CAMERA, disabled=True
        )
        self._hotkey.on_trigger(context.callback(operator.capture_pose))
        self._hands_free = gui.add_checkbox(
            "Hands-free", False, hint="Captures whenever the board is held still"
        )
        self._hands_free_value = SessionValue(self._hands_free)
        self._hands_free.on_update(
            context.callback(
                lambda: operator.set_hands_free(bool(self._hands_free.value)), by_user=True
            )
        )
        self._accuracy = Text(gui)
        self._wanted = gui.add_number(
            "Sigma, mm", 0.0, min=0.0, max=10.0, step=0.001,
            hint="Goal: predicted 3D standard deviation at which no further pose is suggested; "
            "0: the default",
        )  # fmt: skip
        self._wanted_value = SessionValue(self._wanted)
        self._wanted.on_update(
            context.callback(
                lambda: operator.set_wanted_sigma(float(self._wanted.value) or None), by_user=True
            )
        )
        self._coverage = Text(gui)
        with gui.add_folder("Captured poses"):
            self._table = Text(gui)
            self._chosen = Choice(gui, "Pose")
            self._chosen.on_change(context.callback(self._draw_choice))
            self._detail = Text(gui)
            actions = gui.add_button_group("Action", ("Exclude", "Include", "Retake", "Delete"))
            actions.on_click(context.callback(lambda: self._request_action(actions.value)))
            self._restore = RestoreButton(context)
        self._import = ImportInputs(context, "calibration")
        self._sound = Sound(gui)

    def draw(self, snapshot: Snapshot) -> None:
        """Show the poses, coverage and suggestion of a snapshot."""
        session = snapshot.session
        target = session.target if session else ""
        if target != self._target:
            self._target, self._board = target, Board.parse(target) if target else None
            self._world = None
        change(self._capture, disabled=snapshot.rig.state != "open" or self._board is None)
        can_place = (
            session is not None and session.suggestion is not None and session.pending_plan is None
        )
        change(self._place, visible=snapshot.world is not None, disabled=not can_place)
        self._hands_free_value.update(snapshot.hands_free)
        self._draw_world(snapshot)
        self._import.draw(snapshot)
        if session is self._drawn_session:
            return
        self._drawn_session = session
        poses = session.poses if session else ()
        self._coverage.set(coverage_chart(session.coverage) if session and session.coverage else "")
        self._draw_accuracy(session)
        self._draw_ghost(session)
        self._play_sound(poses, snapshot.hands_free)
        latest = poses[-1].name if poses else ""
        self._chosen.offer([(pose.name, pose.name) for pose in reversed(poses)])
        if latest and latest != self._latest:
            self._chosen.choose(latest)
        self._latest = latest
        self._table.set(pose_table(poses))
        self._restore.offer(session.deleted_poses if session else ())
        self._draw_choice(snapshot)

    def draw_preview(self, preview: PreviewView) -> None:
        """Show the live image with the detected board, and the countdown of a hands-free
        capture."""
        hint = (
            coloured("Dashed blue: hold the board here", "info")
            if self._ghost_px is not None
            else Html("")
        )
        self._picture.set(
            draw_preview(preview, self._board, self._ghost_px),
            legend(preview, board_html(preview, self._board), exposure_html(preview), hint),
        )
        count = preview.countdown_s
        if count is None:
            self._countdown.set("")
        else:
            if not self._is_counting:
                self._sound.play("tick")
            text = to_html(f"Hold still: {max(count, 0):.1f} s")
            self._countdown.set(alert(Html(f'<b style="font-size:1.3rem">{text}</b>'), "info"))
        self._is_counting = count is not None

    def show(self, visible: bool) -> None:
        """Show or hide the layers; the hotkey works only while shown."""
        super().show(visible)
        self._hotkey.disabled = not visible
        self._drawn_session = None

    # drawing

    def _draw_accuracy(self, session: SessionView | None) -> None:
        """Show the predicted standard deviation and the goal."""
        if session is None or session.plan is None or session.plan.sigma_mm is None:
            self._accuracy.set("")
        else:
            plan = session.plan
            text = f"Predicted sigma {plan.sigma_mm:.3f} mm, goal {session.wanted_mm:.3f} mm"
            if session.enough:
                self._accuracy.write(f"{text}: reached.", "good")
            else:
                following = (
                    f"; {plan.sigma_next_mm:.3f} mm with the next pose"
                    if plan.sigma_next_mm
                    else ""
                )
                self._accuracy.write(text + following, "info")
        if session is not None and session.plan is not None:
            self._wanted_value.update(round(session.wanted_mm, 3))

    def _draw_ghost(self, session: SessionView | None) -> None:
        """Draw the suggested pose in 3D, and store its outline for the live image."""
        suggestion = session.suggestion if session and not session.enough else None
        self._ghost_px = suggestion.outline_px if suggestion else None
        if suggestion is None or self._board is None:
            self._scene.remove(LAYER, "suggestion")
        else:
            outline = self._board.outline()
            self._scene.board(
                LAYER,
                "suggestion",
                suggestion.T_camera_board,
                outline,
                Stroke(GHOST, 4.0),
                label="next pose",
            )

    def _draw_world(self, snapshot: Snapshot) -> None:
        """Draw the simulated board and its handle, or which other object is in view."""
        world, scene = snapshot.world, self._scene
        other = "" if world is None or world.standing == "board" else world.standing
        self._other_object.write(
            other and f"In view: the {other}. Place the board first.", "warning"
        )
        if world is None or world.standing != "board" or self._board is None:
            if self._world is not None:
                scene.clear(WORLD)
                self._world = None
            return
        T, centre = world.T_camera_object, self._get_board_centre(self._board)
        if self._world is None:
            scene.board(WORLD, "board", T, self._board.outline(), Stroke((70, 70, 70), 3.0))
            scene.gizmo(WORLD, "handle", T @ centre, self._drag_board, self._place_board)
        elif not np.array_equal(T, self._world):
            scene.move(WORLD, "board", T)
            if time.monotonic() - self._dragged > _QUIET_S:
                scene.move(WORLD, "handle", T @ centre)
        self._world = T

    def _draw_choice(self, snapshot: Snapshot | None = None) -> None:
        """Show the details of the chosen pose, and all poses in 3D."""
        snapshot = snapshot or self._operator.snapshot()
        poses = snapshot.session.poses if snapshot.session else ()
        self._boards.draw(poses, self._board, snapshot.rig.camera, self._chosen.value)
        pose = snapshot.pose(self._chosen.value)
        if pose is None:
            self._detail.set("")
            return
        lines = [
            Html(f"<b>{to_html(pose.name)}</b>"),
            coloured(pose.state, TONES[pose.state], bold=True),
        ]
        if pose.why:
            lines.append(to_html(pose.why))
        if pose.rms_px is not None:
            lines.append(
                to_html(
                    f"Reprojection RMS: camera {pose.rms_px[0]:.3f} px, projector"
                    f" {pose.rms_px[1]:.3f} px"
                )
            )
        if pose.T_camera_board is not None:
            about = "" if pose.calibrated else "about "
            lines.append(coloured(f"Distance {about}{pose.T_camera_board[2, 3]:.0f} mm", "dim"))
        picture = thumbnail(pose.thumbnail, 150, pose.name)
        text = "".join(f"<div>{line}</div>" for line in lines)
        self._detail.set(
            paragraph(Html(f'<div style="display:flex;gap:0.8em">{picture}<div>{text}</div></div>'))
        )

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

    def _select_pose(self, name: str) -> None:
        """Choose a pose by its name."""
        self._chosen.choose(name)
        self._draw_choice()

    def _request_action(self, action: str) -> None:
        """Request the action of a button for the chosen pose: exclude, include, retake or
        delete."""
        name, operator = self._chosen.value, self._operator
        if not name:
            self._context.notify("info", "Capture a pose first.")
        elif action == "Exclude":
            operator.exclude(name)
        elif action == "Include":
            operator.include(name)
        elif action == "Retake":
            operator.retake_pose(name)
        else:
            operator.delete(name)

    def _drag_board(self, T_camera_centre: np.ndarray) -> None:
        """Move the simulated board while its handle is dragged, at most every `_DRAG_S`."""
        self._dragged = time.monotonic()
        if self._dragged - self._sent > _DRAG_S:
            self._sent = self._dragged
            self._place_board(T_camera_centre)

    def _place_board(self, T_camera_centre: np.ndarray) -> None:
        """Place the simulated board where its handle is, T (4, 4) mm of the board's centre."""
        if self._board is not None:
            self._operator.place(
                "board", T_camera_centre @ np.linalg.inv(self._get_board_centre(self._board))
            )

    @staticmethod
    def _get_board_centre(board: Board) -> np.ndarray:
        """Return T_board_centre (4, 4) mm, as the handle is at the board's centre."""
        T = np.eye(4)
        T[:3, 3] = board.outline().mean(axis=0)
        return T
