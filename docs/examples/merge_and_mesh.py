"""Merge and mesh: three scans of an object at three depths before the simulated rig."""

import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import slviewer as sl

SCALE = 0.2  # of 1600x1200 px
session = tempfile.mkdtemp() + "/session"
sl.simulate(session, preset="turn", scale=SCALE, poses=8)
sl.calibrate(session, "circles:21x16:9")
scans = ["object_r1", "object_r2", "object_r3"]
merged = sl.merge(session, scans, "object_r2")
for scan, pair in merged.only.pairs.items():
    print(f"{scan}: {pair.rms_mm:.3f} mm from the reference where they overlap")
meshed = sl.mesh(session, ["merge/1"], plan=sl.MeshingPlan(triangles=20_000))
print(meshed.text())

surface = sl.read_ply(merged.files[0])
assert surface.normals is not None
x, y = surface.points[::2, 0], -surface.points[::2, 1]
shade = surface.normals[::2] @ [-0.4, -0.5, -0.77]  # lit from the upper left, behind the camera
figure, axis = plt.subplots(figsize=(5, 4.2), layout="constrained")
axis.scatter(x, y, s=1.5, c=shade, cmap="gray", vmin=0, vmax=1)
axis.set(
    xlabel="x, mm",
    ylabel="-y, mm",
    title=f"{len(surface.points)} points of {len(scans)} scans",
    aspect="equal",
)
figure.savefig(Path(sys.argv[1]), dpi=100)
