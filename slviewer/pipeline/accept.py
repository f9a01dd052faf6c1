"""The acceptance test: artefacts with certificates against the session's calibration."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.evaluation.acceptance.artefact import Artefact
from slviewer.evaluation.acceptance.measure import SIZE, SPACING, Position, measure_artefact
from slviewer.evaluation.acceptance.result import Acceptance, conclude_test
from slviewer.evaluation.budget import Contribution, ErrorBudget
from slviewer.evaluation.repeatability import Repeatability, repeatability
from slviewer.pipeline.capture_clouds import capture_cloud, check_capture_sizes
from slviewer.pipeline.capture_phases import capture_texture, decode_captures
from slviewer.pipeline.check import load_drift_history
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings, part
from slviewer.pipeline.models import ModelName, best_model, check_accepted, load_model, load_stereo, warn_if_stale
from slviewer.pipeline.open_session import SessionLike, match_names, next_number, opened
from slviewer.pipeline.reconstruct import segment_board
from slviewer.pipeline.scale import record_scale, scale_factor
from slviewer.records.drift import Drift
from slviewer.session.reading import read_toml
from slviewer.session.store import Session


@dataclass(frozen=True)
class AcceptanceResult:
    """The result of ``accept``. ``factor`` is the scale correction in force during the test, ``applied`` the one
    that it put in force, or None; ``budget`` of the artefact's length, None for a plane; ``repeatability`` where
    still captures were named.
    """

    acceptance: Acceptance
    factor: float
    applied: float | None
    budget: ErrorBudget | None
    repeatability: Repeatability | None

    def to_json(self) -> dict[str, Any]:
        """Return the published values of ``accept --json``."""
        return self.acceptance.to_json() | {
            "scale_factor": self.factor,
            "scale_applied": self.applied,
            "budget": None if self.budget is None else self.budget.to_json(),
            "repeatability": None if self.repeatability is None else self.repeatability.to_json(),
        }

    def text(self) -> str:
        """Return the result as a report for the terminal."""
        blocks = [self.acceptance.text()]
        if self.factor != 1.0:
            blocks.append(f"a scale correction of {1e6 * (self.factor - 1):+.0f} ppm was in force during the test")
        if self.applied is not None:
            blocks.append(
                f"scale correction recorded: clouds of {self.acceptance.model} are multiplied by {self.applied:.7f}"
            )
        elif self.acceptance.scale is not None:
            blocks.append("the scale was not corrected: --apply-scale does so")
        blocks += [part.text() for part in (self.budget, self.repeatability) if part is not None]
        return "\n\n".join(blocks)


def accept(
    session: SessionLike,
    artefact: Path | str,
    *,
    model: ModelName | None = None,
    still: Sequence[str] = (),
    apply_scale: bool = False,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> AcceptanceResult:
    """Test a calibration with a ball bar, a sphere or a plane that has a certificate, against the operator's limits.

    Args:
        session: Session folder.
        artefact: TOML file with the values of the certificate, the captures that show the artefact, and the limits.
        model: Which calibration to test; by default the best one available.
        still: Captures (ten) of one still object, for the repeatability.
        apply_scale: Record the measured scale as a correction of later clouds.

    The result stays in the session as ``acceptance/1``, ``acceptance/2``, ...
    """
    certified = read_artefact(artefact)
    with opened(session, write=True) as store:
        check_accepted(store)
        name = model or best_model(store)
        chosen, factor = load_model(store, name), scale_factor(store, name)
        warn_if_stale(store, warn)
        if apply_scale and certified.kind == "plane":
            raise InputError("the scale cannot be measured on a plane: apply that of a ball bar or a sphere")
        captures = _match_captures(store, certified)
        check_capture_sizes(store, [*captures, *still])
        depth_range = load_stereo(store).depth_range_mm
        measuring = part(progress, 0, 0.9 if not still else 0.5)
        positions: list[Position] = []
        for i, (shot, frames, phases) in enumerate(decode_captures(store, list(captures), warn)):
            measuring(i / len(captures), f"measuring {shot.name}")
            cloud = capture_cloud(store, chosen, shot, phases, warn=warn)
            plate = None
            if certified.kind == "plane" and shot.role == "calibration":
                plate = segment_board(store, shot, capture_texture(shot, frames), warn)
            try:
                positions.append(measure_artefact(certified, cloud, captures[shot.name], shot.name, depth_range, plate))
            except InputError as error:
                raise InputError(f"{shot.name}: {error}") from error
        test = conclude_test(certified, name, positions)
        repeatability_mm = None
        if still:
            watching = part(progress, 0.5, 0.95)

            def clouds() -> Any:
                """Yield depth and its standard deviation (h, w) mm of each capture of the still object."""
                for i, (shot, _, phases) in enumerate(decode_captures(store, list(still))):
                    watching(i / len(still), f"repeating {shot.name}")
                    cloud = capture_cloud(store, chosen, shot, phases, warn=warn)
                    yield cloud.points[..., 2], cloud.sigma_z

            repeatability_mm = repeatability(clouds())
        checks = load_drift_history(store)
        applied = record_scale(store, test) if apply_scale else None
        result = AcceptanceResult(test, factor, applied, _length_budget(test, applied, checks), repeatability_mm)
        meta = {
            "accepted": result.to_json(),
            "time": datetime.now(UTC).isoformat(timespec="seconds"),
            "inputs": store.input_hashes(f"calibration/{name}", *captures, *still),
        }
        store.save_result(f"acceptance/{next_number(store, 'acceptance')}", meta, {})
        progress(1.0, "tested")
    return result


def read_artefact(path: Path | str) -> Artefact:
    """The artefact that a TOML file describes."""
    given = read_toml(path)
    try:
        return Artefact.from_dict(given)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _match_captures(store: Session, artefact: Artefact) -> dict[str, str]:
    """{capture: position}; the capture's own name where a pattern matches several."""
    positions: dict[str, str] = {}
    for position, pattern in artefact.positions.items():
        names = match_names(store.capture_names(), [pattern], "capture", InputError)
        positions |= {name: position if len(names) == 1 else name for name in names}
    return positions


def _length_budget(test: Acceptance, applied: float | None, checks: Sequence[Drift]) -> ErrorBudget | None:
    """Error budget of the artefact's length from the test and the drift checks; None where no length was measured."""
    scale = test.scale
    if scale is None:
        return None
    artefact, mm = test.artefact, scale.length_mm
    name = SIZE if artefact.spacing is None else SPACING
    errors = np.array([f.error_mm for p in test.positions for f in p.figures if f.property == name])
    noise = float(np.sqrt(np.mean([p.noise_mm**2 for p in test.positions])))
    scatter = None if len(errors) < 2 else float(np.sqrt(max(errors.var(ddof=1) - noise**2, 0.0)))
    uncorrected_ppm = abs(scale.ppm) if applied is None and abs(scale.ppm) > scale.U_ppm else 0.0  # known, not removed
    board = mm * 1e-6 * float(np.hypot(scale.u_ppm, uncorrected_ppm))
    warmth = mm * 1e-6 * artefact.expansion.ppm_per_kelvin * artefact.temperature.U_kelvin / 2
    drift, since = None, "no drift check of this calibration: run `slviewer check`"
    if checks:
        last = checks[-1]
        drift = mm * 1e-6 * float(np.hypot(last.scale_ppm, last.scale_sigma_ppm))
        since = f"the drift check of {last.capture}"
    return ErrorBudget(
        mm,
        (
            Contribution("phase noise", noise, "A", "the scatter of the points about their fits"),
            Contribution("calibration", scatter, "A", f"the errors' scatter over {len(errors)} places"),
            Contribution(
                "board scale",
                board,
                "B",
                "this test's scale" + (", which was left uncorrected" if uncorrected_ppm else ""),
            ),
            Contribution("temperature", warmth, "B", f"{artefact.expansion.ppm_per_kelvin:g} ppm/K of the artefact"),
            Contribution("drift", drift, "B", since),
        ),
    )
