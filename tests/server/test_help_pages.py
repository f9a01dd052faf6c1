"""The documentation that the server shows: who may read it, which files are pages, and what their
HTML does."""

import re

import pytest
from server_client import Browser

from slviewer.server.help_pages import HelpPages

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture
def folder(tmp_path):
    """Documentation with pages, a picture, and files that are neither."""
    docs = tmp_path / "docs"
    for name, text in {
        "howto/one.md": (
            "# One\n\n## Set up\n\n[two](../explanation/two.md#set-up) [code](../examples/a.py)\n"
            "![r](rig.png) ![far](http://a.b/c.png)\n"
        ),
        "explanation/two.md": (
            "# Two\n\n## Set up\n\n## Set up\n\n### `frames` & light\n\n"
            "| a | b |\n|---|---|\n| 1 | 2 |\n"
        ),
        "howto/three.md": (
            "# <b>Three</b>\n\n<script>alert(1)</script> [x](javascript:alert(1))"
            " [w](https://example.org)\n"
        ),
        "howto/equation.md": (
            "# Equation\n\n```math\nz = \\frac{c_0 + c_1 \\phi}{1 + c_2 \\phi}\n```\n"
        ),
        "howto/index.md": "# Index\n",
        "architecture.md": "# Architecture\n",
        "examples/a.py": "print()\n",
    }.items():
        (docs / name).parent.mkdir(parents=True, exist_ok=True)
        (docs / name).write_text(text)
    (docs / "howto" / "rig.png").write_bytes(PNG)
    (tmp_path / "secret.md").write_text("secret")
    return docs


def test_operator_and_viewer_read_pages_and_nobody_else(operator, watcher, stranger):
    name = HelpPages().names[0]
    for browser in (operator, watcher):
        answer = browser.get(f"help/{name}")
        assert answer.status == 200 and b"<h1" in answer.content
        assert answer.headers["Content-Type"].startswith("text/html")
        policy = answer.headers["Content-Security-Policy"]
        assert (
            "default-src 'none'" in policy
            and "script-src" not in policy
            and "connect-src" not in policy
        )
        assert browser.get("help/").status == 200
    assert stranger.get(f"help/{name}").status == 403 and stranger.get("help/").status == 403
    for role in ("project", "camera"):
        assert Browser(operator.server, role).get(f"help/{name}").status == 404


@pytest.mark.parametrize(
    "name",
    [
        "../pyproject.toml",
        "%2e%2e/README.md",
        "howto/../../README.md",
        "nothing.md",
        "architecture.md",
        "howto",
        "?a=1",
    ],
)
def test_only_listed_files_are_served(operator, name):
    assert operator.get(f"help/{name}").status in (400, 404)


def test_pages_are_those_of_the_users_folders(folder):
    pages = HelpPages(folder)
    assert pages.names == (
        "howto/equation.md",
        "howto/one.md",
        "howto/three.md",
        "explanation/two.md",
    )
    assert pages.file("howto/rig.png").content == PNG
    hidden = (
        "howto/index.md",
        "architecture.md",
        "examples/a.py",
        "../secret.md",
        "/etc/passwd",
        "howto/",
    )
    assert not any(pages.file(name) for name in hidden)


def test_a_page_has_anchors_tables_and_only_links_that_lead_somewhere(folder):
    pages = HelpPages(folder)
    one, two = (
        pages.file(name).content.decode() for name in ("howto/one.md", "explanation/two.md")
    )
    assert 'href="../explanation/two.md#set-up"' in one and "a.py" not in one
    assert 'src="rig.png"' in one and "a.b" not in one and 'alt="far"' in one
    assert pages.anchors("explanation/two.md") == ("two", "set-up", "set-up-1", "frames--light")
    assert (
        all(f'id="{anchor}"' in two for anchor in pages.anchors("explanation/two.md"))
        and "<td>1</td>" in two
    )
    assert 'href="../howto/one.md"' in two and 'href="../"' in two


def test_html_in_a_page_is_shown_as_text(folder):
    html = HelpPages(folder).file("howto/three.md").content.decode()
    assert "<script" not in html and "javascript:" not in re.sub(
        r"\[x\]\(javascript:alert\(1\)\)", "", html
    )
    assert 'href="https://example.org" target="_blank" rel="noopener noreferrer"' in html


@pytest.mark.computes
def test_every_shipped_page_renders():
    pages = HelpPages()
    for name in pages.names:
        html = pages.file(name).content.decode()
        assert html.count("<h1") == 1, name


def test_comments_of_a_page_are_not_shown(folder):
    text = (
        "# Four\n\nIt is <!-- = name -->0.2<!-- . --> mm.\n\n<!-- not run: why"
        " -->\n```bash\nslviewer\n```\n"
    )
    (folder / "howto" / "four.md").write_text(text)
    shown = HelpPages(folder).file("howto/four.md").content.decode()
    assert (
        "It is 0.2 mm." in shown
        and "&lt;!--" not in shown
        and "not run" not in shown
        and "<code" in shown
    )


def test_an_equation_is_drawn_with_its_source_for_screen_readers(folder):
    html = HelpPages(folder).file("howto/equation.md").content.decode()
    assert "<code" not in html and html.count("<svg") == 1 and r'aria-label="z = \frac{c_0' in html
    # the outlines of its letters
    assert len(re.findall("M", re.findall(r' d="([^"]+)"', html)[0])) > 10
