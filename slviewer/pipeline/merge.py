"""Registering scans of one object, and fusing them into one surface."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np

from slviewer.errors import InputError, UsageError
from slviewer.evaluation import letter
from slviewer.geometry.rigid import rotation_angle
from slviewer.pipeline.align import load_places
from slviewer.pipeline.capture_clouds import capture_cloud, check_capture_sizes
from slviewer.pipeline.capture_phases import capture_texture, decode_captures
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings, stage
from slviewer.pipeline.models import ModelName, check_accepted, frame_of, load_model, preferred_model, warn_if_stale
from slviewer.pipeline.open_session import SessionLike, next_number, opened, placed_file
from slviewer.pipeline.scale import describe_scale, scale_factor
from slviewer.pipeline.scan_edits import resolve_region, restrict_cloud, restriction_notes
from slviewer.reconstruction.cloud import Cloud
from slviewer.registration.markers import MeasuredMarkers, fit_marker_pose, marker_notes, measure_markers
from slviewer.registration.multiway import MultiwayAlignment, Pair, Starts
from slviewer.registration.pairwise import Registration
from slviewer.registration.picked import fit_picked_start
from slviewer.registration.refusal import Refused
from slviewer.registration.static_scene import ObjectAlignment, SceneContradiction, register_object
from slviewer.registration.turntable import TurntableAxis, shortest_turn
from slviewer.session.ply import write_ply
from slviewer.session.scan_edits import restriction_inputs
from slviewer.session.store import Session
from slviewer.surface.fuse import Fused, fuse

MAX_CONTRADICTION_SHARE = 0.01
"""Share of contradicting points from which on a pair is warned about: noise alone has fewer than one in a million."""
MAT_MARKERS, MAT_TURN_DEG = 3, 3.0
"""Markers in common from which on a turntable's mat is used, and how far its turn may be from the table's."""
StartKind = Literal["features", "turntable", "identity", "placed", "markers"]
Picked = Mapping[Pair, tuple[np.ndarray, np.ndarray]]
"""Of a pair (scan, onto): three or more points (n, 3) mm on either, in their cameras' frames."""


@dataclass(frozen=True, eq=False)
class Merge:
    """Scans aligned to one of them, the surface that they were fused to, and its file.

    ``scale`` describes the correction of scale in it; ``result_name`` is the stored result, if any.
    ``static_points``: by scan, how many points stand still while the object moves; ``contradictions`` of each pair.
    ``restrictions``: edits and region that the scans were cut by, in words, and their hashes.
    In the file ``seen_by`` counts the scans that a point is the mean of, and ``source`` numbers the one that its place
    comes from, 0 for the first of ``fused.names``.
    """

    alignment: MultiwayAlignment
    fused: Fused
    clouds: Mapping[str, Cloud]
    out: Path
    scale: str = ""
    result_name: str = ""
    static_points: Mapping[str, int] = field(default_factory=dict)
    contradictions: Mapping[Pair, SceneContradiction] = field(default_factory=dict)
    restrictions: tuple[str, ...] = ()
    restriction_inputs: Mapping[str, str] = field(default_factory=dict)

    @property
    def reference(self) -> str:
        """The scan whose frame the surface is in."""
        return self.alignment.reference

    @property
    def pairs(self) -> Mapping[str, Registration]:
        """The registration of every scan but the reference to it, by name."""
        return self.alignment.on_reference()

    def to_json(self) -> dict[str, Any]:
        """The contract of ``merge --json``: every scan on the reference, every registered pair, the loops, what was
        dropped or refused, and the surface."""
        alignment = self.alignment
        return {
            "reference": alignment.reference,
            "pairs": {name: _registration_figures(pair) for name, pair in self.pairs.items()},
            "registered": [
                {"scan": a, "onto": b, **_registration_figures(pair)} for (a, b), pair in alignment.pairs.items()
            ],
            "loops": [
                {
                    "scans": list(loop.names),
                    "error_mm": loop.before.shift_mm,
                    "error_deg": loop.before.turn_deg,
                    "left_mm": loop.after.shift_mm,
                    "left_deg": loop.after.turn_deg,
                }
                for loop in alignment.loops
            ],
            "dropped": [{"scan": a, "onto": b, "why": why} for (a, b), why in alignment.dropped.items()],
            "refused": [{"scan": a, "onto": b, "why": why} for (a, b), why in alignment.refused.items()],
            "markers": [
                {"scan": a, "onto": b, "ids": list(pose.ids), "moved": list(pose.moved), "rms_mm": pose.rms_mm}
                for (a, b), pose in alignment.markers.items()
            ],
            "static_points": dict(self.static_points),
            "contradictions": [
                {
                    "scan": a,
                    "onto": b,
                    "share": contradiction.share,
                    "compared": contradiction.compared,
                    "gate_mm": contradiction.gate_mm,
                }
                for (a, b), contradiction in self.contradictions.items()
            ],
            "letter_rms_mm": dict(letter.EXPERIMENT_3_ICP_RMS_MM),
            "points": len(self.fused.surface),
            "shared": self.fused.shared,
            "left_out": self.fused.excluded,
        }

    def text(self) -> str:
        """A line a pair, the loop that closes worst, what was excluded, and the surface."""
        alignment = self.alignment
        r1, r2 = letter.EXPERIMENT_3_ICP_RMS_MM.values()
        lines = [
            f"{a} -> {b}: RMS {pair.rms_mm:.3f} mm, point to point {pair.inlier_rmse_mm:.3f} mm, "
            f"overlap {100 * pair.overlap:.0f} %, standard deviations {1000 * pair.uncertainty.shift_mm:.1f} um "
            f"and {pair.uncertainty.turn_deg:.4f} degrees"
            for (a, b), pair in alignment.pairs.items()
        ]
        lines += [
            f"{a} -> {b}: {len(pose.ids)} common markers, their corners {pose.rms_mm:.3f} mm apart (RMS)"
            for (a, b), pose in alignment.markers.items()
        ]
        lines.append(f"(The Letter's three depths: point to point {r1:.2f} and {r2:.2f} mm.)")
        if alignment.loops:
            worst = alignment.loops[0]
            way = " - ".join([*worst.names, worst.names[0]])
            lines.append(
                f"loop error, the worst of {len(alignment.loops)}: {worst.before.shift_mm:.3f} mm and "
                f"{worst.before.turn_deg:.4f} degrees round {len(worst.names)} pairs ({way}); "
                f"{max(loop.after.shift_mm for loop in alignment.loops):.3f} mm at most once closed"
            )
        lines += [f"excluded: {why}" for why in alignment.dropped.values()]
        lines += [f"not registered: {a} -> {b}: {why}" for (a, b), why in alignment.refused.items()]
        if self.contradictions:
            worst_pair = max(self.contradictions.values(), key=lambda contradiction: contradiction.share)
            lines.append(
                f"contradicting points: {100 * worst_pair.share:.2g} % at most of what both scans of a pair cover lies "
                f"more than {worst_pair.gate_mm:.2g} mm in front of the other's surface"
            )
        far = {name: counts["far"] for name, counts in self.fused.excluded.items() if counts.get("far")}
        if far:
            counted = ", ".join(f"{count} points of {name}" for name, count in far.items())
            lines.append(f"removed as far from everything else: {counted}")
        lines += self.restrictions
        if self.scale:
            lines.append(self.scale)
        overlap_text = f"{100 * self.fused.shared:.0f} % of them seen by more than one scan"
        lines.append(f"{len(self.fused.surface)} points, {overlap_text} -> {self.out}")
        if self.result_name:
            lines.append(f"the session stores it as {self.result_name}: mesh, compare and measure accept that name")
        return "\n".join(lines)


def merge(
    session: SessionLike,
    captures: Sequence[str],
    reference: str,
    out: Path | str | None = None,
    *,
    model: ModelName | None = None,
    start: StartKind = "features",
    angle: float | None = None,
    axis: TurntableAxis | None = None,
    poses: Mapping[str, np.ndarray] | None = None,
    picked: Picked | None = None,
    keep_background: bool = False,
    roi: str = "",
    accept_rejected: bool = False,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> Merge:
    """Register scans to a reference scan, close their loops, and fuse them into one surface.

    Reports the uncertainty of each registered pair, how well loops close, and what was excluded, and why.

    Args:
        session: Session folder.
        captures: Names of the captures, in the order in which they were captured.
        reference: The capture whose frame the merged cloud takes.
        out: PLY file. Without it the session stores the merge as merge/1 and so on, for mesh, compare, measure and
            export, and its file is in the session's exports.
        start: Initial alignment: features estimates it from the scans; turntable uses the angles of the turntable,
            and the markers of a mat on it where the scans show them;
            identity assumes that the scans are nearly aligned already; placed takes the places that `align` found;
            markers takes coded markers (`slviewer target markers:0-23:20`) that the scans show, which also hold what
            the shape leaves open.
        angle: Degrees that the turntable turns from each capture to the next, with --start turntable; by default as
            stored with the captures of `slviewer turn`.
        model: Which calibration to use; by default the best one available.
        roi: Region of interest, outside of which points are ignored: x0,x1,y0,y1,z0,z1 in mm in the camera's frame
            of each scan (x right, y down, z away), a TOML file, or off; by default the session's.
        accept_rejected: Use the calibration although its verdict rejects it.

    Python alone: ``axis`` of the turntable, estimated where it is not given; ``poses`` (4, 4) by name, the initial
    alignment with "identity"; ``picked``, for a pair (scan, onto), three or more points (n, 3) mm on either, in their
    cameras' frames, that these pairs start from. The static background is separated from the moving object
    and excluded from the surface, unless ``keep_background``.
    """
    given = list(dict.fromkeys(captures))
    names = given if reference in given else [*given, reference]
    if len(names) < 2:
        raise UsageError(f"only {reference} was named: name the scans to merge with it")
    if out is not None:
        out = Path(out)
        if out.suffix.lower() != ".ply":
            raise UsageError(f"merged points are written as .ply, not as {out.name}: a mesh goes into other files too")
        out.parent.mkdir(parents=True, exist_ok=True)  # or it fails now, not after minutes
    if angle is not None and start != "turntable":
        raise UsageError("an angle from scan to scan is that of a turntable: give --start turntable too, or neither")
    table_deg = None if angle is None else {name: angle * k for k, name in enumerate(names)}
    is_stored = start == "placed" or (start == "turntable" and angle is None)
    if not is_stored:
        starts = _initial_alignments(names, start, table_deg, axis, poses, picked, warn)
    with opened(session, write=out is None) as store:
        if is_stored:
            poses = _load_places(store, names) if start == "placed" else poses
            table_deg = _load_table_angles(store, names) if start == "turntable" else None
            starts = _initial_alignments(names, start, table_deg, axis, poses, picked, warn)
        check_accepted(store, accept_rejected)
        fitted = load_model(store, model or preferred_model(store))
        warn_if_stale(store, warn)
        check_capture_sizes(store, names)
        scale, clouds, region = describe_scale(store, fitted.name), {}, resolve_region(store, roi)
        restrictions = restriction_notes(store, names, region)
        inputs = restriction_inputs(store, names, with_region=not roi)
        for i, (shot, frames, phases) in enumerate(decode_captures(store, names, warn)):
            progress(0.4 * i / len(names), f"reconstructing {shot.name}")
            cloud = capture_cloud(
                store,
                fitted,
                shot,
                phases,
                texture=capture_texture(shot, frames, stretch=False),
                accept_rejected=accept_rejected,
                warn=warn,
            )
            clouds[shot.name] = restrict_cloud(store, shot.name, cloud, region)
        if start == "markers":
            starts = replace(starts, markers=_measure_markers(clouds, warn))
        elif table_deg is not None:
            starts = replace(starts, markers=_measure_mat(clouds, table_deg, warn))
        registered = register_object(clouds, reference, starts, stage(progress, 0.4, 0.75, "registering"))
        alignment = registered.alignment
        for why in [
            *_list_moved_markers(alignment),
            *alignment.dropped.values(),
            *_scene_warnings(clouds, registered, keep_background),
        ]:
            warn(why)
        clouds = clouds if keep_background else dict(registered.clouds)
        left = {name: (each.covariance, each.centre) for name, each in alignment.uncertainties.items()}
        fused = fuse(clouds, alignment.T_reference_scan, stage(progress, 0.75, 0.9, "fusing"), left)
        progress(0.9, "writing")
        surface = fused.surface
        scalars = {} if surface.sigma_mm is None else {"sigma": surface.sigma_mm}
        scalars |= {"seen_by": fused.seen_by, "source": fused.source}
        frame = f"{frame_of(store, fitted.name)}, at {reference}"
        notes = (f"scans {', '.join(names)}, frame: {frame}", f"calibration {fitted.name}", *restrictions)
        static_points = {name: int(mask.sum()) for name, mask in registered.static.items()}
        number = 0 if out is not None else next_number(store, "merge")
        with placed_file(store, out, f"merged_{number}.ply") as (path, written):
            write_ply(written, surface.points, surface.colours, surface.normals, scalars, notes=notes)
            result = Merge(
                alignment, fused, clouds, path, scale, f"merge/{number}" if number else "", static_points,
                registered.contradictions, restrictions, inputs,
            )  # fmt: skip
            if result.result_name:
                store.save_result(result.result_name, _make_record(store, result, fitted.name), {})
    progress(1.0, "merged")
    return result


def _measure_markers(clouds: Mapping[str, Cloud], warn: Warn) -> dict[str, MeasuredMarkers]:
    """Measure the coded markers on the scans; raises InputError where no two scans show the same one."""
    measured = {name: measure_markers(cloud) for name, cloud in clouds.items()}
    for note in marker_notes(measured):
        warn(note)
    numbers = [set(markers.ids.tolist()) for markers in measured.values()]
    if not any(one & other for i, one in enumerate(numbers) for other in numbers[:i]):
        counts = ", ".join(f"{name} {len(markers.ids)}" for name, markers in measured.items())
        raise InputError(
            f"no two scans show the same marker (measured: {counts}): print some by `slviewer target markers:0-23:20`, "
            "put them on or beside the object so that neighbouring scans share three or more, and scan again; or start "
            "from features"
        )
    return measured


def _measure_mat(
    clouds: Mapping[str, Cloud], table_deg: Mapping[str, float], warn: Warn
) -> dict[str, MeasuredMarkers] | None:
    """Measure the markers on a turntable, from which its axis follows; None where there are none, or where they do not
    turn with it."""
    measured = {name: measure_markers(cloud) for name, cloud in clouds.items()}
    compared = []
    for a, b in pairwise(name for name in clouds if name in table_deg):
        try:
            pose = fit_marker_pose(measured[a], measured[b])
        except Refused:
            pose = None
        if pose is not None and len(pose.ids) >= MAT_MARKERS:
            turn_deg = abs(shortest_turn(table_deg[b] - table_deg[a]))
            compared.append(abs(float(np.degrees(rotation_angle(pose.T[:3, :3]))) - turn_deg))
    if not compared:
        return None
    if max(compared) > MAT_TURN_DEG:
        warn(
            f"coded markers are in view, and they turn by {max(compared):.1f} degrees more or less than the table: "
            "they are ignored; put them on the table, or check its angles"
        )
        return None
    return measured


def _list_moved_markers(alignment: MultiwayAlignment) -> list[str]:
    """A sentence for each pair between whose scans markers have moved."""
    return [
        f"{a} -> {b}: marker {', '.join(map(str, pose.moved))} has moved between the scans, and is ignored: "
        "glue it on, or take it away"
        for (a, b), pose in alignment.markers.items()
        if pose.moved
    ]


def _load_places(store: Session, names: Sequence[str]) -> dict[str, np.ndarray]:
    """The poses (4, 4) of scans that are in place, all in one frame; InputError where some are not."""
    places = load_places(store)
    if missing := [name for name in names if name not in places]:
        raise InputError(f"{' and '.join(missing)} were not aligned: align them first, or start from features")
    return {name: places[name] for name in names}


def _scene_warnings(clouds: Mapping[str, Cloud], registered: ObjectAlignment, keep_background: bool) -> list[str]:
    """Warnings of points that are not the object, or contradict another scan, with the remedy."""
    messages = []
    still = {name: int(mask.sum()) for name, mask in registered.static.items() if mask.any()}
    if still:
        total = sum(int(clouds[name].mask.sum()) for name in still)
        counts = ", ".join(f"{count} of {name}" for name, count in still.items())
        messages.append(
            f"{100 * sum(still.values()) / total:.2g} % of the points ({counts}) stand still while the object moves: "
            + ("they are in the merge once for each scan" if keep_background else "they are not part of the merge")
        )
    for (one, other), contradiction in registered.contradictions.items():
        if contradiction.share > MAX_CONTRADICTION_SHARE:
            messages.append(
                f"{one} -> {other}: {100 * contradiction.share:.2g} % of the points contradict, they lie more than "
                f"{contradiction.gate_mm:.2g} mm in front of what the other scan sees there: something moved alone "
                "or stands still; restrict the scans to the object, or scan again"
            )
    return messages


def _make_record(store: Session, merged: Merge, model: str) -> dict[str, Any]:
    """Return the stored record of a merge made with that model: its figures, its file in the exports, and its
    inputs."""
    calibrations = dict.fromkeys(("calibration/stereo", f"calibration/{model}"))
    return {
        **merged.to_json(),
        "scans": list(merged.fused.names),
        "ply": merged.out.name,
        "model": model,
        "scale": merged.scale,
        "scales": {model: scale_factor(store, model)},
        "restrictions": list(merged.restrictions),
        "inputs": {**store.input_hashes(*merged.fused.names, *calibrations), **merged.restriction_inputs},
    }


def _load_table_angles(store: Session, names: Sequence[str]) -> dict[str, float]:
    """Return the turntable's angle, deg, of scans of a single turn. Raises UsageError for others."""
    stored = {name: store.load_capture(name).turn_step for name in names}
    table_deg = {name: step.deg for name, step in stored.items() if step is not None}
    if missing := [name for name in names if name not in table_deg]:
        raise UsageError(
            f"no angle of a turntable is stored with {', '.join(missing)}: give the angle from scan to scan, or start "
            "from features"
        )
    if len(turns := dict.fromkeys(step.turn for step in stored.values() if step is not None)) > 1:
        raise UsageError(
            f"the scans belong to several turns ({', '.join(turns)}), between which the object may have been moved: "
            "start from features"
        )
    return table_deg


def _initial_alignments(
    names: Sequence[str],
    start: StartKind,
    table_deg: Mapping[str, float] | None,
    axis: TurntableAxis | None,
    poses: Mapping[str, np.ndarray] | None,
    picked: Picked | None,
    warn: Warn,
) -> Starts:
    """Return the initial alignments for the requested start; raises for options that do not fit it."""
    if start == "identity" and poses is None:
        poses = {name: np.eye(4) for name in names}
    picks = {}
    for (scan, onto), (there, here) in (picked or {}).items():
        if not {scan, onto} <= set(names):
            raise UsageError(f"points were picked on {scan} and {onto}, which are not both among the scans to merge")
        picks[scan, onto], apart = fit_picked_start(there, here)
        warn(f"{scan} -> {onto}: the picked points come within {apart.max():.2f} mm of each other")
    for base in {onto for _, onto in picks} if poses is None and table_deg is None else ():
        if all((name, base) in picks for name in names if name != base):  # pairs without picked points start there too
            poses = {base: np.eye(4)} | {name: picks[name, base].T for name in names if name != base}
    return Starts(poses=poses, table_deg=table_deg, axis=axis, picked=picks)


def _registration_figures(registration: Registration) -> dict[str, Any]:
    """Return a registration's figures by name, as plain values for JSON."""
    return {
        "rms_mm": registration.rms_mm,
        "point_to_point_rms_mm": registration.inlier_rmse_mm,
        "overlap": registration.overlap,
        "agreement": registration.agreement,
        "slack_mm": registration.slack_mm,
        "gate_mm": registration.gate_mm,
        "start": registration.start,
        "sigma_shift_mm": registration.uncertainty.shift_mm,
        "sigma_turn_deg": registration.uncertainty.turn_deg,
        "middle": registration.uncertainty.centre.tolist(),
        "T_reference_scan": registration.T_reference_scan.tolist(),
    }
