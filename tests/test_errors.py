"""Errors state what happened and what to do, and hold no passwords."""

import copy
import pickle

import pytest

from slviewer.errors import BoardError, DeviceError, InputError, SlviewerError, hide_passwords
from slviewer.registration.refusal import Refused, WrongPart


@pytest.mark.parametrize(
    "address",
    [
        "rtsp://u:hunter2@camera/x",
        "http://hunter2@camera",
        "rtsp://u:hun@ter2@camera/x",
        "rtsp://u:hun/ter2@camera:554",
    ],
)
def test_passwords_in_addresses_are_hidden(address: str) -> None:
    for text in (
        f"{address} does not answer",
        f'{{"source": "{address}"}}',
        f"see {address}, then",
    ):
        for hidden in (hide_passwords(text), str(DeviceError(text))):
            assert "hun" not in hidden and "ter2" not in hidden and "camera" in hidden


def test_other_text_stays_as_it_is() -> None:
    for text in ("http://127.0.0.1:8080/x", "me@example.org", "s3://bucket/a b@c", "1 @ 2"):
        assert hide_passwords(text) == text


def test_an_error_is_its_place_observation_and_remedy() -> None:
    error = InputError("2 frames of 18", "give one a pattern", "axis x")
    assert str(error) == "axis x: 2 frames of 18: give one a pattern"
    outer = error.within("scan_01")
    assert str(outer) == f"scan_01: {error}" and outer.place == "scan_01: axis x"
    assert (outer.observation, outer.remedy) == ("2 frames of 18", "give one a pattern")
    assert error.place == "axis x"
    assert outer.located_observation == "scan_01: axis x: 2 frames of 18"
    assert str(InputError("no frames")) == "no frames" and InputError("no frames").remedy == ""


def test_parts_of_an_error_hold_no_passwords() -> None:
    address = "rtsp://u:hunter2@camera"
    error = DeviceError(f"{address} is silent", f"open {address}", address)
    for each in (error, error.within(address)):
        assert not any("hunter2" in part for part in (each.observation, each.remedy, each.place))


def test_an_error_survives_another_process() -> None:
    error = BoardError("mirrored", "turn it", "a", cause="axis-reversed").within("b")
    error = pickle.loads(pickle.dumps(error)).within("c")
    assert str(error) == "c: b: a: mirrored: turn it" and error.cause == "axis-reversed"


class Jammed(DeviceError):
    """An error of a plugin, whose constructor takes what it likes and calls no other."""

    def __init__(self, code: int) -> None:
        self.code = code


class Gone(DeviceError):
    """Another, which passes its text on."""

    def __init__(self, name: str) -> None:
        super().__init__(f"{name} is gone", "plug it in")


def test_errors_of_plugins_are_shown_copied_and_sent() -> None:
    for error, text in ((Jammed(7), "7"), (Gone("x"), "x is gone: plug it in")):
        for each in (error, copy.copy(error), pickle.loads(pickle.dumps(error))):
            assert type(each) is type(error) and str(each) == text
    assert copy.copy(Jammed(7)).code == 7 and str(SlviewerError()) == ""
    wrong = pickle.loads(pickle.dumps(WrongPart("another part").within("scan")))
    assert str(wrong) == "scan: another part"


def test_an_error_with_arguments_of_its_own_is_put_in_a_place() -> None:
    refused = Refused("overlap", "3 % overlap").within("scan_02")
    assert str(refused) == "scan_02: 3 % overlap" and refused.reason == "overlap"
