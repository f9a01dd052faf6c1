"""Messages hold no passwords."""

import pytest

from slviewer.errors import DeviceError, hide_passwords


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
