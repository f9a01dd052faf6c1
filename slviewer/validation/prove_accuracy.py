"""Whether the splined calibration measures as well as the camera's noise allows, on simulated rigs with known truth."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from slviewer.evaluation.render import Row, render
from slviewer.pipeline.feedback import Progress, ignore_progress, part
from slviewer.validation.prove_rigs import FLOOR, RigCase, RigFigures, cases, measure_rig

POSES = 25
OVER_FLOOR = {"R1": 1.4, "R2": 1.1, "R3": 1.1}
"""At most so many times the floor, in the mean over the planes of a region."""
BELOW_FLOOR = 0.9
"""No model beats the noise: what seems to is scored wrongly."""
OF_STEREO = 0.9
"""Stereo's RMS over splined's is at least this share of stereo's over the floor."""
PREDICTED = 0.1
RADIUS_MM, SPACING_MM = 0.015, 0.04
OVER_STEREO = 1.03
"""Of lenses without local distortion, where stereo lacks nothing."""
LEAST_KEPT = 0.9
"""Of the pixels to be scored: a model that masks what it measures badly would look better than it is."""


@dataclass(frozen=True)
class BandCheck:
    """One figure of one rig, and the band in which it must lie."""

    rig: str
    what: str
    value: float
    least: float
    most: float

    @property
    def holds(self) -> bool:
        """Whether it lies there; what could not be measured does not."""
        return self.least <= self.value <= self.most

    def text(self) -> str:
        """In one line."""
        band = f"at most {self.most:g}" if self.least <= 0 else f"{self.least:.3g} to {self.most:.3g}"
        return f"{self.rig}: {self.what} is {self.value:.4g}, wanted {band}"


def checks(figures: RigFigures) -> tuple[BandCheck, ...]:
    """What is demanded of one rig."""
    floor, splined = figures.mean_mm(FLOOR), figures.mean_mm("splined")
    rig = figures.case.name
    regions = {plane.region for plane in figures.planes.values()}
    predicted = _predicted_over_floor(figures)
    found = [
        BandCheck(rig, "stereo over splined, of stereo over the floor,", floor / splined, OF_STEREO, 1 / BELOW_FLOOR),
        *(
            BandCheck(rig, f"splined over the floor in {region}", _over_floor(figures, region), BELOW_FLOOR, most)
            for region, most in OVER_FLOOR.items()
            if region in regions
        ),
        BandCheck(rig, "predicted floor over the floor, of the worst plane,", predicted, 1 - PREDICTED, 1 + PREDICTED),
        BandCheck(rig, "share of the pixels that splined measures", _kept(figures), LEAST_KEPT, 1.0),
        BandCheck(
            rig, "largest error of a sphere's radius in mm", _largest(figures.radius_mm["splined"]), 0.0, RADIUS_MM
        ),
        BandCheck(rig, "largest error of a spacing in mm", _largest(figures.spacing_mm["splined"]), 0.0, SPACING_MM),
    ]
    if figures.case.local_distortion_px == 0:
        found.append(
            BandCheck(rig, "splined over stereo", splined / figures.mean_mm("stereo"), BELOW_FLOOR, OVER_STEREO)
        )
    return tuple(found)


@dataclass(frozen=True)
class AccuracyProof:
    """What came of all rigs."""

    rigs: tuple[RigFigures, ...]
    scale: float

    @property
    def checks(self) -> tuple[BandCheck, ...]:
        """Of all rigs, in order."""
        return tuple(check for rig in self.rigs for check in checks(rig))

    @property
    def holds(self) -> bool:
        """Whether every figure of every rig lies where it must."""
        return all(check.holds for check in self.checks)

    def text(self) -> str:
        """For people: a line a rig, and a line for each figure that misses."""
        missed = [check.text() for check in self.checks if not check.holds]
        table = [_row(rig) for rig in self.rigs]
        title = f"mean plane RMS in mm over pixels seen in 6 poses or more, at scale {self.scale:g}"
        done = f"{len(self.checks) - len(missed)} of {len(self.checks)} figures hold"
        return "\n".join([title, render(table), done, *missed])

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "scale": self.scale,
            "holds": self.holds,
            "checks": [{**vars(check), "holds": check.holds} for check in self.checks],
            "rigs": [
                {
                    "rig": rig.case.name,
                    "seed": rig.case.seed,
                    "planes": {name: {**vars(p), "rms_mm": dict(p.rms_mm)} for name, p in rig.planes.items()},
                    "radius_error_mm": {model: dict(errors) for model, errors in rig.radius_mm.items()},
                    "spacing_error_mm": {model: dict(errors) for model, errors in rig.spacing_mm.items()},
                    "seconds": dict(rig.seconds),
                }
                for rig in self.rigs
            ],
        }


def prove_accuracy(
    scale: float = 1.0,
    *,
    rigs: Sequence[RigCase] | None = None,
    poses: int = POSES,
    seed: int = 0,
    progress: Progress = ignore_progress,
) -> AccuracyProof:
    """Calibrate and measure one rig after another; by default the six of ``prove_rigs.cases``."""
    chosen = cases(seed) if rigs is None else rigs
    found = [
        measure_rig(case, scale, poses, part(progress, i / len(chosen), (i + 1) / len(chosen)))
        for i, case in enumerate(chosen)
    ]
    progress(1.0, "proven")
    return AccuracyProof(tuple(found), scale)


def _row(rig: RigFigures) -> Row:
    row: Row = {"rig": rig.case.name, "seed": rig.case.seed}
    row |= {model: rig.mean_mm(model) for model in ("stereo", "pixelwise", "splined", FLOOR)}
    row |= {f"ratio {region}": _over_floor(rig, region) for region in OVER_FLOOR}
    row |= {
        "predicted ratio": _predicted_over_floor(rig),
        "worst radius": _largest(rig.radius_mm["splined"]),
        "worst spacing": _largest(rig.spacing_mm["splined"]),
        "kept %": 100 * _kept(rig),
        "holds": "yes" if all(check.holds for check in checks(rig)) else "NO",
        "s": f"{rig.seconds['in all']:.0f}",
    }
    return row


def _over_floor(rig: RigFigures, region: str) -> float:
    return rig.mean_mm("splined", region) / rig.mean_mm(FLOOR, region)


def _kept(rig: RigFigures) -> float:
    return sum(plane.kept for plane in rig.planes.values()) / len(rig.planes)


def _predicted_over_floor(rig: RigFigures) -> float:
    """Of the plane where it is farthest from 1; NaN where one is not known."""
    ratios = [plane.predicted_mm / plane.rms_mm[FLOOR] for plane in rig.planes.values()]
    return max(ratios, key=lambda ratio: math.inf if math.isnan(ratio) else abs(math.log(ratio)))


def _largest(errors: Mapping[str, float]) -> float:
    """The largest magnitude; NaN where one is not known."""
    return max((abs(error) for error in errors.values()), key=lambda error: math.inf if math.isnan(error) else error)
