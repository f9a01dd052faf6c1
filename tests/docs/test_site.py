"""The site builds without a warning, and its pages load nothing from a network."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
LOADED = re.compile(
    r"""<(?:script|img|iframe|source)\b[^>]*?\bsrc=["']?(?:https?:)?//|<link\b[^>]*?href=["']?https?:"""
)


def test_the_site_builds_without_warnings_and_loads_nothing_from_a_network(tmp_path):
    pytest.importorskip("sphinx", reason="the site needs `pip install '.[docs]'`")
    pytest.importorskip("myst_parser", reason="the site needs `pip install '.[docs]'`")
    pytest.importorskip("pydata_sphinx_theme", reason="the site needs `pip install '.[docs]'`")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "-d", tmp_path / "doctrees"]
    built = subprocess.run([*command, DOCS, tmp_path / "html"], capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    pages = list((tmp_path / "html").rglob("*.html"))
    assert len(pages) > 15
    loading = {page.name: found[0] for page in pages if (found := LOADED.search(page.read_text(encoding="utf-8")))}
    assert not loading
