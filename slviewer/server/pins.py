"""The version of viser that this room was written for, and what its page consists of."""

import viser

from slviewer.errors import SlviewerError

VISER = "1.1.1"

VISER_SCRIPTS = (
    "'sha256-5iRcjB7VnwnYpbUpHa15FmjNIRu22hIQnvWuocHMxJw='",
    "'sha256-o/BTEGoB4UnTxqb+3RxwUFQZkWXpqUxouHkbDNrAkqE='",
)
"""The scripts that viser's page runs: the loader that stands in it, and the application that the loader unpacks."""


def check_version() -> None:
    """SlviewerError where another viser is installed: what keeps strangers out was not tried with it."""
    if viser.__version__ != VISER:
        raise SlviewerError(
            f"viser {viser.__version__} is installed, but this slviewer serves safely only with viser {VISER}: "
            f"install it with pip install viser=={VISER}."
        )
