"""Calibrations in a session: saving, loading, choosing, and noticing when one is stale."""

import threading
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import msgspec
import numpy as np

from slviewer.calibration.pixelwise import POSES_FOR_PIXELWISE, PixelwiseModel
from slviewer.calibration.splined.model import SplinedModel
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import CalibrationRejected, InputError, SessionError, SlviewerError
from slviewer.fringe.sequence import Size
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.pipeline.imported_verdict import judge_imported, warning_of_imported
from slviewer.pipeline.operation import (
    Found,
    SessionLike,
    Warn,
    load_record,
    opened,
    read_record,
    save_record,
)
from slviewer.records.acceptance import ModelComparison
from slviewer.records.calibration import (
    SECOND_CAMERA,
    ModelCalibration,
    Reprojection,
    SplinedFit,
    StereoFit,
)
from slviewer.records.record import from_plain, to_plain
from slviewer.records.verdict import Verdict
from slviewer.session.capture import Capture
from slviewer.session.reading import decoding
from slviewer.session.store import Session
from slviewer.target.board import Board

Model = StereoModel | PixelwiseModel | SplinedModel

ModelName = str
"""stereo, pixelwise or splined."""
MODELS = ("stereo", "pixelwise", "splined")
VERDICT = "verdict/1"
LENS_TOLERANCE = 1e-3
"""Share by which focus, zoom and aperture may differ from those of the calibration's poses."""
COMPILED = "compiled/splined"
COMPILED_VERSION = 1
"""Of what `SplinedModel.compile_depth` returns."""
PROJECTOR = "projector/splined"
"""Of two cameras the projector, in the frame of their splined calibration."""
MAX_LOADED = 3
_LOADED: dict[str, PixelwiseModel | SplinedModel] = {}  # by the hash of the saved result
_LOADED_LOCK = threading.Lock()
_RESTORED: dict[str, type[PixelwiseModel | SplinedModel]] = {
    "pixelwise": PixelwiseModel,
    "splined": SplinedModel,
}


def describe_model(
    model: Model, verdict: Verdict | None, inputs: Mapping[str, str] | None
) -> Found[ModelCalibration]:
    """Return the record of a model and its arrays; ``inputs``: {pose that it was made from: its
    hash}."""
    if isinstance(model, StereoModel):
        arrays = {f"residuals_{name}": residuals for name, residuals in model.residuals_px.items()}
    else:
        arrays = model.to_arrays()
    record = ModelCalibration(
        model=model.to_dict(), fit=model.describe(), verdict=verdict, inputs=dict(inputs or {})
    )
    return Found(model.name, record, arrays)


def save_model(
    store: Session,
    model: Model,
    verdict: Verdict | None = None,
    inputs: Mapping[str, str] | None = None,
) -> None:
    """Replace the session's calibration of this kind."""
    found = describe_model(model, verdict, inputs)
    save_record(store, found.name, found.record, found.arrays)
    save_compiled(store, model)


def save_compiled(store: Session, model: Model) -> None:
    """Compile a splined model that was stored, and store that too."""
    if isinstance(model, SplinedModel):
        (content,) = store.input_hashes(f"calibration/{model.name}").values()
        _restore_or_compile(store, model, content)


def available_models(store: Session) -> tuple[str, ...]:
    """Names of the calibrations that the session holds."""
    return tuple(name for name in MODELS if store.has_result(f"calibration/{name}"))


def trash_models(store: Session, names: Iterable[str]) -> None:
    """Move calibrations to the session's trash."""
    for name in names:
        store.trash_result(f"calibration/{name}")


def save_imported_stereo(
    store: Session,
    matrices: Mapping[str, np.ndarray],
    *,
    source: str,
    camera: Size | None,
    projector: Size | None,
    unit: str | None = None,
) -> None:
    """Save imported matrices as the session's stereo calibration; sizes that are None follow from
    its captures. ``unit``: that T was in, if that was stated."""
    meta = {
        "imported": {name: value.tolist() for name, value in matrices.items()},
        "source": source,
        "camera": camera,
        "projector": projector,
        "unit": unit,
        "inputs": {},
    }
    store.save_result("calibration/stereo", meta, {})


def load_stereo(store: Session) -> StereoModel:
    """Load the session's stereo calibration, without its residual arrows."""
    if "stereo" not in available_models(store):
        raise InputError(f"{store.folder} holds no calibration", "run `slviewer calibrate` first")
    return store.decode_result(
        "calibration/stereo", lambda meta, _: _decode_stereo(store, meta), only=()
    )


def lens_warnings(store: Session, capture: Capture) -> tuple[str, ...]:
    """Return a sentence for each of focus, zoom and aperture that the camera reported otherwise
    than for the calibration's poses."""
    if not capture.lens:
        return ()
    inputs = store.load_meta("calibration/stereo")["inputs"]
    names = inputs.keys() & set(store.capture_names("calibration"))
    poses = [pose for name in names if (pose := store.load_capture(name)).hash == inputs[name]]
    warnings = []
    for what, value in capture.lens.items():
        known = [pose.lens[what] for pose in poses if what in pose.lens]
        reach = LENS_TOLERANCE * abs(value)
        if known and not min(known) - reach <= value <= max(known) + reach:
            low, high = f"{min(known):.6g}", f"{max(known):.6g}"
            warnings.append(
                f"{capture.name}: the camera's {what} is {value:.6g}, and was"
                f" {low if low == high else f'{low} to {high}'} in the poses of the calibration,"
                " which does not hold for another one: set it back, or calibrate as it is now"
            )
    return tuple(warnings)


def device_centres(store: Session) -> list[np.ndarray]:
    """Return the centres (2, 3) mm of camera and projector, in the camera's frame; [] where no
    calibration states them."""
    try:
        rig = load_stereo(store).rig
    except SlviewerError:
        return []
    return [np.stack([np.zeros(3), -rig.R.T @ rig.t])]


def _decode_stereo(store: Session, meta: Mapping[str, Any]) -> StereoModel:
    """Return the stereo calibration that ``meta`` describes, with the captures' sizes where it
    states none."""
    if "model" in meta:
        return StereoModel.from_dict(meta["model"])
    captures = store.captures(with_frames=True)
    if not captures and not (meta["camera"] and meta["projector"]):
        raise SessionError(
            f"{store.folder} holds no capture that states the camera's size",
            "import the scans first",
        )
    camera = tuple(meta["camera"] or captures[0].size)
    projector = tuple(meta["projector"] or captures[0].other_size or captures[0].sequence.projector)
    m = {name: np.array(value) for name, value in meta["imported"].items()}
    rig = StereoRig(
        Lens(m["K_camera"], m["D_camera"], camera),
        Lens(m["K_projector"], m["D_projector"], projector),
        m["R"],
        m["T"],
    )
    return StereoModel.from_rig(rig)


def load_calibration(
    session: SessionLike, model: str | None = None, *, accept_rejected: bool = False
) -> Model:
    """Load the calibration of a session called ``model``; by default the one that the session
    prefers.

    Raises InputError where there is none, CalibrationRejected for one that was rejected, unless
    that is accepted.
    """
    with opened(session) as store:
        if not model:
            check_accepted(store, accept_rejected)
        return load_model(store, model)


def load_pair(store: Session) -> StereoModel | SplinedModel:
    """Load the calibration by which two cameras are matched: splined, else stereo."""
    model = load_model(store, "splined") if "splined" in available_models(store) else None
    return model if isinstance(model, SplinedModel) else load_stereo(store)


def load_stereo_if_complete(store: Session) -> StereoModel | None:
    """Load the session's stereo calibration; None where there is none, or an imported one without
    sizes."""
    if "stereo" not in available_models(store):
        return None
    meta = store.load_meta("calibration/stereo")
    sized = "model" in meta or (meta["camera"] and meta["projector"])
    sized = sized or store.captures(with_frames=True)
    return load_stereo(store) if sized else None


def load_residuals(store: Session) -> dict[str, np.ndarray]:
    """{pose: (n, 4) px} camera and projector residuals of the stereo calibration; empty for one
    made elsewhere."""
    arrays, start = store.load_result("calibration/stereo")[1], "residuals_"
    return {name.removeprefix(start): r for name, r in arrays.items() if name.startswith(start)}


def load_reprojection(store: Session, stereo: StereoModel, model: str) -> Reprojection:
    """Return the residuals of the target poses by the ``model`` in use where it has any, else by
    the ``stereo`` one, which it refines."""
    record = load_record(store, ModelCalibration, "stereo")
    other = SECOND_CAMERA if record.second_camera else "projector"
    fit = load_record(store, ModelCalibration, model).fit if model == "splined" else None
    if isinstance(fit, SplinedFit) and fit.reprojection is not None:
        return msgspec.structs.replace(fit.reprojection, other=other)
    pattern_px = record.fit.pattern_px if isinstance(record.fit, StereoFit) else {}
    return msgspec.structs.replace(stereo.reprojection, pattern_px=pattern_px, other=other)


def load_model(store: Session, name: str | None) -> Model:
    """One calibration by name; by default the preferred one.

    The last ``MAX_LOADED`` stay in memory.
    """
    name = name or preferred_model(store)
    if name not in available_models(store):
        there = ", ".join(available_models(store))
        raise InputError(
            f"{store.folder} holds no {name} calibration (there is {there or 'none'})",
            "run `slviewer calibrate` first",
        )
    if name == "stereo":
        return load_stereo(store)
    return _load_cached(store, f"calibration/{name}", _RESTORED[name])


def _load_cached(
    store: Session, result: str, kind: type[PixelwiseModel | SplinedModel]
) -> PixelwiseModel | SplinedModel:
    """Return the model of this ``kind`` that a result holds, from memory where it is there."""
    content = store.input_hashes(result)[result]
    with _LOADED_LOCK:
        if content in _LOADED:
            return _LOADED[content]
    meta, arrays = store.load_result(result)
    with decoding(
        result,
        lambda fault: SessionError(
            f"{result} in {store.folder} was saved by another version of slviewer, or {fault}",
            "run `slviewer calibrate` again",
        ),
    ):
        model = kind.from_arrays(meta["model"], arrays)
    if isinstance(model, SplinedModel) and result != PROJECTOR:
        _restore_or_compile(store, model, content)
    with _LOADED_LOCK:
        while len(_LOADED) >= MAX_LOADED:
            _LOADED.pop(next(iter(_LOADED)))
        return _LOADED.setdefault(content, model)


def save_projector(store: Session, model: SplinedModel) -> None:
    """Save the projector of two cameras beside the session's splined calibration."""
    meta = {"model": model.to_dict(), "inputs": store.input_hashes("calibration/splined")}
    store.save_result(PROJECTOR, meta, model.to_arrays())


def load_projector(store: Session) -> SplinedModel | None:
    """Load the projector of two cameras as the device beside the first one; None where the present
    calibration has none."""
    if store.state_of(PROJECTOR) == "absent":
        return None
    calibration = "calibration/splined"
    inputs = store.load_result(PROJECTOR, only=())[0]["inputs"]
    if inputs != store.input_hashes(calibration):
        return None
    model = _load_cached(store, PROJECTOR, SplinedModel)
    return model if isinstance(model, SplinedModel) else None


def _restore_or_compile(store: Session, model: SplinedModel, content: str) -> None:
    """Load what was compiled from the splined calibration of this hash; else compile and save it,
    where possible."""
    inputs = {"calibration/splined": content}
    if store.has_result(COMPILED):
        with suppress(SessionError, KeyError):  # damaged: it is compiled again
            meta, arrays = store.load_result(COMPILED)
            if (meta["inputs"], meta["version"]) == (inputs, COMPILED_VERSION):
                with decoding(COMPILED):
                    model.restore_compiled(meta["compiled"], arrays)
                return
    if store.is_writable:
        compiled, arrays = model.compile_depth()
        meta = {"compiled": compiled, "version": COMPILED_VERSION, "inputs": inputs}
        with suppress(SessionError):  # a full disk prevents nothing else
            store.save_result(COMPILED, meta, arrays)


def preferred_model(store: Session) -> str:
    """Return the name of the model that the operator has chosen, while it exists; else
    ``recommended_model``."""
    decided = store.decision("model")
    if decided and decided in available_models(store):
        return str(decided)
    return recommended_model(store)


def recommended_model(store: Session) -> str:
    """The calibration that cross-validation recommends, where it compared all that there are; else
    splined or pixelwise, if it has 8 poses or more; else stereo.
    """
    return _recommend(store)[0]


def describe_default_model(session: SessionLike) -> str:
    """Which calibration commands use unless they name one, and why, as a line of text."""
    with opened(session) as store:
        name = preferred_model(store)
        why = "chosen by the operator" if name == store.decision("model") else _recommend(store)[1]
    return f"default model: {name} ({why})"


def _recommend(store: Session) -> tuple[str, str]:
    """Return the name of the recommended calibration, and the reason in words. Raises InputError
    without any."""
    there = available_models(store)
    if not there:
        raise InputError(f"{store.folder} holds no calibration", "run `slviewer calibrate` first")
    compared = store.decode_fresh(
        "validation/1", lambda meta, _: read_record(ModelComparison, meta), only=()
    )
    if compared is not None and compared.recommended in there and compared.covers(there):
        return compared.recommended, "recommended by the comparison on held-out poses"
    for name in ("splined", "pixelwise"):
        if name in there:
            inputs = store.load_meta(f"calibration/{name}")["inputs"]
            if len(inputs) >= POSES_FOR_PIXELWISE:
                return name, f"made from {POSES_FOR_PIXELWISE} poses or more"
    if others := there[1:]:
        few = f"fewer than {POSES_FOR_PIXELWISE} poses are used only by --model"
        return there[0], f"{' and '.join(others)} from {few}"
    return there[0], "the only one"


def find_target(store: Session) -> str:
    """Return the board's notation: as chosen, else that of the calibration or of the poses; empty
    where unknown."""
    decided = store.valid_decision("target")
    if decided:
        return str(decided)
    stereo = None
    with suppress(SessionError):  # a damaged calibration, which others name
        stereo = load_stereo_if_complete(store)
    if stereo is not None and stereo.board:
        return stereo.board
    boards = (c.meta.get("board") for c in store.captures("calibration"))
    return str(next(filter(None, boards), ""))


def explain_board(notation: str) -> str:
    """Return why a stored board cannot be used, and what to do; empty where it can, or where there
    is none."""
    try:
        if notation:
            Board.parse(notation)
    except InputError as error:
        return (
            f"the target cannot be used: {error}; install the plugin that adds it, or choose"
            " another board"
        )
    return ""


def rejection_reason(store: Session) -> str:
    """Return why the session's calibration was rejected; empty where it was not, or was never
    judged."""
    if "stereo" not in available_models(store):
        return ""
    verdict = load_stereo_verdict(store)
    return verdict.reason if verdict is not None and verdict.level == "rejected" else ""


def load_stereo_verdict(store: Session) -> Verdict | None:
    """Return the verdict on the session's stereo calibration; None where it was never judged."""
    imported = judge_imported(store)
    return imported or load_record(store, ModelCalibration, "stereo").verdict


def check_accepted(store: Session, accept_rejected: bool) -> None:
    """Raise CalibrationRejected, with the reason, where the calibration was rejected and that is
    not accepted."""
    reason = rejection_reason(store)
    if reason and not accept_rejected:
        raise CalibrationRejected(
            f"the calibration was rejected, and is not used without --accept-rejected: {reason}"
        )


def accept_rejected_calibration(store: Session, on: bool) -> None:
    """Remember whether the present calibration is to be used although rejected; a new one needs a
    new decision."""
    store.decide(
        "use_anyway", store.input_hashes("calibration/stereo")["calibration/stereo"] if on else None
    )


def accepts_rejected(store: Session) -> bool:
    """Whether the operator decided to use the present calibration although it was rejected."""
    decided = store.decision("use_anyway")
    there = decided and "stereo" in available_models(store)
    return bool(there) and decided == store.input_hashes("calibration/stereo")["calibration/stereo"]


def frame_family(name: str) -> str:
    """The calibration whose camera frame a model's clouds are in: splined has its own, the others
    that of stereo."""
    return "splined" if name == "splined" else "stereo"


def frame_of(store: Session, name: str) -> str:
    """The frame of a model's clouds, in words: "camera of calibration splined 1a2b3c4d"."""
    if not name:
        return "imported file"
    family = frame_family(name)
    calibration = f"calibration/{family}"
    if not store.has_result(calibration):
        return f"camera of calibration {family}"
    return f"camera of calibration {family} {store.input_hashes(calibration)[calibration][:8]}"


def warn_if_frame_changed(store: Session, before: str, warn: Warn) -> None:
    """Warn where another model is used than ``before`` (empty: none was), whose clouds are in
    another frame."""
    after = preferred_model(store) if available_models(store) else ""
    if before and after and frame_family(before) != frame_family(after):
        warn(
            f"the {after} calibration is used from now on instead of {before}, and its clouds lie"
            f" in another frame: the {frame_of(store, after)}. Reconstruct earlier scans again"
            " before you combine them with new ones"
        )


def load_models(store: Session, names: Sequence[str]) -> dict[str, Model]:
    """Calibrations by name; all there are where none is named."""
    load_stereo(store)
    return {name: load_model(store, name) for name in names or available_models(store)}


def warn_of_calibration(store: Session, warn: Warn) -> None:
    """Warn when target poses have changed since the calibration was made, and of an imported one
    that no capture has checked."""
    names = available_models(store)
    stale = [name for name in names if store.state_of(f"calibration/{name}") == "stale"]
    if stale:
        which = "calibration was" if len(stale) == 1 else "calibrations were"
        warn(
            f"the {' and '.join(stale)} {which} made from target poses that have since been"
            " replaced or removed: run `slviewer calibrate` again"
        )
    if warning := warning_of_imported(store):
        warn(warning)


def save_verdict(store: Session, verdict: Verdict, poses: Sequence[str]) -> None:
    """Save the verdict on an attempt to calibrate from these poses, whether or not it succeeded."""
    store.save_result(
        VERDICT, {"verdict": to_plain(verdict), "inputs": store.input_hashes(*poses)}, {}
    )


def load_last_verdict(store: Session) -> Verdict | None:
    """Load the verdict on the last attempt to calibrate, also a failed one, or on an imported
    calibration; None before the first."""
    if (verdict := judge_imported(store)) is not None:
        return verdict
    if not store.has_result(VERDICT):
        return None
    return store.decode_result(
        VERDICT, lambda meta, _: from_plain(meta["verdict"], Verdict), only=()
    )
