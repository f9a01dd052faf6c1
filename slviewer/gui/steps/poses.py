"""Step 3: hold the board where it is asked for, and capture; see at once whether the pose can be used."""

import time
from typing import Any

import numpy as np
import viser

from slviewer.calibration.next_pose import GOAL_POSES, Coverage
from slviewer.gui.import_inputs import ImportInputs
from slviewer.gui.inputs import Choice, Follows, change
from slviewer.gui.panel import Stage
from slviewer.gui.pose_list import PoseBoards, pose_table
from slviewer.gui.preview import board_words, drawn, legend, light_words
from slviewer.gui.scene import GHOST
from slviewer.gui.undelete import Undelete
from slviewer.gui.widgets import Html, Picture, Sound, Words, block, boxed, cell, thumbnail, toned
from slviewer.target.board import Board
from slviewer.wizard.snapshot import Foreseen, PoseView, PreviewView, Snapshot

LAYER, WORLD = "poses", "board"
_DRAG_S = 0.15  # between two places that a dragged board is brought to
_QUIET_S = 1.0  # after which the gizmo follows the board again


_COLOURS = ("var(--mantine-color-gray-light)", "var(--mantine-color-green-3)", "var(--mantine-color-green-6)")
_ARROWS = {"facing": (1, 1, "●"), "top away": (0, 1, "▲"), "right away": (1, 2, "▶"), "bottom away": (2, 1, "▼"),
           "left away": (1, 0, "◀")}  # fmt: skip


def coverage_chart(coverage: Coverage) -> Html:
    """Three small charts side by side; a field is full once GOAL poses cover it."""
    image = _grid(coverage.cells, 17, 17)
    depths = "".join(
        f'<div style="display:flex;align-items:center;gap:0.4em">{_field(n, 44, 15)}<span>{name}</span></div>'
        for name, n in zip(("near", "middle", "far"), coverage.depths, strict=True)
    )
    tilts = np.full((3, 3), -1)
    for (row, column, _), n in zip(_ARROWS.values(), coverage.tilts, strict=True):
        tilts[row, column] = n
    arrows = {(row, column): arrow for row, column, arrow in _ARROWS.values()}
    tilted = _grid(tilts, 17, 17, arrows)
    near, far = coverage.range_mm
    charts = "".join(
        f'<div><div style="color:var(--mantine-color-dimmed);margin-bottom:0.2em">{cell(title)}</div>{chart}</div>'
        for title, chart in (
            ("In the image", image),
            (f"Depth, {near:.0f} to {far:.0f} mm", depths),
            ("Tilted away", tilted),
        )
    )
    share = 100 * coverage.share
    title = toned(f"Coverage {share:.0f} %", "good" if share > 90 else "plain", bold=True)
    return block(
        Html(f'<div>{title}</div><div style="display:flex;justify-content:space-between;gap:0.8em">{charts}</div>')
    )


def _grid(counts: np.ndarray, width: int, height: int, marks: dict[tuple[int, int], str] | None = None) -> str:
    rows = "".join(
        '<div style="display:flex;gap:2px;margin-bottom:2px">'
        + "".join(_field(n, width, height, (marks or {}).get((i, j), "")) for j, n in enumerate(row))
        + "</div>"
        for i, row in enumerate(counts)
    )
    return f"<div>{rows}</div>"


def _field(count: int, width: int, height: int, mark: str = "") -> str:
    colour = "transparent" if count < 0 else _COLOURS[min(int(count), GOAL_POSES)]
    style = (
        f"width:{width}px;height:{height}px;border-radius:2px;background:{colour};font-size:9px;line-height:{height}px"
    )
    return f'<div style="{style};text-align:center">{mark}</div>'


class Panel:
    """Target poses."""

    key = "poses"

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._board: Board | None = None
        self._target = ""
        self._states: dict[str, str] = {}
        self._session: Any = None
        self._counting = False
        self._dragged = 0.0
        self._sent = 0.0
        self._ghost_px: np.ndarray | None = None
        self._world: np.ndarray | None = None
        self._latest = ""

    def build(self) -> None:
        """Picture, capture, coverage, the poses."""
        gui, stage = self._stage.gui, self._stage
        operator = stage.operator
        self._boards = PoseBoards(stage.scene, LAYER, self._select)
        self._picture = Picture(gui)
        self._counts = Words(gui)
        self._stands = Words(gui)
        self._place = gui.add_button("Place at suggestion", icon=viser.Icon.TARGET_ARROW, color="cyan", visible=False)
        self._place.on_click(stage.safely(operator.place_at_suggestion))
        self._capture = gui.add_button("Capture pose", icon=viser.Icon.CAMERA, hint="Key: C")
        self._capture.on_click(stage.safely(operator.capture_pose))
        self._key = gui.add_command("Capture pose", hotkey="C", icon=viser.Icon.CAMERA, disabled=True)
        self._key.on_trigger(stage.safely(operator.capture_pose))
        self._hands_free = gui.add_checkbox("Hands-free", False, hint="Captures when the board is held still")
        self._follows = Follows(self._hands_free)
        self._hands_free.on_update(stage.safely_with(self._switch))
        how = "Hands-free captures by itself when the board is held still; the key C captures too."
        Words(gui).say(how, "dim")
        self._foreseen = Words(gui)
        self._wanted = gui.add_number(
            "Sigma wanted, mm", 0.0, min=0.0, max=10.0, step=0.001,
            hint="Poses are asked for until the calibration is predicted to be this sure of points; 0: what usually "
            "suffices",
        )  # fmt: skip
        self._wants = Follows(self._wanted)
        self._wanted.on_update(stage.safely_with(self._want))
        self._coverage = Words(gui)
        with gui.add_folder("Captured poses"):
            self._table = Words(gui)
            self._chosen = Choice(gui, "Pose")
            self._chosen.on_change(stage.safely(self._another))
            self._detail = Words(gui)
            self._acts = gui.add_button_group("This pose", ("Exclude", "Include", "Retake", "Delete"))
            self._acts.on_click(stage.safely(lambda: self._act(self._acts.value)))
            self._undelete = Undelete(stage)
        self._import = ImportInputs(stage, "calibration")
        self._sound = Sound(gui)

    def draw(self, snapshot: Snapshot) -> None:
        """Poses, coverage and the suggestion."""
        session = snapshot.session
        target = session.target if session else ""
        if target != self._target:
            self._target, self._board = target, Board.parse(target) if target else None
            self._world = None
        change(self._capture, disabled=snapshot.rig.state != "open" or self._board is None)
        change(self._place, visible=snapshot.world is not None)
        change(self._place, disabled=session is None or session.suggestion is None or session.planning)
        self._follows.tell(snapshot.hands_free)
        self._draw_world(snapshot)
        self._import.draw(snapshot)
        if session is self._session:
            return
        self._session = session
        poses = session.poses if session else ()
        self._coverage.set(coverage_chart(session.coverage) if session and session.coverage else "")
        self._draw_foreseen(session.foreseen if session else None)
        self._draw_ghost(snapshot)
        self._sound_for(poses, snapshot.hands_free)
        latest = poses[-1].name if poses else ""
        self._chosen.offer([(pose.name, pose.name) for pose in reversed(poses)])
        if latest and latest != self._latest:
            self._chosen.choose(latest)
        self._latest = latest
        self._table.set(pose_table(poses))
        self._undelete.offer(session.deleted_poses if session else ())
        self._boards.draw(poses, self._board, snapshot.rig.camera, self._chosen.value)
        self._draw_chosen(snapshot)

    def draw_preview(self, preview: PreviewView) -> None:
        """The board as it is held, and where it should be."""
        where = toned("Dashed blue: hold the board here", "info") if self._ghost_px is not None else Html("")
        self._picture.set(
            drawn(preview, self._board, self._ghost_px),
            legend(preview, board_words(preview, self._board), light_words(preview), where),
        )
        count = preview.countdown_s
        if count is None:
            self._counts.set("")
        else:
            if not self._counting:
                self._sound.play("tick")
            self._counts.set(boxed(Html(f'<b style="font-size:1.3rem">Hold still: {max(count, 0):.1f} s</b>'), "info"))
        self._counting = count is not None

    def shown(self, visible: bool) -> None:
        """Its boards stand in the scene while it is shown, and its key works."""
        for layer in (LAYER, WORLD):
            self._stage.scene.show(layer, visible)
        self._key.disabled = not visible
        self._session = None

    # drawing

    def _draw_foreseen(self, foreseen: Foreseen | None) -> None:
        if foreseen is not None:
            self._wants.tell(round(foreseen.wanted_mm, 3))
        if foreseen is None or foreseen.sigma_mm is None:
            self._foreseen.set("")
            return
        words = f"Predicted sigma {foreseen.sigma_mm:.3f} mm, wanted {foreseen.wanted_mm:.3f} mm"
        if foreseen.enough:
            self._foreseen.say(f"{words}: enough. Calibrate.", "good")
        else:
            then = "" if foreseen.next_mm is None else f"; {foreseen.next_mm:.3f} mm with the next pose"
            self._foreseen.say(words + then, "info")

    def _draw_ghost(self, snapshot: Snapshot) -> None:
        session = snapshot.session
        suggestion = session.suggestion if session and not session.enough else None
        self._ghost_px = suggestion.outline_px if suggestion else None
        if suggestion is None or self._board is None:
            self._stage.scene.remove(LAYER, "suggestion")
        else:
            self._stage.scene.board(
                LAYER, "suggestion", suggestion.T_camera_board, self._board.outline(), GHOST, label="hold it here",
                width_px=4.0,
            )  # fmt: skip

    def _draw_world(self, snapshot: Snapshot) -> None:
        """The simulated board and its handle."""
        world, scene = snapshot.world, self._stage.scene
        other = "" if world is None or world.standing == "board" else world.standing
        self._stands.say(other and f"The {other} stands before the rig: place the board at the suggestion.", "warning")
        if world is None or world.standing != "board" or self._board is None:
            if self._world is not None:
                scene.clear(WORLD)
                self._world = None
            return
        T, middle = world.T_camera_thing, self._middle(self._board)
        if self._world is None:
            scene.board(WORLD, "board", T, self._board.outline(), (70, 70, 70), width_px=3.0)
            scene.gizmo(WORLD, "handle", T @ middle, self._drag, self._drop)
        elif not np.array_equal(T, self._world):
            scene.move(WORLD, "board", T)
            if time.monotonic() - self._dragged > _QUIET_S:
                scene.move(WORLD, "handle", T @ middle)
        self._world = T

    def _draw_chosen(self, snapshot: Snapshot) -> None:
        pose = snapshot.pose(self._chosen.value)
        if pose is None:
            self._detail.set("")
            return
        words = [Html(f"<b>{cell(pose.name)}</b>"), toned(pose.state, _tone(pose), bold=True)]
        if pose.why:
            words.append(cell(pose.why))
        if pose.rms_px is not None:
            words.append(cell(f"reprojection RMS: camera {pose.rms_px[0]:.3f} px, projector {pose.rms_px[1]:.3f} px"))
        if pose.T_camera_board is not None:
            words.append(toned(f"{'' if pose.calibrated else 'about '}{pose.T_camera_board[2, 3]:.0f} mm away", "dim"))
        picture = thumbnail(pose.thumbnail, 150, pose.name)
        text = "".join(f"<div>{word}</div>" for word in words)
        self._detail.set(block(Html(f'<div style="display:flex;gap:0.8em">{picture}<div>{text}</div></div>')))

    def _sound_for(self, poses: tuple[PoseView, ...], hands_free: bool) -> None:
        """Tell the operator, whose eyes are on the board, how the last pose ended."""
        states: dict[str, str] = {pose.name: pose.state for pose in poses}
        if hands_free and self._states:
            news = [state for name, state in states.items() if self._states.get(name, "") != state]
            if "refused" in news:
                self._sound.play("bad")
            elif "good" in news:
                self._sound.play("good")
            elif "judging" in news:
                self._sound.play("taken")
        self._states = states

    # asking

    def _another(self) -> None:
        snapshot = self._stage.operator.snapshot()
        self._draw_chosen(snapshot)
        if snapshot.session is not None:
            self._boards.draw(snapshot.session.poses, self._board, snapshot.rig.camera, self._chosen.value)

    def _select(self, name: str) -> None:
        self._chosen.choose(name)
        self._draw_chosen(self._stage.operator.snapshot())

    def _act(self, what: str) -> None:
        name, operator = self._chosen.value, self._stage.operator
        if not name:
            self._stage.tell("info", "Capture a pose first.")
            return
        {
            "Exclude": operator.exclude,
            "Include": operator.include,
            "Retake": operator.retake_pose,
            "Delete": operator.delete,
        }[what](name)

    def _want(self, event: Any) -> None:
        if event.client is not None:
            self._stage.operator.want_sigma(float(self._wanted.value) or None)

    def _switch(self, event: Any) -> None:
        if event.client is not None:
            self._stage.operator.set_hands_free(bool(self._hands_free.value))

    def _drag(self, T_camera_middle: np.ndarray) -> None:
        self._dragged = time.monotonic()
        if self._dragged - self._sent > _DRAG_S:
            self._sent = self._dragged
            self._drop(T_camera_middle)

    def _drop(self, T_camera_middle: np.ndarray) -> None:
        if self._board is not None:
            self._stage.operator.place("board", T_camera_middle @ np.linalg.inv(self._middle(self._board)))

    @staticmethod
    def _middle(board: Board) -> np.ndarray:
        """T_board_middle (4, 4): the handle stands where a hand would hold the board's centre."""
        T = np.eye(4)
        T[:3, 3] = board.outline().mean(axis=0)
        return T


def _tone(pose: PoseView) -> Any:
    return {"good": "good", "used": "good", "refused": "error", "left out": "warning"}.get(pose.state, "dim")
