"""Uploads: within the limit, under a harmless name, by whoever announced them."""

import pytest
from clocks import until
from server_client import Browser, announced, part, settle


@pytest.fixture
def button(gui):
    button = gui.add_upload_button("Open")
    button.on_upload(
        lambda event: files.append((event.target.value.name, event.target.value.content))
    )
    files: list = []
    button.__dict__["files"] = files
    return button


def under_way(browser: Browser) -> int:
    return len(browser.server.viser.gui._current_file_upload_states)


def test_a_file_arrives_under_a_harmless_name(operator, button):
    client, content = operator.client(), bytes(range(256)) * 32
    client.send(
        "FileTransferStartUpload",
        **announced(button, 8192, 2, "../../.ssh/authorized keys\x00.pub"),
    )
    client.send("FileTransferPart", **part(button, 0, content[:5000]))
    client.send("FileTransferPart", **part(button, 1, content[5000:]))
    assert until(lambda: button.files == [("authorized keys.pub", content)])
    client.send("FileTransferStartUpload", **announced(button, 0, 0, "..\\..\\empty.yml"))
    assert until(lambda: button.files[-1] == ("empty.yml", b""))
    assert under_way(operator) == 0


def test_what_is_too_large_is_refused_with_a_word(operator, button):
    client = operator.client()
    client.send("FileTransferStartUpload", **announced(button, 3_000_001, 6))
    assert until(lambda: any("Not uploaded" in str(m) for m in client.received))
    assert until(lambda: any(m["type"] == "FileTransferPartAck" for m in client.received))
    client.send("FileTransferPart", **part(button, 0, b"x" * 500_000))
    settle(client)
    assert under_way(operator) == 0 and not button.files


def test_several_at_once_share_the_limit(operator, button):
    first, second = operator.client(), operator.client()
    first.send("FileTransferStartUpload", **announced(button, 2_000_000, 4, transfer="a"))
    settle(first)
    second.send("FileTransferStartUpload", **announced(button, 2_000_000, 4, transfer="b"))
    settle(second)
    assert under_way(operator) == 1
    first.socket.close()
    assert until(lambda: under_way(operator) == 0)
    second.send("FileTransferStartUpload", **announced(button, 2_000_000, 4, transfer="c"))
    settle(second)
    assert under_way(operator) == 1


@pytest.mark.parametrize(
    ("size", "parts"), [(-1, 0), (10, 0), (0, 1), (10, 10_000_000), (5000, 3), (2**62, 1)]
)
def test_announcements_that_cannot_be_are_refused(operator, button, size, parts):
    client = operator.client()
    client.send("FileTransferStartUpload", **announced(button, size, parts))
    settle(client)
    assert under_way(operator) == 0 and not button.files


def test_parts_that_were_not_announced_end_the_upload(operator, button):
    client = operator.client()
    for bad in (
        [(0, b"x" * 8193)],
        [(5, b"x")],
        [(0, b"x" * 10), (0, b"x" * 10)],
        [(0, b"x"), (1, b"x")],
    ):
        client.send("FileTransferStartUpload", **announced(button, 8192, 2))
        for index, content in bad:
            client.send("FileTransferPart", **part(button, index, content))
        settle(client)
        assert under_way(operator) == 0 and not button.files


def test_nobody_meddles_with_anothers_upload(operator, button):
    first, second = operator.client(), operator.client()
    first.send("FileTransferStartUpload", **announced(button, 8192, 2))
    first.send("FileTransferPart", **part(button, 0, b"a" * 4096))
    settle(first)
    second.send("FileTransferPart", **part(button, 1, b"b" * 4096))
    second.send("FileTransferStartUpload", **announced(button, 4096, 1, "other.txt"))
    settle(second)
    first.send("FileTransferPart", **part(button, 1, b"a" * 4096))
    assert until(lambda: button.files == [("a.txt", b"a" * 8192)])


def test_only_an_upload_button_takes_files(operator, gui, button):
    slider = gui.add_slider("gain", 0, 10, 1, 5)
    button.disabled = True
    client = operator.client()
    for target in (slider, button):
        client.send("FileTransferStartUpload", **announced(target, 0, 0))
    settle(client)
    assert slider.value == 5 and not button.files
