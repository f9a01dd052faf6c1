"""Decoded capture: its phase, its modulation, and why pixels are masked."""

import sys

import matplotlib.pyplot as plt
import numpy as np

import slviewer as sl

folder = sl.datasets.fetch("sample")
(scan,) = sl.read_captures(folder / "object")
phase = sl.decode(scan.sequence, scan.frames, "x")
print(
    f"{phase.mask.mean():.0%} of the pixels decoded, at a period of {phase.period_px:g} projector"
    " columns"
)
print(f"noise of the phase: median {np.nanmedian(phase.sigma_px):.3f} projector columns")

reasons = [int(code) for code in np.unique(phase.reason) if code]
print("masked because:", ", ".join(sl.Reason(code).name.lower() for code in reasons))

figure, axes = plt.subplots(1, 3, figsize=(12, 3.4), layout="constrained")
shown = (
    ("Projector column, px", np.where(phase.mask, phase.coordinate, np.nan), "viridis"),
    ("Modulation, grey levels", phase.modulation, "gray"),
    ("Why masked", np.where(phase.mask, np.nan, np.searchsorted(reasons, phase.reason)), "Set2"),
)
for axis, (title, values, colours) in zip(axes, shown, strict=True):
    bar = figure.colorbar(axis.imshow(values, cmap=colours), ax=axis, shrink=0.8)
    axis.set(title=title, xticks=[], yticks=[])
axes[2].images[0].set(cmap=plt.get_cmap("Set2", len(reasons)), clim=(-0.5, len(reasons) - 0.5))
bar.set_ticks(range(len(reasons)), labels=[sl.Reason(code).name.lower() for code in reasons])
figure.savefig(sys.argv[1], dpi=100)
