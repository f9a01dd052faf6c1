"""What was measured, as an image for the projector that shows it on the part as it lies there.

A ray of the calibrated projector through each part of a pixel meets the scanned surface where the
image will appear; what it meets first is lit, and so hides what lies behind it. Where the ray
meets, what was measured is interpolated and coloured. Edges of colours so lie where the measured
values have them, not at the middles of pixels.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle, product
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from slviewer.calibration.splined.model import SplinedModel
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError, UsageError
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import Floats, invert, move_points
from slviewer.geometry.vectors import lengths
from slviewer.inputs import Input
from slviewer.inspection.deviation import COVERAGE_SAMPLES, colour_limit, deviation_colours
from slviewer.inspection.nominal_surface import NominalSurface
from slviewer.inspection.regions import Region
from slviewer.pipeline.aligned_part import AlignedPart
from slviewer.pipeline.compare import fit_to_nominal
from slviewer.pipeline.inspect_parts import read_session_plan
from slviewer.pipeline.measure import (
    MERGED,
    MeasuredSurface,
    load_surface,
    provenance,
    triangulate_surface,
)
from slviewer.pipeline.models import ModelName, load_pair
from slviewer.pipeline.operation import (
    Found,
    Job,
    Stored,
    list_records,
    load_arrays,
    operation,
    placed_file,
    stage,
)
from slviewer.records.acceptance import Decision, worst_decision
from slviewer.records.inspection import Inspection
from slviewer.records.measurement import Measurement
from slviewer.records.merge import Merge
from slviewer.records.part_image import PartImage
from slviewer.records.record import from_plain, to_plain
from slviewer.registration.open3d_loader import open3d, raycasting_scene
from slviewer.session.importers.images import read_image
from slviewer.session.nominal import Nominal, read_nominal

TEXT, FONT, FONT_HEIGHT = 0.025, cv2.FONT_HERSHEY_SIMPLEX, 22
"""Height of texts as a share of the image's; and the font, of this height in px at scale 1."""
SPOT = 0.005
"""Radius of a measured point, as a share of its distance."""
MOVING = 0.9
"""Quantile of the tiles' motions that is the part's: some lie on its shadows."""
SAMPLES = 4
"""Rays through a pixel of the projector, across and down."""
ROWS = 32
"""Of the projector that are cast at once."""
DISPLAY = 2.2
"""Exponent by which colours are meant."""
WITHIN, ABOVE, BELOW = (0, 200, 80), (255, 40, 40), (60, 110, 255)
"""RGB inside a tolerance, above it and below it."""
VERDICTS: Mapping[Decision, tuple[int, int, int]] = {
    "pass": WITHIN,
    "undecided": (255, 200, 0),
    "fail": ABOVE,
}
"""RGB of the features of a plan."""
PALETTE = ((255, 200, 0), (0, 200, 255), (255, 80, 200), (120, 255, 80), (255, 140, 60))
"""RGB of measurements in turn."""
PLACES = 5
"""Places out of tolerance that get a number."""
DASH, LINE = 0.02, 0.004
"""Length of the dashes of an outline, and width of its line, as shares of the image's height."""
LEAST_ALIKE = 0.8
"""Correlation of the picture of now with that of the scan, below which it shows something else."""
MOST_MOVED_PX = 0.5
"""Camera pixels, by which the part may have moved at most."""
TILE = 48
"""Side of a tile in camera pixels."""
LEAST_STEEP = 3.0
"""Grey levels of 255 a pixel, RMS: an evener tile shows no motion."""

Colours = Callable[[Floats], np.ndarray]
"""From values (n, k) of places to their colours (n, 3) RGB, 0 to 255, 0 for no light."""


@dataclass(frozen=True)
class ShowOnPartSettings:
    """What is shown on which part.

    Args:
        scan: Name of the capture of the part as it lies there.
        of: compare: the deviations of its last comparison, in the colours of the report, and the
            worst places in numbers; verdict: green inside the tolerance, red above, blue below;
            missing: the outline of what it did not measure of the nominal model, dashed, or of what
            a merge with it that was compared lacks; plan: the features of the inspection plan that
            it was inspected by, green, red, or yellow where undecided, each with its name and
            value; measure: the regions of its measurements with their values.
        frame: A picture that the same camera took now, under white light of the projector: what has
            moved since the scan is refused.
        out: PNG file; by default in the session's exports.
        gamma: Of the projector: 2.2 for most, 1 where grey levels are proportional to the light.
        brightness: Of the brightest colour.
        model: Which calibration to use; by default the best one available.
        accept_rejected: Use the calibration although its verdict rejects it.
    """

    UNRECORDED: ClassVar = ("out", "frame")
    scan: str
    of: Literal["compare", "verdict", "missing", "plan", "measure"] = "compare"
    frame: Path | str | None = None
    out: Path | str | None = None
    gamma: Annotated[float, Input(0.5, 4)] = 2.2
    brightness: Annotated[float, Input(1, 100, "%")] = 100.0
    model: ModelName | None = None
    accept_rejected: bool = False

    def __post_init__(self) -> None:
        if self.scan.startswith(MERGED):
            raise UsageError(
                f"{self.scan} is put together from scans of several places",
                "give the scan that shows the part as it lies there now",
            )
        if self.out is not None and Path(self.out).suffix.lower() != ".png":
            raise UsageError(
                f"the image is written as .png, not as {Path(self.out).name}", "end its name so"
            )


@dataclass(frozen=True)
class ShownValues:
    """``values`` (n, k) of the n points of a surface, what ``colours`` makes of them, and texts at
    places (3,) mm in the camera's frame. ``surface``: other vertices (n, 3) mm and faces than those
    of the scan; ``is_outline``: only the outlines of what is coloured are shown."""

    values: Floats
    colours: Colours
    texts: Sequence[tuple[Floats, str]] = ()
    surface: tuple[Floats, np.ndarray] | None = None
    is_outline: bool = False


@operation("show-on-part", PartImage, ShowOnPartSettings)
def show_on_part(job: Job, settings: ShowOnPartSettings) -> Iterator[Found[PartImage]]:
    """Make the image that shows on the part itself what was measured on it, for the projector that
    scanned it."""
    store, scan = job.store, settings.scan
    on = load_surface(job.part(0.0, 0.4), scan, settings.model)
    if not on.model:
        raise InputError(
            f"{scan} is an imported cloud, which no projector of this session has measured",
            "scan the part with camera and projector",
        )
    moved = None if settings.frame is None else measure_shift(job, on, Path(settings.frame))
    measurements = [each for each in list_records(store, Measurement) if each.record.source == scan]
    if settings.of == "measure":
        shown = _show_measurements(on, measurements)
    elif settings.of == "plan":
        shown = _show_plan(job, on)
    elif settings.of == "missing":
        shown = _show_missing(job, on)
    else:
        compared = [m.record for m in measurements if m.record.deviation is not None]
        shown = _show_deviation(job, on, compared, settings.of == "verdict")
    job.progress(0.6, "casting rays")
    model = load_pair(store)
    vertices, faces = shown.surface or triangulate_surface(on)
    points, rig = vertices / on.scale, model.pinholes
    pixel_mm = float(np.median(rig.to_projector(points)[:, 2]) / rig.projector.K[0, 0])
    image = projection_image(
        model, points, faces, shown.values, shown.colours,
        gamma=settings.gamma, brightness=1.0 if shown.is_outline else settings.brightness / 100,
        spread_px=float(np.median(points[:, 2]) / rig.camera.K[0, 0] / pixel_mm),
    )  # fmt: skip
    if shown.is_outline:
        image = dim_image(draw_outline(image), settings.brightness / 100, settings.gamma)
        if not image.any():
            raise InputError(
                "what is missing of the nominal model lies where the projector does not reach in"
                f" {scan}, or is too small to be outlined",
                "turn the part for the next scan",
            )
    for place, text in shown.texts:
        write_text(image, rig, place / on.scale, text)
    # noise moves a point along its ray of the camera
    points = on.points[on.measured] / on.scale
    noise = 1 + (on.sigma_mm[on.measured] / on.points[on.measured][:, 2])[:, None]
    noise_px = np.nanmedian(lengths(rig.project(points * noise) - rig.project(points)))
    made = provenance(on)
    record = PartImage(
        scan=scan, of=settings.of, pixel_mm=pixel_mm, moved_px=moved,
        illuminated_share=float((image > 0).any(axis=2).mean()),
        position_sigma_px=float(np.hypot(model.residual_px, noise_px)),
        inputs=made["inputs"], scales=made["scales"],
    )  # fmt: skip
    job.progress(0.9, "writing")
    with placed_file(store, settings.out, f"{scan}_{settings.of}_on_part.png") as (file, written):
        written.write_bytes(cv2.imencode(".png", image[..., ::-1])[1].tobytes())
        yield Found("", record, {"image": image}, (file,), (f"image -> {file}",))
    job.progress(1.0, "drawn")


def _show_deviation(
    job: Job, on: MeasuredSurface, compared: Sequence[Measurement], is_verdict: bool
) -> ShownValues:
    """Return what shows the last comparison of a scan, of its deviations or of their verdict."""
    if not compared:
        raise _not_compared(on)
    found = compared[-1].deviation
    assert found is not None
    tolerance = found.tolerance_mm
    if is_verdict and tolerance is None:
        raise InputError(
            f"the comparison of {on.source} had no tolerance", "compare it again with --tolerance"
        )
    nominal = _read_compared(job, compared[-1])
    result = fit_to_nominal(
        on, nominal, found.reach_mm, stage(job.progress, 0.4, 0.6, "comparing again")
    )
    signed = np.where(result.counted, result.signed, np.nan)
    limit = colour_limit(signed, tolerance)

    def colours(values: Floats) -> np.ndarray:
        """Return colours of deviations (n, 1); none where there is none."""
        each = values[:, 0]
        drawn = deviation_colours(each, limit)
        if is_verdict:
            sides = (each > limit).astype(int) - (each < -limit)
            drawn = np.array([BELOW, WITHIN, ABOVE], np.uint8)[sides + 1]
        drawn[~np.isfinite(each)] = 0
        return drawn

    worst = found.verdict.places[:PLACES] if found.verdict else ()
    T = invert(result.T_nominal_scan)
    texts = [(move_points(T, np.array(each.place)), f"{each.value_mm:+.2f}") for each in worst]
    return ShownValues(signed[:, None], colours, texts)


def _read_compared(job: Job, compared: Measurement) -> Nominal:
    """Return the nominal model of a comparison. Raises InputError where it has changed since."""
    assert compared.deviation is not None
    path = job.store.folder / compared.settings["nominal"]  # as it is, where it is absolute
    nominal = read_nominal(path, compared.settings.get("units"))
    if nominal.hash != compared.deviation.nominal.hash:
        raise InputError(f"{path.name} has changed since the comparison", "compare again")
    return nominal


def _show_missing(job: Job, on: MeasuredSurface) -> ShownValues:
    """Return what shows, on the nominal model where the part is, which of it was not measured, by
    the last comparison of the scan or of a merge that it is part of."""
    merges = {f"{MERGED}{each.name}": each.record for each in list_records(job.store, Merge)}
    with_it = {source for source, merge in merges.items() if on.source in merge.poses}
    compared = [
        each
        for each in list_records(job.store, Measurement)
        if each.record.deviation is not None and each.record.source in {on.source, *with_it}
    ]
    if not compared:
        raise _not_compared(on)
    _refuse_stale(compared[-1], "compare again")
    last = compared[-1].record
    assert last.deviation is not None
    nominal, T = _read_compared(job, last), np.array(last.deviation.T_nominal_scan)
    T_scan_source = np.eye(4)
    if last.source in with_it:
        T_scan_source = invert(merges[last.source].poses[on.source])
    T_scan_nominal = T_scan_source @ invert(T)
    surface = NominalSurface(nominal.mesh)
    places = move_points(T_scan_nominal, surface.sample(COVERAGE_SAMPLES, seed=1)[0])
    name = f"{Measurement.kind}/{compared[-1].name}"
    uncovered = move_points(T_scan_source, load_arrays(job.store, name)["uncovered"].astype(float))
    tree, is_missing = cKDTree(places), np.zeros(len(places), bool)
    is_missing[tree.query(uncovered, workers=-1)[1]] = True
    if not is_missing.any():
        raise InputError(f"all of {nominal.name} was measured", "there is nothing left to scan")

    def colours(values: Floats) -> np.ndarray:
        """Return white for places (n, 3) mm nearest to what was not measured."""
        return 255 * np.repeat(is_missing[tree.query(values, workers=-1)[1], None], 3, axis=1)

    vertices = move_points(T_scan_nominal, nominal.mesh.vertices)
    return ShownValues(vertices, colours, (), (vertices, nominal.mesh.faces), is_outline=True)


def _refuse_stale(stored: Stored[Any], remedy: str) -> None:
    """Raise InputError where what a record was made from has changed since."""
    if stored.stale:
        raise InputError(
            f"{stored.label} is out of date: what it was made from has changed", remedy
        )


def _not_compared(on: MeasuredSurface) -> InputError:
    """Return the error of a scan that was not compared."""
    return InputError(
        f"{on.source} has not been compared with a nominal model",
        f"compare it first: slviewer compare SESSION {on.source} PART.stl --tolerance 0.2",
    )


def _show_plan(job: Job, on: MeasuredSurface) -> ShownValues:
    """Return what shows the features of the plan by which a scan was last inspected, as they were
    decided."""
    inspected = [
        (each, part)
        for each in list_records(job.store, Inspection)
        for part in each.record.parts
        if part.part == on.source
    ]
    if not inspected:
        raise InputError(
            f"{on.source} has not been inspected by a plan",
            f"inspect it first: slviewer run-plan SESSION plan.toml --scans {on.source}",
        )
    inspection, judged = inspected[-1]
    _refuse_stale(inspection, "inspect again")
    plan = read_session_plan(job.store, inspection.record.settings["plan"])
    if plan.characteristic != inspection.record.characteristic:
        raise InputError(f"the plan {plan.name} has changed since the inspection", "inspect again")
    own = plan.alignment.nominal
    aligned = AlignedPart(plan, on, None if own is None else read_nominal(own))
    T = invert(aligned.T_part_scan)
    shown = list[ShownRegion]()
    for feature in plan.feature:
        results = [
            (result, wanted)
            for result, wanted in zip(judged.results, plan.characteristic, strict=True)
            if wanted.features[0] == feature.name  # the second is the datum
        ]
        if results:
            decision = worst_decision({result.decision for result, _ in results})
            result, wanted = next(each for each in results if each[0].decision == decision)
            value = "" if result.value is None else f" {result.value:.3f} {wanted.unit}"
            region = feature.region.moved(T)
            shown.append(ShownRegion((region,), VERDICTS[decision], f"{feature.name}{value}"))
    return _show_regions(on, shown)


@dataclass(frozen=True)
class ShownRegion:
    """Regions of a surface in a colour (RGB), with a text at the middle of their points."""

    regions: Sequence[Region]
    colour: tuple[int, int, int]
    text: str


def _show_measurements(on: MeasuredSurface, measured: Sequence[Stored[Measurement]]) -> ShownValues:
    """Return what shows the regions and ends of a scan's measurements, with their values."""
    shown = list[ShownRegion]()
    spot = SPOT * float(np.nanmedian(on.points[on.measured][:, 2]))
    for colour, each in zip(cycle(PALETTE), measured, strict=False):
        record, places = each.record, [Region.ball(end, spot) for end in each.record.ends or ()]
        if record.region is not None:
            places = [from_plain(to_plain(record.region), Region)]
        elif record.feature is not None and record.feature.kind == "point":
            places = [Region.ball(record.feature.place, spot)]
        text = f"{each.label} {record.quantities[0].format()}" if record.quantities else ""
        shown.append(ShownRegion(places, colour, text))
    return _show_regions(on, shown)


def _show_regions(on: MeasuredSurface, shown: Sequence[ShownRegion]) -> ShownValues:
    """Return what shows regions of a scan, with their texts."""
    texts = list[tuple[Floats, str]]()
    for each in shown:
        seen = np.concatenate([np.zeros((0, 3)), *map(on.within, each.regions)])
        if len(seen) and each.text:
            texts.append((seen.mean(axis=0), each.text.encode("ascii", "ignore").decode()))
    if not texts:
        raise InputError(
            f"nothing was measured on {on.source} that has a place", "measure on it first"
        )

    def colours(values: Floats) -> np.ndarray:
        """Return colours of places (n, 3) mm."""
        drawn = np.zeros((len(values), 3), np.uint8)
        for each in shown:
            for region in each.regions:
                drawn[region.within(values)] = each.colour
        return drawn

    return ShownValues(on.points[on.measured].astype(np.float64), colours, texts)


def measure_shift(job: Job, on: MeasuredSurface, frame: Path) -> float | None:
    """Return by how many camera pixels a scanned part has moved until a picture was taken under
    white light; None, with a warning, where it has no structure that would show it.

    Raises InputError where it has moved, or is another one.
    """
    before, after = (
        np.asarray(each if each.ndim == 2 else each.mean(axis=2), np.float32)
        for each in (np.asarray(on.texture), read_image(frame))
    )
    sizes = [f"{each.shape[1]}x{each.shape[0]} px" for each in (before, after)]
    if sizes[0] != sizes[1]:
        raise InputError(
            f"{frame.name} has {sizes[1]} and the scan {sizes[0]}", "take it with the same camera"
        )
    seen = on.measured
    alike = float(np.corrcoef(before[seen], after[seen])[0, 1])
    if not alike > LEAST_ALIKE:
        raise InputError(
            f"{frame.name} does not show what was scanned: the correlation of both pictures is"
            f" {alike:.2f}",
            "scan the part again, or take the picture under white light of the projector",
        )
    gain, level = np.polyfit(before[seen], after[seen], 1)  # brightness and contrast of both alike
    smooth = [cv2.GaussianBlur(each, (0, 0), 1.0) for each in (before, (after - level) / gain)]
    change, slopes = smooth[0] - smooth[1], np.dstack([*np.gradient((smooth[0] + smooth[1]) / 2)])
    steep = LEAST_STEEP / 255 * float(np.ptp(before[seen]))
    shifts = list[float]()
    for top, left in product(*(range(0, n - TILE + 1, TILE) for n in seen.shape)):
        tile = np.s_[top : top + TILE, left : left + TILE]
        J = slopes[tile][seen[tile]]
        if len(J) > TILE**2 / 2 and np.linalg.svd(J, compute_uv=False)[-1] > steep * len(J) ** 0.5:
            shift = np.linalg.lstsq(J, change[tile][seen[tile]], rcond=None)[0]
            shifts.append(float(np.linalg.norm(shift)))
    if not shifts:
        job.warn(f"{on.source} has no structure that would show whether it has moved since")
        return None
    moved = float(np.quantile(shifts, MOVING))
    if moved > MOST_MOVED_PX:
        raise InputError(
            f"the part, or the rig, has moved by {moved:.1f} camera pixels since {on.source}",
            "scan it again where it lies now",
        )
    return moved


def projection_image(
    model: StereoModel | SplinedModel,
    vertices: Floats,
    faces: np.ndarray,
    values: Floats,
    colours: Colours,
    *,
    gamma: float = 2.2,
    brightness: float = 1.0,
    spread_px: float = 1.0,
) -> np.ndarray:
    """Return the image (h, w, 3) uint8 RGB with which a calibrated projector shows values on a
    surface.

    ``vertices`` (n, 3) mm in the camera's frame, ``faces`` (m, 3); ``values`` (n, k) are
    interpolated between the vertices, and become RGB of 0 to 255 by ``colours``. What another part
    of the surface hides is dark. A pixel's light is the mean over its area, of a projector of this
    ``gamma``; ``spread_px``: by which the image reaches beyond what was measured, half of it on
    the surface, where it hides what lies behind it.
    """
    rig, rays = model.pinholes, np.nan_to_num(model.device_rays[1])
    pixel = float(np.median(np.abs(np.diff(rays[..., 0], axis=1))))  # at unit depth
    reach_mm = spread_px / 2 * pixel * (vertices @ rig.R[2] + rig.t[2])
    vertices, faces, values = extend_border(vertices, faces, values, reach_mm)
    middle = vertices.mean(axis=0)  # casting in float32 is finest about 0
    scene, tensor = raycasting_scene(vertices - middle, faces), open3d().core.Tensor

    def meet(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, Floats]:
        """Return the light (m, n, 3) of what the rays through columns (n,) and rows (m,) meet, and
        whether each meets anything (m, n)."""
        x, y = (each.astype(np.float32) for each in np.meshgrid(u, v))
        cast = cv2.remap(rays, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        directions = np.dstack([cast, np.ones(cast.shape[:2])]) @ rig.R
        origins = np.broadcast_to(-rig.R.T @ rig.t - middle, directions.shape)
        hit = scene.cast_rays(tensor(np.dstack([origins, directions]).astype(np.float32)))
        met = np.isfinite(hit["t_hit"].numpy())
        corners = values[faces[hit["primitive_ids"].numpy()[met].astype(np.int64)]]
        s, t = hit["primitive_uvs"].numpy()[met].astype(np.float64).T
        weights = np.stack([1 - s - t, s, t], axis=1)
        light = np.zeros((*met.shape, 3))
        light[met] = (colours(np.einsum("nc,nck->nk", weights, corners)) / 255.0) ** DISPLAY
        return met, light

    height, width = rays.shape[:2]
    light, covered = np.zeros((height, width, 3)), np.zeros((height, width))
    met, _ = meet(np.arange(width), np.arange(height))
    if not met.any():
        raise InputError(
            "no ray of the projector meets what was measured",
            "does the calibration belong to this scan?",
        )
    columns, rows = (
        np.arange(max(int(hit.min()) - 1, 0), min(int(hit.max()) + 2, size))
        for size, hit in zip((width, height), np.nonzero(met)[::-1], strict=True)
    )
    across = (np.arange(len(columns) * SAMPLES) + 0.5) / SAMPLES - 0.5 + columns[0]
    for first in range(rows[0], rows[-1] + 1, ROWS):
        last = min(first + ROWS, rows[-1] + 1)
        down = (np.arange((last - first) * SAMPLES) + 0.5) / SAMPLES - 0.5 + first
        met, seen = meet(across, down)
        part, split = np.s_[first:last, columns], (last - first, SAMPLES, len(columns), SAMPLES)
        light[part] = seen.reshape(*split, 3).mean(axis=(1, 3))
        covered[part] = met.reshape(split).mean(axis=(1, 3))
    inside = covered > 0
    light[inside] /= covered[inside][:, None]
    gap, nearest = distance_transform_edt(~inside, return_indices=True)
    light = np.where((gap <= spread_px / 2)[..., None], light[tuple(nearest)], 0.0)
    return np.rint(255 * (brightness * light) ** (1 / gamma)).astype(np.uint8)


def dim_image(image: np.ndarray, share: float, gamma: float) -> np.ndarray:
    """Return an image uint8 for a projector of this gamma at a share of its light."""
    return np.rint(image * share ** (1 / gamma)).astype(np.uint8)


def extend_border(
    vertices: Floats, faces: np.ndarray, values: Floats, reach_mm: Floats
) -> tuple[Floats, np.ndarray, Floats]:
    """Return vertices, faces and values of a surface with a strip added at its border, in the
    planes of the triangles there, of a width of ``reach_mm`` (n,) at each vertex.

    The surface ends somewhere between its last measured point and the camera's next pixel, on
    average half a pixel beyond. Without the strip, rays through that half pixel pass the rim, and
    paint on it the colours of what lies behind. A strip is at most half as wide as its triangle.
    """
    edges = np.concatenate([faces[:, [0, 1, 2]], faces[:, [1, 2, 0]], faces[:, [2, 0, 1]]])
    ends = np.sort(edges[:, :2].astype(np.int64), axis=1)
    _, first, count = np.unique(
        ends[:, 0] * len(vertices) + ends[:, 1], return_index=True, return_counts=True
    )
    a, b, opposite = edges[first[count == 1]].T
    along, across = vertices[b] - vertices[a], vertices[opposite] - vertices[a]
    share = ((across * along).sum(axis=1) / (along**2).sum(axis=1))[:, None]
    outward = vertices[a] + share * along - vertices[opposite]
    factor = np.minimum(reach_mm[a] / np.maximum(lengths(outward), 1e-12), 0.5)[:, None]
    change = factor * ((1 - share) * values[a] + share * values[b] - values[opposite])
    change = np.where(np.isfinite(change), change, 0.0)
    n, m = len(vertices), len(a)
    a_out, b_out = n + np.arange(m), n + m + np.arange(m)
    return (
        np.concatenate([vertices, *(vertices[each] + factor * outward for each in (a, b))]),
        np.concatenate([faces, np.stack([b, a, a_out], 1), np.stack([b, a_out, b_out], 1)]),
        np.concatenate([values, values[a] + change, values[b] + change]),
    )


def draw_outline(image: np.ndarray) -> np.ndarray:
    """Return an image (h, w, 3) of dashed white lines round what is lit in another; spots with a
    border shorter than two dashes are not shown."""
    drawn, height = np.zeros(image.shape[:2], np.uint8), len(image)
    dash, width = DASH * height, max(round(LINE * height), 1)
    is_lit = np.ascontiguousarray(image.max(axis=2) > 127).astype(np.uint8)
    borders, _ = cv2.findContours(is_lit, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    for border in borders:
        places = border[:, 0].astype(np.float64)
        along = np.cumsum(lengths(np.diff(places, axis=0, append=places[:1])))
        count = int(along[-1] // (2 * dash))  # of dashes with their gaps, evenly
        number = np.floor(along / along[-1] * 2 * count).astype(int) if count else []
        for dash_number in range(0, 2 * count - 1, 2):
            line = border[number == dash_number]
            cv2.polylines(drawn, [line], False, 255, width, cv2.LINE_AA)
    return np.repeat(drawn[..., None], 3, axis=2)


def write_text(image: np.ndarray, rig: StereoRig, place: Floats, text: str) -> None:
    """Write a text into a projector's image (h, w, 3), with a line to a place (3,) mm in the
    camera's frame, so that the camera sees it upright, beside the place towards the middle of what
    is lit."""
    at, right, down = rig.project(place + np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]))
    axes = np.stack([right - at, down - at], axis=1)
    turn = axes / np.sqrt(abs(np.linalg.det(axes)))  # canvas and image have pixels of one area
    middle = np.argwhere(image.any(axis=2)).mean(axis=0)[::-1]
    is_left = np.linalg.solve(turn, middle - at)[0] < 0
    scale = TEXT * image.shape[0] / FONT_HEIGHT
    (width, height), below = cv2.getTextSize(text, FONT, scale, 2)
    around, inside = np.zeros((2, 3 * height + below, width + 2 * height), np.uint8)
    edge = below // 2
    start = (edge if is_left else 2 * height - edge, height + below)
    foot = (inside.shape[1] - 1 if is_left else 0, len(inside) - 1)
    first = (start[0] - edge, start[1] - height - edge)
    last = (start[0] + width + edge, start[1] + below)
    cv2.rectangle(around, first, last, 255, -1)
    cv2.putText(inside, text, start, FONT, scale, 255, 2, cv2.LINE_AA)
    for mask, thick in ((around, 8), (inside, 3)):
        cv2.line(mask, foot, (last if is_left else (first[0], last[1])), 255, thick, cv2.LINE_AA)
    M, size = np.column_stack([turn, at - turn @ foot]), (image.shape[1], image.shape[0])
    dark, bright = (cv2.warpAffine(mask, M, size) / 255 for mask in (around, inside))
    drawn = image * (1 - dark[..., None]) + 255 * bright[..., None]
    image[:] = np.rint(drawn.clip(0, 255))
