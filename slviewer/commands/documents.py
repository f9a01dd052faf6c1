"""What goes on paper, on a page, or to the terminal: patterns, targets, reports, what a session holds."""

from pathlib import Path

from tyro.conf import Positional

from slviewer.commands.parsing import deferred, ui


@deferred
def patterns(preset: str, projector: str, out: Path) -> None:
    """Write the images of a pattern sequence, and the TOML that `import frames` reads.

    Args:
        preset: p18, complementary, gray or multifrequency.
        projector: Width x height of the projector, px.
        out: Folder to make.
    """
    from slviewer.pipeline import printouts

    print(f"{printouts.patterns(preset, projector, out)} patterns written to {out}")


@deferred
def target(board: Positional[str], out: Path) -> None:
    """Draw a printable target to exact scale.

    Args:
        board: circles:21x16:9, acircles:…, chessboard:9x7:75 or charuco:….
        out: A .pdf or .svg file.
    """
    from slviewer.pipeline import printouts

    printouts.target(board, out)
    print(f"{board} drawn to {out}: print at 100 %, and measure it")


@deferred
def report(session: Positional[Path], out: Path) -> None:
    """Write one self-contained HTML report of a session.

    Args:
        session: Session folder.
        out: The .html file.
    """
    from slviewer.pipeline import report

    report.report(session, out, **ui())
    print(f"report written to {out}")


@deferred
def inspect(session: Positional[Path]) -> None:
    """Say what a session holds, and what is stale.

    Args:
        session: Session folder.
    """
    from slviewer.pipeline import inspect

    print(inspect.inspect(session))
