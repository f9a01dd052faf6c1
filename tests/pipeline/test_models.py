"""Calibrations that a session holds, read back."""

import shutil
from pathlib import Path

import msgspec
import numpy as np
import pytest
from copies import copy_session
from facts import missing_facts, raises

from slviewer.calibration.splined import model as splined
from slviewer.errors import InputError, SessionError
from slviewer.pipeline import models
from slviewer.pipeline.models import (
    available_models,
    load_model,
    preferred_model,
    warn_of_calibration,
)
from slviewer.pipeline.operation import save_record
from slviewer.records.acceptance import HeldOutError, ModelComparison
from slviewer.session.store import Session
from slviewer.wizard.operator import Operator

HANG_S = 120.0


@pytest.mark.parametrize("name", ["pixelwise", "splined"])
def test_a_calibration_of_another_layout_is_refused_with_what_to_do(
    tmp_path: Path, name: str
) -> None:
    with Session.create(tmp_path / "session") as store:
        store.save_result(
            f"calibration/{name}",
            {"model": {"axes": ["x"], "periods_px": {"x": 18}}},
            {"z": np.eye(2)},
        )
        with raises(SessionError, name, "slviewer calibrate"):
            load_model(store, name)


@pytest.mark.parametrize(
    ("compared", "preferred"),
    [(("stereo", "pixelwise"), "splined"), (("stereo", "pixelwise", "splined"), "pixelwise")],
)
def test_a_comparison_decides_between_the_models_that_it_compared(
    compared: tuple[str, ...], preferred: str, recorded: Path, tmp_path: Path
) -> None:
    error = HeldOutError(0.1, 0.1, 10.0, 0.1, 0.1)
    found = ModelComparison(
        recommended="pixelwise",
        models=dict.fromkeys(compared, error),
        poses={},
        folds=(("pose_01",), ("pose_02",)),
    )
    folder = copy_session(recorded / "session", tmp_path / "session")
    with Session.open(folder, write=True) as store:
        inputs = store.input_hashes(*(f"calibration/{name}" for name in compared))
        save_record(store, "1", msgspec.structs.replace(found, inputs=inputs), {})
        assert preferred_model(store) == preferred


@pytest.mark.slow
def test_a_calibration_of_a_model_that_is_no_more_is_ignored(
    recorded: Path, tmp_path: Path
) -> None:
    folder = copy_session(recorded / "session", tmp_path / "session")
    with Session.open(folder, write=True) as store:
        store.save_result(
            "calibration/anchored", {"model": {"axes": ["x"]}, "inputs": {}}, {"z": np.eye(2)}
        )
        store.decide("model", "anchored")
        assert (
            available_models(store) == ("stereo", "pixelwise", "splined")
            and preferred_model(store) == "splined"
        )
        with raises(InputError, "anchored", "stereo", "pixelwise", "splined"):
            load_model(store, "anchored")
    with Operator(folder) as operator:
        shown = operator.wait_for(
            lambda s: s.session is not None and s.session.calibration is not None, HANG_S
        )
        assert (
            shown is not None
            and shown.session is not None
            and shown.session.calibration is not None
        )
        assert shown.session.calibration.models == ("stereo", "pixelwise", "splined")


def test_what_is_stale_is_told_in_one_sentence(tmp_path: Path) -> None:
    said: list[str] = []
    with Session.create(tmp_path / "session") as store:
        for name in ("stereo", "splined"):
            store.save_result(f"calibration/{name}", {"inputs": {}}, {"z": np.eye(2)})
        warn_of_calibration(store, said.append)
        assert not said
        for name in ("stereo", "splined"):
            store.save_result(
                f"calibration/{name}", {"inputs": {"pose_01": "gone"}}, {"z": np.eye(2)}
            )
        warn_of_calibration(store, said.append)
    (sentence,) = said
    assert not missing_facts(sentence, "stereo", "splined")


@pytest.mark.slow
def test_the_wizard_opens_a_session_of_another_version_and_says_what_to_do(
    recorded: Path, tmp_path: Path
) -> None:
    folder = copy_session(recorded / "session", tmp_path / "session")
    shutil.rmtree(folder / "results" / "calibration" / "splined")
    with Session.open(folder, write=True) as store:
        meta = store.load_result("calibration/pixelwise", only=())[0]
        kept = {key: meta[key] for key in ("model", "inputs", "settings")}
        store.save_result("calibration/pixelwise", kept, {"coefficients": np.zeros((2, 2))})
    with Operator(folder) as operator:
        shown = operator.wait_for(
            lambda s: s.session is not None and s.session.calibration is not None, HANG_S
        )
        assert (
            shown is not None
            and shown.session is not None
            and shown.session.calibration is not None
        )
        assert "version" in shown.session.calibration.stale
        assert shown.session.calibration.stereo.reprojection_rms_px


@pytest.mark.parametrize("name", ["pixelwise", pytest.param("splined", marks=pytest.mark.slow)])
def test_a_calibration_is_loaded_again_only_when_it_has_changed(
    recorded: Path, tmp_path: Path, name: str
) -> None:
    folder = copy_session(recorded / "session", tmp_path / "session")
    with Session.open(folder, write=True) as store:
        first = load_model(store, name)
        assert load_model(store, name) is first
        meta, arrays = store.load_result(f"calibration/{name}")
        saved = {key: meta[key] for key in ("model", "inputs", "settings")}
        store.save_result(
            f"calibration/{name}", {**saved, "settings": {"changed": 1}}, dict(arrays)
        )
        assert load_model(store, name) is not first


@pytest.mark.slow
def test_what_a_calibration_compiles_is_saved_and_belongs_to_it_alone(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = copy_session(recorded / "session", tmp_path / "session")
    compiled: list[str] = []
    for name in ("compile_axis", "compute_sigma_map"):
        make = getattr(splined, name)

        def count(*args: object, make=make, name=name) -> object:  # type: ignore[no-untyped-def]
            compiled.append(name)
            return make(*args)

        monkeypatch.setattr(splined, name, count)

    def load(write: bool = False) -> splined.SplinedModel:
        models._LOADED.clear()
        with Session.open(folder, write=write) as store:
            model = load_model(store, "splined")
        assert isinstance(model, splined.SplinedModel)
        return model

    (axis,) = load()._compiled  # saved when the calibration was
    stored, fresh = load(), splined.SplinedModel(load().bundle)
    assert compiled == []
    for name in ("coefficients", "grid", "supported_grid"):
        np.testing.assert_array_equal(
            getattr(stored.fast_axis(axis), name), getattr(fresh.fast_axis(axis), name)
        )
    np.testing.assert_array_equal(stored.sigma_map(axis).nodes, fresh.sigma_map(axis).nodes)
    np.testing.assert_array_equal(stored.single_rays, fresh.single_rays)
    assert compiled == ["compile_axis", "compute_sigma_map"]

    with Session.open(folder, write=True) as store:  # another calibration takes nothing of this one
        meta, arrays = store.load_result("calibration/splined")
        saved = {key: meta[key] for key in ("model", "inputs", "settings")}
        store.save_result(
            "calibration/splined", {**saved, "settings": {"changed": 1}}, dict(arrays)
        )
    assert not load()._compiled  # nothing can be saved where one only reads
    load(write=True)
    assert set(load()._compiled) == {axis} and len(compiled) == 4

    (folder / "results" / models.COMPILED / "arrays" / "grid.npy").write_bytes(b"torn")
    load(write=True)
    assert set(load()._compiled) == {axis} and len(compiled) == 6
