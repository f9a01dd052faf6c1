"""The acceptance test: artefacts with certificates against the session's calibration."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import numpy as np

from slviewer.errors import InputError
from slviewer.evaluation.acceptance import (
    SIZE,
    SPACING,
    Artefact,
    conclude_test,
    measure_artefact,
    repeatability,
)
from slviewer.pipeline.capture_clouds import capture_cloud, check_capture_sizes
from slviewer.pipeline.capture_phases import capture_texture, decode_captures
from slviewer.pipeline.check import load_drift_history
from slviewer.pipeline.models import (
    Model,
    ModelName,
    check_accepted,
    load_model,
    load_stereo,
    warn_if_stale,
)
from slviewer.pipeline.open_session import match_names
from slviewer.pipeline.operation import Found, Job, operation
from slviewer.pipeline.reconstruct import segment_board
from slviewer.pipeline.scale import record_scale, scale_factor
from slviewer.pipeline.stored_records import next_name
from slviewer.records.acceptance import (
    AcceptanceTest,
    Contribution,
    ErrorBudget,
    PositionErrors,
)
from slviewer.records.drift import Drift
from slviewer.session.reading import read_toml


@dataclass(frozen=True)
class AcceptSettings:
    """What a calibration is tested with.

    Args:
        artefact: TOML file with the values of the certificate, the captures that show the artefact,
            and the limits.
        model: Which calibration to test; by default the best one available.
        still: Captures (ten) of one still object, for the repeatability.
        apply_scale: Record the measured scale as a correction of later clouds.
    """

    artefact: Path | str
    model: ModelName | None = None
    still: Sequence[str] = ()
    apply_scale: bool = False


@operation("accept", AcceptanceTest, AcceptSettings)
def accept(job: Job, settings: AcceptSettings) -> Iterator[Found[AcceptanceTest]]:
    """Test a calibration with a ball bar, a sphere or a plane that has a certificate, against the
    operator's limits.

    The result stays in the session as ``acceptance/1``, ``acceptance/2``, ...
    """
    store, still = job.store, settings.still
    certified = read_artefact(settings.artefact)
    check_accepted(store)
    chosen = load_model(store, settings.model)
    name, factor = chosen.name, scale_factor(store, chosen.name)
    warn_if_stale(store, job.warn)
    if settings.apply_scale and certified.kind == "plane":
        raise InputError(
            "the scale cannot be measured on a plane: apply that of a ball bar or a sphere"
        )
    captures: dict[str, str] = {}  # {capture: position, its own name where several are in one}
    for position, pattern in certified.positions.items():
        matches = match_names(store.capture_names(), [pattern], "capture", InputError)
        captures |= {each: position if len(matches) == 1 else each for each in matches}
    check_capture_sizes(store, [*captures, *still])
    positions = _measure_positions(job, certified, chosen, captures, 0.5 if still else 0.9)
    test = conclude_test(certified, name, positions)
    repeated = repeatability(_list_depths(job, chosen, still)) if still else None
    applied = record_scale(store, test) if settings.apply_scale else None
    found = msgspec.structs.replace(
        test,
        scale_factor=factor,
        scale_applied=applied,
        budget=_length_budget(certified, test, applied, load_drift_history(store)),
        repeatability=repeated,
        time=datetime.now(UTC).isoformat(timespec="seconds"),
        inputs=store.input_hashes(f"calibration/{name}", *captures, *still),
    )
    yield Found(next_name(store, AcceptanceTest), found)
    job.progress(1.0, "tested")


def _measure_positions(
    job: Job, certified: Artefact, chosen: Model, captures: Mapping[str, str], end: float
) -> list[PositionErrors]:
    """Measure the artefact at each position, {capture: position}; ``end``: share of the work that
    is done then."""
    store, positions = job.store, list[PositionErrors]()
    depth_range = load_stereo(store).depth_range_mm
    for i, (shot, frames, phases) in enumerate(decode_captures(store, list(captures), job.warn)):
        job.progress(end * i / len(captures), f"measuring {shot.name}")
        cloud, plate = capture_cloud(store, chosen, shot, phases, warn=job.warn), None
        if certified.kind == "plane" and shot.role == "calibration":
            plate = segment_board(store, shot, capture_texture(shot, frames), job.warn)
        try:
            positions.append(
                measure_artefact(
                    certified, cloud, captures[shot.name], shot.name, depth_range, plate
                )
            )
        except InputError as error:
            raise InputError(f"{shot.name}: {error}") from error
    return positions


def _list_depths(
    job: Job, chosen: Model, still: Sequence[str]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield depth and its standard deviation (h, w) mm of each capture of the still object."""
    for i, (shot, _, phases) in enumerate(decode_captures(job.store, list(still))):
        job.progress(0.5 + 0.45 * i / len(still), f"repeating {shot.name}")
        cloud = capture_cloud(job.store, chosen, shot, phases, warn=job.warn)
        yield cloud.points[..., 2], cloud.sigma_z


def read_artefact(path: Path | str) -> Artefact:
    """The artefact that a TOML file describes."""
    given = read_toml(path)
    try:
        return Artefact.from_dict(given)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _length_budget(
    artefact: Artefact, test: AcceptanceTest, applied: float | None, checks: Sequence[Drift]
) -> ErrorBudget | None:
    """Error budget of the artefact's length from the test and the drift checks; None where no
    length was measured."""
    scale = test.scale
    if scale is None:
        return None
    mm = scale.length_mm
    name = SIZE if artefact.spacing is None else SPACING
    errors = np.array([f.error_mm for p in test.positions for f in p.figures if f.property == name])
    noise = float(np.sqrt(np.mean([p.noise_mm**2 for p in test.positions])))
    scatter = None if len(errors) < 2 else float(np.sqrt(max(errors.var(ddof=1) - noise**2, 0.0)))
    # known, not removed
    uncorrected_ppm = abs(scale.ppm) if applied is None and abs(scale.ppm) > scale.U_ppm else 0.0
    board = mm * 1e-6 * float(np.hypot(scale.u_ppm, uncorrected_ppm))
    warmth = mm * 1e-6 * artefact.calibrated.expansion_ppm_K * artefact.measured.temperature_U_K / 2
    drift, since = None, "no drift check of this calibration: run `slviewer check`"
    if checks:
        last = checks[-1]
        drift = mm * 1e-6 * float(np.hypot(last.scale_ppm, last.scale_sigma_ppm))
        since = f"the drift check of {last.capture}"
    return ErrorBudget(
        mm,
        [
            Contribution("phase noise", noise, "A", "the scatter of the points about their fits"),
            Contribution(
                "calibration", scatter, "A", f"the errors' scatter over {len(errors)} places"
            ),
            Contribution(
                "board scale",
                board,
                "B",
                "this test's scale" + (", which was left uncorrected" if uncorrected_ppm else ""),
            ),
            Contribution(
                "temperature",
                warmth,
                "B",
                f"{artefact.calibrated.expansion_ppm_K:g} ppm/K of the artefact",
            ),
            Contribution("drift", drift, "B", since),
        ],
    )
