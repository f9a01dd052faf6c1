"""Requests to merge scans, and to undo a merge."""

from collections.abc import Callable, Sequence

from slviewer.errors import InputError, SlviewerError
from slviewer.pipeline.merge import MergeSettings, Picked, StartKind, merge
from slviewer.registration.refusal import Refused
from slviewer.wizard.notices import describe_failure
from slviewer.wizard.requests import RequestHandler, request

MERGING = "Merging"
_ALTERNATIVES = {
    "features": "Or use the initial alignment by picked points.",
    "markers": "Or use the initial alignment by features, or by picked points.",
    "placed": "Or use the initial alignment by features, or by picked points.",
    "turntable": "Or use the initial alignment by features, or by picked points.",
    "identity": "Or use the initial alignment by features, or by picked points.",
    "picked": "Or pick other points.",
}
"""What else to try where scans cannot be aligned from a start."""


class MergeRequests(RequestHandler):
    """Requests that merge scans on the worker; the snapshot shows why a merge failed until the next
    one."""

    @request(MERGING)
    def merge(
        self,
        names: Sequence[str],
        reference: str,
        *,
        start: StartKind = "features",
        angle: float | None = None,
        picked: Picked | None = None,
    ) -> None:
        """Register scans, in the order in which they were captured, to a reference, and merge them.

        `undo_merge` undoes it. `start`, `angle` and `picked` as in `pipeline.merge`.
        """
        store = self._engine.store
        chosen = [store.load_capture(name).name for name in names]
        failed = self._begin_merge("picked" if picked else start)
        try:
            settings = MergeSettings(chosen, reference, start=start, angle=angle, picked=picked)
        except SlviewerError as error:
            failed(error)
            return
        self._run(MERGING, merge, settings, "merge", failed)

    def _begin_merge(self, start: str) -> Callable[[BaseException], None]:
        """Forget why the last merge failed; returns what notes why this one did.

        `start` is its initial alignment, a key of the alternatives to it.
        """
        engine = self._engine
        engine.set_merge_failure("")

        def failed(error: BaseException) -> None:
            """Store and report why the merge failed, and suggest another initial alignment where
            that may help."""
            text = describe_failure(MERGING, error)
            if isinstance(error, Refused) and error.reason in ("overlap", "disagree"):
                text = f"{text} {_ALTERNATIVES[start]}"
            reason = error.reason if isinstance(error, Refused) else None
            engine.set_merge_failure(text, reason)
            engine.notices.add("error", text, f"merge-{reason}" if reason else "merge")

        return failed

    @request("Undoing the merge")
    def undo_merge(self) -> None:
        """Move the current merge to the trash; the previous one is current again."""
        view, store = self._engine.publisher.refresh().session, self._engine.store
        if view is None or view.merge is None:
            raise InputError("there is no merge to undo")
        store.trash_result(f"merge/{view.merge.name}")
        (store.exports / f"merged_{view.merge.name}.ply").unlink(missing_ok=True)
