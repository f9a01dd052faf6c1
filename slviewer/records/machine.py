"""Where a machine placed the rig or the part, and where the camera is on it."""

from collections.abc import Mapping

import msgspec

from slviewer.records.record import Cell, Column, Matrix4, Record, Table, Vector

REPORTED_RATIO = 1.5
"""Residuals over their prediction above which they are reported."""


class MachinePose(Record, frozen=True, kw_only=True):
    """Where a robot, a CMM or a stage was while a capture was taken.

    ``T_base_machine`` maps points, mm, of the flange (``of`` robot) or of the camera itself (``of``
    scan) into the machine's base; ``covariance`` of a small turn (rad) and shift (mm) in that
    frame, else ``sigma_mm``, ``sigma_deg``: standard deviations of each axis;
    ``convention``: of the ``file`` that states it.
    """

    kind = "machine-pose"
    title = "Poses from a machine"
    has_figures = False  # they come from a file
    T_base_machine: Matrix4
    covariance: list[list[float]] = []
    of: str
    sigma_mm: float
    sigma_deg: float
    file: str
    convention: str

    @classmethod
    def tables(cls, found: Mapping[str, "MachinePose"]) -> list[Table]:  # type: ignore[override]
        """Return one table with a line for each capture."""
        rows = [
            {
                "capture": name,
                **{
                    Column(axis, "mm"): row[3]
                    for axis, row in zip("xyz", each.T_base_machine, strict=False)
                },
                "of": each.of,
                "file": each.file,
            }
            for name, each in found.items()
        ]
        notes = {
            f"{each.convention}; standard deviation {each.sigma_mm:g} mm, {each.sigma_deg:g}"
            " degrees."
            for each in found.values()
        }
        return [Table.of(rows, cls.title, sorted(notes))]


class HandEyePose(msgspec.Struct, frozen=True):
    """How far the board is from its place at one pose, mm and degrees; ``gain_percent``: by which U
    is larger without the pose, None where the others determine nothing; ``repeats``: an earlier
    pose."""

    shift_mm: float
    turn_deg: float
    gain_percent: float | None = None
    repeats: str = ""


class PlannedPose(msgspec.Struct, frozen=True):
    """A pose that would help, with its angles A, B and C about z, y' and x'', degrees, and U of
    translation and rotation once it and those before it are captured."""

    T_base_flange: Matrix4
    abc_deg: Vector
    U_mm: float
    U_deg: float


class HandEye(Record, frozen=True, kw_only=True):
    """Where the camera is on the flange (eye in hand), or in the base of the robot that carries the
    board (eye to hand).

    ``T_carrier_camera`` maps the camera's points, mm, into the flange or the base;
    ``T_other_board`` the board's, from the middle of its features, into the base or the flange.
    ``U_mm``, ``U_deg``: expanded uncertainty (k = 2) of translation and rotation, which their
    errors exceed in 5 % of all cases; ``U_axes_mm``, ``U_axes_deg``: of each axis;
    ``covariance``: of a small turn (rad) and shift (mm) in the carrier's frame. ``ratio``:
    residuals over what the robot's and the camera's uncertainties predict; above 1 it raises U.
    ``poses``: residuals; ``excluded``: poses that contradict the others, ``skipped``: captures
    without a board.
    """

    kind = "hand-eye"
    title = "Hand-eye calibration"
    is_of_captures = False
    mounting: str
    model: str = ""
    frame: str = ""
    T_carrier_camera: Matrix4
    T_other_board: Matrix4
    U_mm: float
    U_deg: float
    U_axes_mm: Vector
    U_axes_deg: Vector
    covariance: list[list[float]]
    ratio: float
    poses: dict[str, HandEyePose]
    excluded: dict[str, str] = {}
    skipped: dict[str, str] = {}
    plan: list[PlannedPose] = []

    @property
    def carrier(self) -> str:
        """What the camera is fixed to."""
        return "flange" if self.mounting == "eye-in-hand" else "base"

    @property
    def is_good(self) -> bool:
        """Whether all poses agree within their uncertainties."""
        return self.ratio <= REPORTED_RATIO and not self.excluded

    def summary(self) -> str:
        """Return the camera's place and its uncertainty."""
        x, y, z = (row[3] for row in self.T_carrier_camera[:3])
        return (
            f"camera at ({x:.2f}, {y:.2f}, {z:.2f}) mm of the {self.carrier}, U {self.U_mm:.2g} mm"
            f" and {self.U_deg:.2g}° (k = 2)"
        )

    def figures(self) -> dict[str, float]:
        """Return the translation, U and the residuals' ratio."""
        place = {f"{a}_mm": row[3] for a, row in zip("xyz", self.T_carrier_camera, strict=False)}
        return {**place, "U_mm": self.U_mm, "U_deg": self.U_deg, "ratio": self.ratio}

    def list_tables(self, name: str) -> list[Table]:
        """Return the transform with U, the residuals pose by pose, and the planned poses."""
        transform = [
            {
                "axis": axis,
                Column("translation", "mm"): Cell(row[3], "strong"),
                Column("U", "mm", digits=4): u_mm,
                Column("U of the rotation", "°", digits=4): u_deg,
                **{Column(f"R {k}", digits=6): row[i] for i, k in enumerate("xyz")},
            }
            for axis, row, u_mm, u_deg in zip(
                "xyz", self.T_carrier_camera, self.U_axes_mm, self.U_axes_deg, strict=False
            )
        ]
        residuals = [
            {
                "pose": pose,
                Column("shift", "mm"): each.shift_mm,
                Column("turn", "°", digits=4): each.turn_deg,
                Column("U without it", "%", digits=1): each.gain_percent,
                "repeats": each.repeats,
            }
            for pose, each in self.poses.items()
        ]
        planned = [
            {
                "pose": k,
                **{Column(a, "mm", digits=1): row[3]
                   for a, row in zip("xyz", each.T_base_flange, strict=False)},
                **{Column(a, "°", digits=1): angle
                   for a, angle in zip("ABC", each.abc_deg, strict=True)},
                Column("U then", "mm"): each.U_mm,
                Column("U then", "°", digits=4): each.U_deg,
            }
            for k, each in enumerate(self.plan, 1)
        ]  # fmt: skip
        caption = f"Hand-eye calibration {name}: the camera in the robot's {self.carrier}"
        tables = [
            Table.of(transform, caption, self._list_notes()),
            Table.of(
                residuals, "The board's distance from its place, pose by pose"
            ).without_empty(),
        ]
        if planned:
            note = "See that the robot reaches them and the camera then sees the whole board."
            tables.append(Table.of(planned, "Poses of the flange that would help most", [note]))
        return tables

    def _list_notes(self) -> list[str]:
        notes = [
            f"U {self.U_mm:.2g} mm and {self.U_deg:.2g}° (k = 2); {self.mounting}, frame:"
            f" {self.frame}; residuals {self.ratio:.2f} times what the uncertainties predict."
        ]
        if self.ratio > REPORTED_RATIO:
            notes.append(
                "U is raised by this factor: state the robot's accuracy, not its repeatability, by"
                " --sigma-mm and --sigma-deg, or see that nothing moved between pose and capture."
            )
        if idle := [
            f"{name} repeats {each.repeats}" if each.repeats else name
            for name, each in self.poses.items()
            if each.repeats or (each.gain_percent is not None and each.gain_percent < 1)
        ]:
            notes.append(f"Poses that move nothing new: {', '.join(idle)}.")
        notes += [f"Excluded: {name}: {why}." for name, why in self.excluded.items()]
        notes += [f"Skipped: {name}: {why}." for name, why in self.skipped.items()]
        return notes


class RigPlace(msgspec.Struct, frozen=True):
    """The place of a rig in the frame of the reference: ``T_reference_rig`` maps its clouds, mm.

    ``covariance``: of a small turn (rad) about the ``middle``, mm, of what both saw, and of a shift
    (mm); ``U_mm`` and ``U_deg``: expanded uncertainty (k = 2) there; ``ratio``: residuals over what
    is predicted, None of a single capture; ``shift_mm``, ``turn_deg``: residual of each capture.
    """

    session: str
    model: str
    frame: str
    T_reference_rig: Matrix4
    covariance: list[list[float]]
    middle: Vector
    U_mm: float
    U_deg: float
    ratio: float | None
    shift_mm: dict[str, float]
    turn_deg: dict[str, float]


class RigRelation(Record, frozen=True, kw_only=True):
    """Where other rigs are in the frame of this session's, from what all saw at once (``by``:
    board, spheres or part); ``scans``: of theirs, as they are called here."""

    kind = "rigs"
    title = "Rigs in one frame"
    is_of_captures = False
    by: str
    rigs: dict[str, RigPlace]
    scans: dict[str, list[str]] = {}

    def summary(self) -> str:
        """Return the uncertainty of each rig's place."""
        places = (f"{n} U {r.U_mm:.2g} mm and {r.U_deg:.2g}°" for n, r in self.rigs.items())
        return f"in one frame: {'; '.join(places)} (k = 2)"

    def figures(self) -> dict[str, float]:
        """Return U of each rig's place."""
        return {
            f"{name} {key}": getattr(rig, key)
            for name, rig in self.rigs.items()
            for key in ("U_mm", "U_deg")
        }

    def list_tables(self, name: str) -> list[Table]:
        """Return the place of each rig, and the residual of each capture."""
        places = [
            {
                "rig": rig,
                **{
                    Column(axis, "mm"): row[3]
                    for axis, row in zip("xyz", each.T_reference_rig, strict=False)
                },
                Column("U", "mm", digits=4): Cell(each.U_mm, "strong"),
                Column("U", "°", digits=4): each.U_deg,
                Column("residuals over prediction", digits=2): each.ratio,
            }
            for rig, each in self.rigs.items()
        ]
        residuals = [
            {
                "rig": rig,
                "capture": capture,
                Column("shift", "mm"): shift,
                Column("turn", "°", digits=4): each.turn_deg[capture],
            }
            for rig, each in self.rigs.items()
            for capture, shift in each.shift_mm.items()
        ]
        notes = ["U (k = 2) is stated in the middle of what the rigs saw."]
        if single := [rig for rig, each in self.rigs.items() if each.ratio is None]:
            notes.append(
                f"A single capture relates {', '.join(single)}, and nothing checks it: name more."
            )
        notes += [f"Scans of {rig}: {', '.join(each)}." for rig, each in self.scans.items()]
        shown = [Table.of(places, f"{self.title} {name}, by the {self.by}", notes).without_empty()]
        return [*shown, Table.of(residuals, "Residual of each capture")]
