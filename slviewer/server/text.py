"""Text that a user typed, made harmless for where it is shown or saved."""

import re
import unicodedata

_INVISIBLE = re.compile("[\x00-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters, lone surrogates, and the marks that make text read in another order than it
is written."""

_LINK = re.compile(r"(?i)(?<=www)(?=\.)|(?<=http)(?=:)|(?<=https)(?=:)|(?=@)")
"""Where viser's Markdown recognises an address, after it has read the entities."""

_DEVICE_NAMES = {
    "con",
    "prn",
    "aux",
    "nul",
    *(f"{port}{n}" for port in ("com", "lpt") for n in range(10)),
}


def escape(text: str) -> str:
    """The text as one line of Markdown or HTML that shows exactly these characters and runs
    nothing.

    For viser's Markdown and HTML elements, also inside a quoted attribute; not between backticks,
    where Markdown shows entities as they are. Everything but letters and digits becomes a numeric
    entity, so that no Markdown or HTML syntax can arise; white space becomes single spaces. An
    invisible joiner keeps addresses from becoming links.
    """
    plain = _LINK.sub("\u2060", _INVISIBLE.sub("", " ".join(str(text).split())))
    return "".join(c if c.isalnum() or c == " " else f"&#{ord(c)};" for c in plain)


def safe_file_name(name: str, default: str = "upload") -> str:
    """A file name made of the last part of `name`: no folder, no hidden file, nothing a file system
    would refuse.

    Letters of every script stay; at most 120 characters and 200 bytes, with its suffix; `default`
    if empty.
    """
    last = re.split(r"[/\\]", unicodedata.normalize("NFC", str(name)))[-1]
    last = re.sub(r'[<>:"|?*]', "_", _INVISIBLE.sub("", last)).strip(" .")
    stem, dot, suffix = last.rpartition(".")
    if not dot:
        stem, suffix = last, ""
    suffix = suffix[:16]
    tail = f".{suffix}" if suffix else ""
    stem = stem[: 120 - len(tail)]
    while len((stem + tail).encode()) > 200:
        stem = stem[:-1]
    stem = stem.strip(" .")
    if not stem:
        return default + tail
    return f"_{stem}{tail}" if stem.split(".")[0].lower() in _DEVICE_NAMES else stem + tail
