"""Rigs by name: what is shipped can be chosen, what is saved comes back, what is mistyped is
named."""

import tomllib
from pathlib import Path

import pytest
from facts import raises

from slviewer.devices.drivers import Driver, drivers
from slviewer.errors import DeviceError, InputError
from slviewer.pipeline.rig_choice import check_choice, load_rig, presets, rigs, save_rig, set_up
from slviewer.session.store import Session
from slviewer.session.toml import to_toml

BENCH = {
    "name": "bench",
    "settle_ms": 40.5,
    "focal_px": 3555.6,
    "exposure_ms": 8,
    "camera": {
        "driver": "fake",
        "source": 'a "quoted" \\ path\n',
        "mono": True,
        "modes": ["red", "größer"],
    },
    "projector": {"driver": "fake", "size": [912, 1140], "gamma": 1e-07},
}


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> None:
    def camera(source: str, mono: bool = False, modes: tuple[str, ...] = ()) -> None: ...

    def projector(size: tuple[int, int], gamma: float = 1.0, page: object = None) -> None: ...

    monkeypatch.setitem(
        drivers(), "fake", Driver("fake", "nothing", camera=camera, projector=projector, page=True)
    )
    lacking = Driver(
        "lacking", "nothing", packages={"no_such_package": "pip install it"}, camera=camera
    )
    monkeypatch.setitem(drivers(), "lacking", lacking)
    monkeypatch.setitem(drivers(), "lamp", Driver("lamp", "nothing", projector=projector))


@pytest.fixture
def session(tmp_path: Path):
    with Session.create(tmp_path / "session") as store:
        yield store


def test_what_is_shipped_can_be_chosen():
    shipped = {preset.name: preset for preset in presets()}
    assert set(shipped) == {
        "lightcrafter4500",
        "replay",
        "simulated",
        "simulated-lightcrafter4500",
        "turntable",
        "two-cameras",
        "webcam",
    }
    for preset in shipped.values():
        assert preset.what.endswith(".") and "rigs" in preset.source.parts
        assert preset.problem == "" or "package" in preset.problem
        check_choice(preset.choice, preset.name)
        assert f"  {preset.name}: {preset.what}" in rigs()
    bench = set_up(load_rig("simulated"), None)
    assert bench.rig.camera.size == (800, 600) and bench.world is not None


def test_what_is_saved_comes_back_and_hides_what_is_shipped(session: Session, fake: None):
    saved = save_rig(session, "bench-1", BENCH, "Mine.")
    assert saved.choice == BENCH == load_rig("bench-1", session) == load_rig(saved.source)
    assert saved.source == session.folder / "rigs" / "bench-1.toml" and saved.what == "Mine."
    save_rig(session, "bench-1", {**BENCH, "settle_ms": 0})
    assert load_rig("bench-1", session)["settle_ms"] == 0
    save_rig(session, "simulated", {"driver": "simulated", "scale": 0.1})
    assert load_rig("simulated", session)["scale"] == 0.1 and load_rig("simulated")["scale"] == 0.5
    names = [preset.name for preset in presets(session)]
    assert names[:2] == ["bench-1", "simulated"] and names.count("simulated") == 1
    with raises(InputError, "../bench"):
        save_rig(session, "../bench", BENCH)
    assert Session.open(session.folder).rigs().keys() == {"bench-1", "simulated"}


def test_a_choice_as_toml_is_the_same_choice():
    nothing = {**BENCH, "gain": None, "camera": {**BENCH["camera"], "serial": None}}
    assert tomllib.loads(to_toml(nothing)) == BENCH
    odd = {
        "driver": "x",
        "odd key": "ü",
        "deep": {"a": {"b": [1, 2.5, -3, "t"]}, "empty": []},
        "big": 10**12,
    }
    assert tomllib.loads(to_toml(odd)) == odd
    with raises(InputError, "TOML"):
        to_toml({"driver": object()})


@pytest.mark.parametrize(
    ("change", "facts"),
    [
        ({"settle": 40}, ["'settle'"]),
        ({"settle_ms": "40"}, ["settle_ms = '40'", "number"]),
        ({"settle_ms": float("inf")}, ["settle_ms = inf", "number"]),
        ({"focal_px": float("nan")}, ["focal_px = nan", "number"]),
        ({"exposure_ms": 0}, ["exposure_ms = 0", "number", "above 0"]),
        ({"gain": True}, ["gain = True", "number"]),
        ({"name": 3}, ["name = 3", "text"]),
        ({"name": "a\u202eb"}, [r"name = 'a\u202eb'", "text"]),
        (
            {"camera": {"driver": "fake", "source": "0", "monochrome": True}},
            ["'monochrome'", "source", "mono"],
        ),
        ({"camera": {"driver": "fake"}}, ["fake", "source"]),
        ({"camera": {"driver": "fale", "source": "0"}}, ["'fale'", "fake", "lacking"]),
        ({"camera": {"driver": "lamp"}}, ["lamp", "camera"]),
        ({"camera": {"source": "0"}}, ["[camera]", "driver"]),
        ({"projector": "browser"}, ["[projector]", "driver"]),
        ({"projector": {"driver": "fake", "size": [1, 1], "page": 1}}, ["'page'"]),
        ({"driver": "simulated"}, ["driver", "camera"]),
    ],
)
def test_mistakes_are_named(fake: None, change: dict, facts: list[str], tmp_path: Path):
    with raises(InputError, "bench.toml", *facts):
        check_choice({**BENCH, **change}, "bench.toml")
    file = tmp_path / "mine.toml"
    file.write_text(to_toml({**BENCH, **change}))
    with raises(InputError, "mine.toml", *facts):
        load_rig(file)


def test_files_and_names_that_are_none_are_named(fake: None, tmp_path: Path):
    (tmp_path / "broken.toml").write_text("driver = ")
    for rig, facts in (
        (tmp_path / "broken.toml", ["broken.toml", "TOML"]),
        (tmp_path / "absent.toml", ["absent.toml"]),
        ("simulatd", ["'simulatd'", "simulated"]),
    ):
        with raises(InputError, *facts):
            load_rig(rig)
    (tmp_path / "whole.toml").write_text('driver = "simulated"\nscail = 0.5\n')
    with raises(InputError, "'scail'", "preset", "scale", "seed"):
        load_rig(tmp_path / "whole.toml")


def test_a_missing_package_says_how_to_install_it(fake: None, tmp_path: Path):
    file = tmp_path / "mine.toml"
    file.write_text(to_toml({**BENCH, "camera": {"driver": "lacking", "source": "0"}}))
    with raises(DeviceError, "no_such_package", "pip install it"):
        load_rig(file)


def test_a_rig_that_cannot_be_used_is_listed_with_its_problem(fake: None, session: Session):
    save_rig(session, "far", {**BENCH, "camera": {"driver": "lacking", "source": "0"}}, "Far away.")
    (session.folder / "rigs" / "broken.toml").write_text("driver = ")
    listed = {preset.name: preset for preset in presets(session)}
    assert listed["far"].what == "Far away." and "pip install it" in listed["far"].problem
    assert "TOML" in listed["broken"].problem and listed["simulated"].problem == ""
