"""How well calibrations fit the target poses that they were made from."""

from collections.abc import Mapping
from dataclasses import replace
from math import dist
from typing import Any, Literal

import msgspec

from slviewer.records.record import Column, Count, Meta, Record, Share, Table
from slviewer.records.verdict import Finding, Verdict

MIN_WEIGHT = 0.7
"""Undisturbed poses have weights of 0.8 or more in the joint adjustment; those below this are
listed."""


MIN_PATTERN_PX, MIN_PATTERN_SHARE = 0.03, 0.7
"""RMS px of the pattern in a model's residuals, and over their RMS, above both of which it is
reported: then half of the squared residuals are no noise."""


def is_pattern(shared_px: float, rms_px: float) -> bool:
    """Return whether residuals are a pattern rather than noise, by the RMS of what neighbours
    share and by their own."""
    return shared_px > max(MIN_PATTERN_PX, MIN_PATTERN_SHARE * rms_px)


SECOND_CAMERA = "second camera"


class Reprojection(msgspec.Struct, frozen=True):
    """Residuals of a ``model`` on the target poses that it was made from, by "camera" and
    "projector": ``rms_px`` of all, ``pose_rms_px`` (camera, projector) of each, and ``pattern_px``,
    the RMS of what neighbouring residuals share, which the model lacks; empty where not known.
    ``other``: what texts call the device beside the camera."""

    model: str
    rms_px: dict[str, float]
    pose_rms_px: dict[str, tuple[float, float]]
    pattern_px: dict[str, float] = {}
    other: str = "projector"

    @property
    def devices(self) -> dict[str, str]:
        """{device: its name in texts}."""
        return {"camera": "camera", "projector": self.other}

    @property
    def rms_text(self) -> str:
        """The RMS of all residuals of each device, "camera 0.041 px, projector 0.052 px"."""
        return ", ".join(f"{self.devices[each]} {px:.3f} px" for each, px in self.rms_px.items())

    def rename(self, table: Table) -> Table:
        """Return a table of the calibration with the other device called by its name."""
        return table.rename({"projector": self.other})

    @property
    def patterns(self) -> dict[str, float]:
        """The pattern, px, by device where it is more than half of the squared residuals."""
        return {
            device: px
            for device, px in self.pattern_px.items()
            if is_pattern(px, self.rms_px[device])
        }

    def judge(self, verdict: Verdict, model: str) -> Verdict:
        """Return the verdict on a calibration with a finding added where the ``model`` in use is
        the one of the residuals, and these are a pattern."""
        if model != self.model or not self.patterns or "residuals" in verdict.causes:
            return verdict
        parts = " and ".join(
            f"{px:.3f} of {self.rms_px[device]:.3f} px in the {self.devices[device]}"
            for device, px in self.patterns.items()
        )
        remedy = (
            "use the splined model, which follows the local distortion of the lenses"
            if model == "stereo"
            else "see that board, light and rig do not change while a pose is captured"
        )
        sentence = f"the residuals of the {model} model are a pattern, not noise: {parts}"
        return Verdict.of([*verdict.findings, Finding("residuals", "doubtful", sentence, remedy)])


class StereoFit(msgspec.Struct, frozen=True, tag="stereo"):
    """The ``poses`` used, and why others are ``excluded``; RMS residuals of "camera", "projector"
    and "stereo", both together, and of the pattern in them; focal lengths in x and y with their
    standard deviations, by device; the nearest and the farthest board; the file whose lens the
    camera kept.
    """

    poses: tuple[str, ...]
    excluded: dict[str, str]
    reprojection_rms_px: dict[str, float]
    focal_px: dict[str, tuple[float, float]]
    focal_sigma_px: dict[str, float]
    baseline_mm: float
    depth_range_mm: tuple[float, float] | None = None
    features_excluded: Count = 0
    fixed_camera: str = ""
    pattern_px: dict[str, float] = {}

    def summary(self) -> str:
        """Return the number of poses and the reprojection error in one sentence."""
        if not self.poses:
            return f"made elsewhere, baseline {self.baseline_mm:.2f} mm"
        rms = self.reprojection_rms_px.get("stereo", float("nan"))
        return f"calibrated from {len(self.poses)} poses: stereo reprojection RMS {rms:.3f} px"

    def figures(self) -> dict[str, float]:
        """Return the reprojection errors and the baseline."""
        errors = {
            f"reprojection RMS {device}, px": rms
            for device, rms in self.reprojection_rms_px.items()
        }
        return {**errors, "baseline, mm": self.baseline_mm}

    def table(self) -> Table:
        """Return the figures of both devices, and notes on poses and features."""
        devices = ("camera", "projector")
        rms, sigma = self.reprojection_rms_px, self.focal_sigma_px
        focal = {device: self.focal_px.get(device, (None, None)) for device in devices}
        figures: dict[str, Mapping[str, float | None]] = {
            "reprojection RMS, px": {**rms, "both": rms.get("stereo")},
            "pattern in the residuals, RMS, px": self.pattern_px,
            "focal length x, px": {device: x for device, (x, _) in focal.items()},
            "focal length y, px": {device: y for device, (_, y) in focal.items()},
            "standard deviation of the focal length, px": sigma,
            "baseline, mm": {"both": self.baseline_mm},
        }
        rows = [
            {"quantity": quantity, **{each: values.get(each) for each in (*devices, "both")}}
            for quantity, values in figures.items()
        ]
        near, far = self.depth_range_mm or (float("nan"), float("nan"))
        used, total = len(self.poses), len(self.poses) + len(self.excluded)
        notes = (
            [f"{used} of {total} poses used, boards at {near:.0f} to {far:.0f} mm."]
            if used
            else ["Made elsewhere."]
        )
        notes += [f"Excluded: {name}: {why}." for name, why in self.excluded.items()]
        if self.fixed_camera:
            notes.append(f"The camera is that of {self.fixed_camera}.")
        if self.features_excluded:
            notes.append(f"{self.features_excluded} features excluded beyond 6 robust sigma.")
        return Table.of(rows, "Stereo", notes)


class AxisFit(msgspec.Struct, frozen=True):
    """The pixels' fits to the phases of one axis: the share that are ``fitted``, and medians over
    these: of the ``poses`` that a pixel saw, and of the RMS residuals."""

    fitted: Share
    poses: float
    z_mm: float
    x_mm: float
    y_mm: float


class PixelwiseFit(msgspec.Struct, frozen=True, tag="pixelwise"):
    """The pixel-wise fits by captured axis."""

    axes: dict[str, AxisFit]

    def summary(self) -> str:
        """Return the RMS in depth in one sentence."""
        return "fit RMS in z " + ", ".join(
            f"{fit.z_mm:.3f} mm ({axis})" for axis, fit in self.axes.items()
        )

    def figures(self) -> dict[str, float]:
        """Return the RMS in depth."""
        return {f"median RMS in z along {axis}, mm": fit.z_mm for axis, fit in self.axes.items()}

    def table(self) -> Table:
        """Return a line for each axis."""
        rows = [
            {
                "axis": axis,
                Column("pixels fitted", "%", digits=1): 100 * fit.fitted,
                Column("poses a pixel", digits=0): fit.poses,
                Column("RMS in z", "mm"): fit.z_mm,
                Column("RMS in x", "mm"): fit.x_mm,
                Column("RMS in y", "mm"): fit.y_mm,
            }
            for axis, fit in self.axes.items()
        ]
        return Table.of(rows, "Pixel-wise fits by captured axis (median over the pixels)")


class VolumeSigma(msgspec.Struct, frozen=True):
    """The 3D standard deviation of points of the working volume, rigid motion apart: ``median`` and
    ``p95``, mm, over those that target poses support; ``worst`` of all, mm, at ``worst_at`` (u px,
    v px, z mm); ``supported``: share of supported points in the common view; ``axis``: of the
    projector, by which it is measured."""

    median: float
    p95: float
    worst: float
    worst_at: tuple[float, float, float]
    supported: Share
    depths_mm: tuple[float, float]
    axis: str


class SplinedFit(msgspec.Struct, frozen=True, tag="splined"):
    """The joint adjustment. Residuals by "camera" and the projector's axes "x" and "y":
    ``noise_px``, and ``residuals_over_noise``, times their predicted noise. ``cells_lit``: share of
    each device's cells that target poses illuminated. ``weights`` of each pose in camera and
    projector, 0 to 1. ``pose_rms_px``: (camera, projector) of each pose, without outliers;
    ``pattern_px``: of "camera" and "projector". ``excluded``: {pose: why}; ``turned``: poses
    numbered from the board's other end."""

    steps: Count
    residuals_over_noise: dict[str, float]
    noise_px: dict[str, float]
    local_distortion_rms_px: dict[str, float]
    board_height_mm: tuple[float, float]
    board_offsets_rms_mm: float
    cells_lit: dict[str, Share]
    sigma_volume_mm: VolumeSigma
    weights: dict[str, tuple[float, float]] = {}
    excluded: dict[str, str] = {}
    turned: tuple[str, ...] = ()
    pose_rms_px: dict[str, tuple[float, float]] = {}
    pattern_px: dict[str, float] = {}

    @property
    def reprojection(self) -> Reprojection | None:
        """The residuals by pose; None in a record of an older version."""
        used = [px for name, px in self.pose_rms_px.items() if name not in self.excluded]
        if not used:
            return None
        rms = {
            device: (sum(px[i] ** 2 for px in used) / len(used)) ** 0.5
            for i, device in enumerate(("camera", "projector"))
        }
        return Reprojection("splined", rms, self.pose_rms_px, self.pattern_px)

    def summary(self) -> str:
        """Return the residuals in one sentence."""
        return "residuals " + ", ".join(
            f"{place} {px:.4f} px" for place, px in self.noise_px.items()
        )

    def figures(self) -> dict[str, float]:
        """Return the residuals, in px and over their predicted noise."""
        noise = {f"noise {place}, px": px for place, px in self.noise_px.items()}
        return noise | {
            f"residuals over noise {axis}": ratio
            for axis, ratio in self.residuals_over_noise.items()
        }

    def table(self) -> Table:
        """Return the results of the adjustment, and notes on its poses."""
        noise = self.noise_px
        local = self.local_distortion_rms_px
        covered = self.cells_lit
        sigma = self.sigma_volume_mm
        low, high = self.board_height_mm
        near, far = sigma.depths_mm
        u, v, z = sigma.worst_at
        shown = self.reprojection
        figures = (
            {}
            if shown is None
            else {
                "Reprojection RMS, camera / projector": (
                    f"{shown.rms_px['camera']:.3f} / {shown.rms_px['projector']:.3f} px"
                )
            }
        )
        if self.pattern_px:
            figures["Pattern in the residuals, camera / projector"] = (
                f"{self.pattern_px['camera']:.3f} / {self.pattern_px['projector']:.3f} px"
            )
        figures |= {
            "Residual noise, camera": f"{noise['camera']:.4f} px",
            "Residual noise, projector x / y": f"{noise['x']:.4f} / {noise['y']:.4f} px",
            "Residuals over predicted noise": f"{max(self.residuals_over_noise.values()):.1f}",
            "Local distortion, camera / projector": (
                f"{local['camera']:.3f} / {local['projector']:.3f} px RMS"
            ),
            "Board height, peak to valley": f"{high - low:.3f} mm",
            "Board feature offsets": f"{self.board_offsets_rms_mm:.4f} mm RMS",
            "Covered, camera / projector": (
                f"{100 * covered['camera']:.0f} / {100 * covered['projector']:.0f} %"
            ),
            "Supported volume": f"{100 * sigma.supported:.0f} % at {near:.0f} to {far:.0f} mm",
            "3D uncertainty there, median / 95 %": f"{sigma.median:.4f} / {sigma.p95:.4f} mm",
            "Worst uncertainty": (f"{sigma.worst:.3f} mm at pixel ({u:.0f}, {v:.0f}), {z:.0f} mm"),
        }
        named = {
            f"Weights below {MIN_WEIGHT:g}": [
                f"{name} {min(pair):.2f}"
                for name, pair in self.weights.items()
                if min(pair) < MIN_WEIGHT
            ],
            "Board turned by 180°, corrected": self.turned,
        }
        notes = [
            "Pixels outside the calibrated region are marked in clouds, and not measured."
            " Uncertainty: one sigma, rigid motion apart."
        ]
        notes += [f"{title}: {', '.join(names)}." for title, names in named.items() if names]
        notes += [
            f"{name} is excluded from the splined model: it {why}."
            for name, why in self.excluded.items()
        ]
        return Table.of_figures(figures, f"Joint adjustment (splined), {self.steps} steps", notes)


class ModelCalibration(Record, frozen=True, kw_only=True):
    """Each model, and how well it fits the target poses that it was made from.

    ``model``: its parameters, as the model's ``to_dict`` returns them; ``verdict``: of the stereo
    model, on all; ``second_camera``: whether a second camera was calibrated in the projector's
    place. ``fit`` is None for other models than stereo that version 0.2 made.

    Arrays: of stereo ``residuals_<pose>`` (n, 4) px, of the others what their ``to_arrays``
    returns.
    """

    kind = "calibration"
    title = "Models"
    is_of_captures = False
    model: dict[str, Any] = {}
    fit: StereoFit | PixelwiseFit | SplinedFit | None = None
    verdict: Verdict | None = None
    second_camera: bool = False

    @classmethod
    def upgrade(cls, meta: Meta) -> Meta:
        """Add the figures of a stereo calibration that was imported, or made by version 0.2, and
        the operation."""
        if isinstance(imported := meta.get("imported"), Mapping):
            return {**meta, "fit": _describe_imported(imported)}
        if isinstance(fit := meta.get("fit"), Mapping) and "fits" in meta["model"]:
            residuals = {
                name: (each["camera_rms_px"], each["projector_rms_px"])
                for name, each in meta["model"]["fits"].items()
            }
            return {**meta, "fit": {"pose_rms_px": residuals, **fit}}
        if "fit" in meta or "settings" not in meta:
            return meta
        model = meta.get("model", {})
        return {
            **meta,
            "operation": "calibrate",
            "fit": describe_stereo(model) if "rig" in model else None,
        }

    @property
    def is_good(self) -> bool:
        """Whether the verdict finds nothing."""
        return self.verdict is None or self.verdict.level == "good"

    def summary(self) -> str:
        """Return the main figures, and the verdict where it is not good, in one sentence."""
        words = "made by version 0.2" if self.fit is None else self.fit.summary()
        return (
            words
            if self.verdict is None or self.is_good
            else f"{words}; {self.verdict.level}: {self.verdict.reason}"
        )

    def figures(self) -> dict[str, float]:
        """Return the figures of the fit."""
        return {} if self.fit is None else self.fit.figures()

    @classmethod
    def tables(cls, found: Mapping[str, "ModelCalibration"]) -> list[Table]:  # type: ignore[override]
        """Return a table of each model, the simplest first."""
        order = (StereoFit, PixelwiseFit, SplinedFit)
        fitted = [(each, each.fit) for each in found.values() if each.fit is not None]
        fitted.sort(key=lambda pair: order.index(type(pair[1])))
        return [each._make_table(fit.table()) for each, fit in fitted]

    def _make_table(self, of_fit: Table) -> Table:
        verdict = (
            []
            if self.verdict is None
            else [f"{line.strip()}." for line in self.verdict.text().splitlines()]
        )
        pair = ["Two cameras: the second one takes the projector's place."] * self.second_camera
        if self.second_camera:
            of_fit = of_fit.rename({"projector": SECOND_CAMERA})
        return replace(of_fit, notes=[*pair, *of_fit.notes, *verdict])


Answer = Literal["agrees", "disagrees", "undecided"]
Compared = Literal["two axes", "board", "sphere", "single axis"]


class TransformCheck(Record, frozen=True, kw_only=True):
    """Whether a capture agrees with R and T of a calibration that was imported.

    ``evidence``: what of the capture was compared. ``misfit``: how far it is from what R and T
    predict, which is explained up to ``limit``, both in ``unit``; ``others``: the misfit if they
    were inverted or transposed; None where points would lie behind a device. ``scale``: the length
    that T should have, of the stated one; None where the capture does not determine it.
    ``depth_mm``: median of the surface. ``remedy``: what R and T most likely are where the capture
    contradicts them; else what would check them.
    """

    kind = "transform"
    title = "Checks of the imported calibration"
    is_history = True
    is_of_captures = False
    has_figures = False
    capture: str
    answer: Answer
    evidence: Compared
    misfit: float | None = None
    limit: float = 0.0
    unit: Literal["px", "mm"] = "px"
    remedy: str = ""
    others: dict[str, float | None] = {}
    scale: float | None = None
    depth_mm: float | None = None
    time: str = ""

    @property
    def is_good(self) -> bool:
        """Whether the capture agrees."""
        return self.answer == "agrees"

    @property
    def failure(self) -> str:
        """Why the calibration must not be used."""
        return self.summary() if self.answer == "disagrees" else ""

    @property
    def observation(self) -> str:
        """The answer and what it rests on."""
        of = f"R and T of the imported calibration, by its {self.evidence}"
        if self.answer == "undecided":
            return f"calibration not checked: {self.capture} does not determine {of}"
        if self.misfit is None:
            off = "points lie behind a device"
        else:
            off = f"misfit {self.misfit:.2f} {self.unit}, explained up to {self.limit:.2f}"
        if self.scale is not None:
            off += f"; T would be {self.scale:.4g} times as long"
        verb = "agrees with" if self.is_good else "contradicts"
        return f"{self.capture} {verb} {of} ({off})"

    def summary(self) -> str:
        """Return the answer, what it rests on, and what to do."""
        return f"{self.observation}: {self.remedy}" if self.remedy else self.observation

    def list_tables(self, name: str) -> list[Table]:
        """Return the answer, or the misfit of each direction where these were compared."""
        rows: list[dict[Any, Any]] = [
            {"capture": self.capture, "compared": self.evidence, "answer": self.answer}
        ]
        if self.others:
            column = Column("misfit", self.unit)
            tried = {"as stated": self.misfit, **self.others}
            rows = [{"R and T": direction, column: value} for direction, value in tried.items()]
        return [Table.of(rows, f"Check {name}", [f"{self.summary()}."])]


def _describe_imported(matrices: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures of imported matrices in plain values."""
    lenses = {device: matrices[f"K_{device}"] for device in ("camera", "projector")}
    t = [value[0] if isinstance(value, list) else value for value in matrices["T"]]
    return {
        "type": "stereo",
        "poses": (),
        "excluded": {},
        "reprojection_rms_px": {},
        "focal_px": {device: (K[0][0], K[1][1]) for device, K in lenses.items()},
        "focal_sigma_px": {},
        "baseline_mm": dist(t, (0, 0, 0)),
    }


def describe_stereo(model: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures of a stereo model in plain values, as its ``to_dict`` returns it."""
    rig = model["rig"]
    return {
        "type": "stereo",
        "poses": list(model["poses"]),
        "excluded": model["left_out"],
        "focal_px": {
            device: (rig[device]["K"][0][0], rig[device]["K"][1][1])
            for device in ("camera", "projector")
        },
        "baseline_mm": dist(rig["t"], (0, 0, 0)),
        "features_excluded": model.get("features_set_aside", 0),
        "fixed_camera": model.get("fixed_camera", ""),
        **{key: model[key] for key in ("reprojection_rms_px", "focal_sigma_px", "depth_range_mm")},
    }
