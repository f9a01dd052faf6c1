"""What a merge says of itself, in a panel: pairs, loops, what was left out, and why there is none."""

import re
from collections.abc import Mapping, Sequence

from slviewer.evaluation import letter
from slviewer.gui.widgets import Html, block, boxed, cell, meter, table, toned
from slviewer.wizard.snapshot import MergedLoop, MergedPair, MergeView

_LOW = 0.3
"""Overlap below which an alignment is doubted."""
_LOOPS = 3
_STRAY = {
    "edges": "beside depth jumps",
    "grazing": "seen at grazing angles",
    "groups": "in loose groups",
    "far": "far from everything else",
    "unconfirmed": "that other scans see through",
}


def merge_words(merge: MergeView, labels: Mapping[str, str]) -> Html:
    """How the scans lie on each other, the loops that they close, and what was left out."""
    onto = sorted(merge.registered, key=lambda pair: merge.reference not in (pair.scan, pair.onto))
    said = [_pairs_table(onto, labels)]
    if len(merge.scans) == 3:
        said.append(_beside_the_letter(merge, labels))
    if merge.loops:
        said.append(_loops_table(merge.loops, labels))
    said += [boxed(named(why, labels), "warning") for why in merge.dropped]
    if merge.refused:
        pairs = "".join(f"<li>{cell(named(why, labels))}</li>" for why in merge.refused)
        title = "Pairs that were not registered; the scans hang together without them"
        said.append(
            block(Html(f'<details><summary>{title}</summary><ul style="padding-left:1.4em">{pairs}</ul></details>'))
        )
    stale = toned("Scans or calibration have changed since: merge again.", "warning") if merge.stale else ""
    whole = f"Merged: <b>{merge.points:,} points</b> in the place of {cell(_label(merge.reference, labels))}"
    if merge.shared is not None:
        whole += f", {100 * merge.shared:.0f} % of them measured by more than one scan"
    said.append(block(Html(f"{whole}. {stale}")))
    if stray := [f"{count:,} {_STRAY.get(what, what)}" for what, count in merge.stray.items() if count]:
        said.append(block(toned(f"Pixels left out of the surface: {', '.join(stray)}.", "dim")))
    return Html("".join(said))


def refusal_words(why: str, labels: Mapping[str, str], merge: MergeView | None = None) -> Html:
    """Why there is no new merge; ``merge``: the one before, which is shown still."""
    still = "" if merge is None else " What is shown below is the merge before."
    return boxed(Html(f"<b>Not merged.</b> {cell(named(why, labels) + still)}"), "error")


def turn_words(names: Sequence[str], step_deg: float, labels: Mapping[str, str]) -> Html:
    """At which angle each scan was taken."""
    turned = [f"{_label(name, labels)} at {k * step_deg:g}°" for k, name in enumerate(names)]
    if len(turned) > 4:
        turned = [*turned[:3], "…", turned[-1]]
    order = "The table turns by the angle from each scan to the next, in either direction; its axis is found."
    return block(toned(f"{', '.join(turned)}. {order}", "dim"))


def named(sentence: str, labels: Mapping[str, str]) -> str:
    """A sentence about captures with the operator's own names for them."""
    names = [re.escape(name) for name, label in labels.items() if label != name]
    return re.sub(rf"(?<![\w.-])({'|'.join(names)})(?![\w-])", lambda m: labels[m[1]], sentence) if names else sentence


def _label(name: str, labels: Mapping[str, str]) -> str:
    return labels.get(name, name)


def _pairs_table(pairs: Sequence[MergedPair], labels: Mapping[str, str]) -> Html:
    rows = []
    for pair in pairs:
        share = f"{100 * pair.overlap:.0f} %{meter(pair.overlap, 'good' if pair.overlap >= _LOW else 'warning')}"
        known = pair.sigma_mm is not None and pair.sigma_deg is not None
        moved = (
            f"{pair.turned_deg:.2f}°" if pair.moved_mm is None else f"{pair.moved_mm:.2f} mm<br>{pair.turned_deg:.2f}°"
        )
        rows.append(
            (
                Html(f"{cell(_label(pair.scan, labels))}<br>on {cell(_label(pair.onto, labels))}"),
                toned(f"{pair.rms_mm:.3f} mm", "plain", bold=True),
                Html(share),
                Html(f"± {pair.sigma_mm:.4f} mm<br>± {pair.sigma_deg:.4f}°" if known else "–"),
                Html(moved),
            )
        )
    said = table(("Pair", "RMS", "overlap", "uncertainty", "moved by"), rows)
    return Html(f'<div style="max-height:21em;overflow-y:auto">{said}</div>')


def _beside_the_letter(merge: MergeView, labels: Mapping[str, str]) -> Html:
    theirs = " and ".join(f"{mm:.2f}" for mm in letter.EXPERIMENT_3_ICP_RMS_MM.values())
    ours = [pair.point_mm for pair in merge.registered if merge.reference in (pair.scan, pair.onto)]
    here = " and ".join(f"{mm:.2f}" for mm in ours if mm is not None)
    here = f" Counted as there, point to point, it is {here} mm here." if here else ""
    return block(toned(f"The Letter reports {theirs} mm for its object.{here}", "dim"))


def _loops_table(loops: Sequence[MergedLoop], labels: Mapping[str, str]) -> Html:
    rows = []
    for loop in loops[:_LOOPS]:
        through = [_label(name, labels) for name in loop.scans]
        if len(through) > 4:
            through = [*through[:2], "…", through[-1]]
        rows.append(
            (
                " – ".join([*through, through[0]]),
                Html(f"{loop.error_mm:.3f} mm<br>{loop.error_deg:.4f}°"),
                Html(f"{loop.left_mm:.3f} mm<br>{loop.left_deg:.4f}°"),
            )
        )
    of = f", the worst of {len(loops)}" if len(loops) > 1 else ""
    return table((f"Loop error{of}", "before", "once closed"), rows)
