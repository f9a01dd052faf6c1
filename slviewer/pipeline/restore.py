"""What was moved to a session's trash, and bringing it back."""

from collections.abc import Sequence

from slviewer.errors import InputError
from slviewer.evaluation.render import render
from slviewer.pipeline.open_session import SessionLike, match_names, opened


def restore(session: SessionLike, names: Sequence[str] = ()) -> str:
    """List what is in a session's trash, or bring back what is named.

    Captures and results that were deleted or replaced are in the trash. What has a restored name
    now goes there in exchange, in one step.

    Args:
        session: Session folder.
        names: What to bring back: names, the last deleted of each, or patterns such as
            'calibration/*', or the name of one folder in the trash; without any, the trash is
            listed.
    """
    with opened(session, write=bool(names)) as store:
        trashed = store.trashed()
        if not names:
            if not trashed:
                return f"nothing is in the trash of {store.folder}"
            rows = [
                {
                    "name": each.name,
                    "kind": "capture" if each.is_capture else "result",
                    "deleted (UTC)": f"{each.time:%Y-%m-%d %H:%M:%S}",
                    "folder in the trash": each.place.name,
                }
                for each in trashed
            ]
            return render(rows)
        latest = {each.name: each for each in reversed(trashed)}
        latest |= {each.place.name: each for each in trashed}
        found = match_names(list(latest), names, "item of the trash", InputError)
        # patterns match no folders
        chosen = [latest[name] for name in found if name in names or name == latest[name].name]
        chosen = list(dict.fromkeys(chosen))
        store.restore(chosen)
        return "\n".join(
            f"restored: {each.name}, deleted {each.time:%Y-%m-%d %H:%M:%S} UTC" for each in chosen
        )
