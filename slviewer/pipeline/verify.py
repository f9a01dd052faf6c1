"""Measuring known shapes with each model, and comparing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any, Literal

import numpy as np

from slviewer.errors import InputError, UsageError
from slviewer.evaluation.compare import Comparison, compare
from slviewer.evaluation.plane import PlaneResult
from slviewer.evaluation.render import render
from slviewer.evaluation.sphere import SphereResult
from slviewer.fringe.sequence import Axis
from slviewer.pipeline.capture_clouds import capture_cloud, check_capture_sizes
from slviewer.pipeline.capture_phases import capture_texture, decode_captures
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings
from slviewer.pipeline.models import (
    ModelName,
    check_accepted,
    load_models,
    load_stereo,
    preferred_model,
    warn_if_stale,
)
from slviewer.pipeline.open_session import SessionLike, opened_to_save
from slviewer.pipeline.reconstruct import (
    illuminated_pixels,
    masked_share,
    reconstruct_models,
    save_cloud,
    segment_board,
)
from slviewer.pipeline.scale import describe_scale, scale_factor
from slviewer.session.store import Session

Shape = Literal["plane", "sphere"]


@dataclass(frozen=True)
class Verification:
    """The comparison of the models on each capture.

    ``masked``: {capture: {model: share of the shape's pixels that it masks because no target pose illuminated what they
    look through}}, for models that do. ``scales``: {model: what correction of scale is in it, in words}.
    """

    captures: Mapping[str, Comparison]
    masked: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    scales: Mapping[str, str] = field(default_factory=dict)

    def centre_distances_mm(self) -> dict[tuple[str, str], dict[str, float]]:
        """{(capture, capture): {model: mm}}: distances between the spheres' centres; empty for planes."""
        by_pair = {}
        for (a, one), (b, other) in combinations(self.captures.items(), 2):
            distances = {
                model: float(np.linalg.norm(result.sphere.centre - partner.sphere.centre))
                for model, result in one.results.items()
                if isinstance(result, SphereResult) and isinstance(partner := other.results[model], SphereResult)
            }
            if distances:
                by_pair[a, b] = distances
        return by_pair

    def to_json(self) -> dict[str, Any]:
        """The contract of ``verify --json``, and for spheres the distances between their centres."""
        data: dict[str, Any] = {"captures": {name: comparison.to_json() for name, comparison in self.captures.items()}}
        if distances := self.centre_distances_mm():
            data["centre_distances_mm"] = {f"{a} - {b}": by_model for (a, b), by_model in distances.items()}
        return data

    def text(self) -> str:
        """Return the result as a report for the terminal."""
        blocks = [f"{name}:\n{comparison.text()}" for name, comparison in self.captures.items()]
        if distances := self.centre_distances_mm():
            table = [
                {"centres": f"{a} - {b}"} | {f"{model} mm": mm for model, mm in by_model.items()}
                for (a, b), by_model in distances.items()
            ]
            blocks.append(f"distances between the centres:\n{render(table)}")
        for name, shares in self.masked.items():
            blocks += [
                f"{name}: {model} masks {100 * share:.1f} % of the shape's pixels: they lie outside the calibrated "
                "region"
                for model, share in shares.items()
                if share > 0.005
            ]
        blocks += [f"{model}: {words}" for model, words in self.scales.items()]
        return "\n".join(blocks)


def verify(
    session: SessionLike,
    captures: Sequence[str],
    shape: Shape,
    *,
    models: Sequence[ModelName] = (),
    depth_range: tuple[float, float] | None = None,
    radius: float | None = None,
    axis: Axis | None = None,
    accept_rejected: bool = False,
    check: bool = True,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> Verification:
    """Measure captures of a plane or a sphere with each model, over the pixels that all of them measure, and compare.

    The session stores the figures, the error maps, and the cloud of the model that it prefers, if that is compared.

    Args:
        session: Session folder.
        captures: Names of the captures.
        shape: What the captures show.
        models: Which calibrations to compare; by default all there are.
        depth_range: Near and far end of the calibrated depths R2, mm; by default those of the board poses.
        radius: Nominal radius of the sphere, mm: helps to detect it; the fitted radius stays free.
        axis: Which pattern axis gives the depth; by default the one with the smaller predicted noise.
        accept_rejected: Use the calibration although its verdict rejects it.

    ``check``: also compare the frames with each other, and warn of those that do not fit.
    """
    if not captures:
        raise UsageError("no capture named: give the captures to measure, for instance plane_01 plane_02")
    if depth_range is not None and not 0 < depth_range[0] < depth_range[1]:
        raise UsageError(f"the range {depth_range[0]:g} {depth_range[1]:g} is empty: give near and far in mm")
    if radius is not None and not radius > 0:
        raise UsageError(f"a radius of {radius:g} mm is not possible: give a positive one")
    results: dict[str, Comparison] = {}
    masked: dict[str, dict[str, float]] = {}
    with opened_to_save(session, warn) as store:
        check_accepted(store, accept_rejected)
        chosen = load_models(store, models)
        warn_if_stale(store, warn)
        reach = depth_range or load_stereo(store).depth_range_mm
        check_capture_sizes(store, captures)
        for i, (shot, frames, phases) in enumerate(decode_captures(store, captures, warn, check=check)):
            progress(i / len(captures), f"measuring {shot.name}")
            clouds = reconstruct_models(store, chosen, shot, phases, axis, accept_rejected=accept_rejected, warn=warn)
            region: np.ndarray | None = None
            if shape == "plane" and shot.role == "calibration":
                region = segment_board(store, shot, capture_texture(shot, frames), warn)
            try:
                result = compare(
                    shape, clouds, illuminated_pixels(phases, clouds), region=region, depth_range=reach, radius=radius
                )
            except InputError as error:
                raise InputError(f"{shot.name}: {error}") from error
            for message in result.warnings:
                warn(f"{shot.name}: {message}")
            results[shot.name] = result
            axis_used = next(iter(clouds.values())).axis
            masked[shot.name] = {
                name: share
                for name, model in chosen.items()
                if (share := masked_share(model, phases[axis_used], result.region)) is not None
            }
            if store.is_writable:
                _save_verification(store, shot.name, result, masked[shot.name])
                if (best := chosen.get(preferred_model(store))) is not None:  # by its own best axis, as reconstruct
                    texture = capture_texture(shot, frames, stretch=shot.role == "calibration")
                    cloud = capture_cloud(
                        store, best, shot, phases, axis=axis, texture=texture, accept_rejected=accept_rejected
                    )
                    phase = phases[cloud.axis]
                    save_cloud(store, shot.name, cloud, phase, masked_share(best, phase, region))
        scales = {name: words for name in chosen if (words := describe_scale(store, name))}
        progress(1.0, "measured")
    return Verification(results, masked, scales)


def _save_verification(store: Session, capture: str, found: Comparison, masked: Mapping[str, float]) -> None:
    """Store how far a capture is from its shape as ``verify/<capture>``, with the error map (h, w) mm of each model."""
    models = tuple(found.results)
    meta = {
        **found.to_json(),
        "centres_mm": {m: r.sphere.centre for m, r in found.results.items() if isinstance(r, SphereResult)},
        "masked": dict(masked),
        "scales": {model: scale_factor(store, model) for model in models},
        "normals": {m: r.plane.normal for m, r in found.results.items() if isinstance(r, PlaneResult)},
        "inputs": store.input_hashes(capture, *(f"calibration/{model}" for model in models)),
    }
    store.save_result(
        f"verify/{capture}", meta, {f"error_{m}": result.error_map for m, result in found.results.items()}
    )
