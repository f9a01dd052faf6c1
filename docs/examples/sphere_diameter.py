"""Sphere diameter: measure it with its uncertainty, on the sample: calibrate, find the sphere,
measure it."""

import sys
import tempfile

import matplotlib.pyplot as plt
import numpy as np

import slviewer as sl

folder = sl.datasets.fetch("sample")
session = tempfile.mkdtemp() + "/session"
sl.import_captures(folder / "poses", session, role="calibration")
(scan,) = sl.import_captures(folder / "sphere", session, role="scan")
sl.calibrate(session, "circles:21x16:9")

# The splined model alone predicts the calibration's part of the uncertainty. `verify` finds the
# sphere in the scan.
sphere = sl.verify(session, [scan], "sphere", models=["splined"])[scan].models["splined"]
assert sphere.centre_mm is not None and sphere.radius_mm is not None
measured = sl.measure(
    session, scan, "sphere", ball=(*sphere.centre_mm, sphere.radius_mm + 5), model="splined"
)
diameter = measured.only["diameter"]
assert diameter.whole  # the calibration's part is in it
print(f"diameter {diameter.value:.3f} mm, U {diameter.U:.3f} mm (k = 2)")
print(
    f"the standard uncertainty is {diameter.sigma:.4f} mm; the pitch of the board is taken as exact"
)

errors = sl.load_arrays(session, f"verify/{scan}")["error_splined"]
limit = float(np.nanquantile(np.abs(errors), 0.99))
figure, axis = plt.subplots(figsize=(5, 3.6), layout="constrained")
figure.colorbar(
    axis.imshow(errors, cmap="RdBu_r", vmin=-limit, vmax=limit),
    label="distance from the sphere, mm",
)
axis.set(title=f"Diameter {diameter.value:.3f} ± {diameter.U:.3f} mm", xticks=[], yticks=[])
figure.savefig(sys.argv[1], dpi=100)
