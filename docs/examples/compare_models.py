"""Three models: compare them on a plane, as error maps."""

import sys
from pathlib import Path

import slviewer as sl

folder = sl.datasets.fetch("sample")
poses = sl.read_captures(folder / "poses")
frames = {pose.name: pose.frames for pose in poses}
calibration = sl.calibrate_frames(
    poses[0].sequence, frames, "circles:21x16:9", models=["stereo", "pixelwise", "splined"]
)
(scan,) = sl.read_captures(folder / "scan")
phases = {axis: sl.decode(scan.sequence, scan.frames, axis) for axis in scan.sequence.axes}
assert calibration.pixelwise and calibration.splined
clouds = {
    "stereo": sl.reconstruct_cloud(calibration.stereo, phases),
    "pixelwise": sl.reconstruct_cloud(calibration.pixelwise, phases),
    "splined": sl.reconstruct_cloud(calibration.splined, phases),
}
planes = {}
for name, cloud in clouds.items():
    planes[name] = sl.evaluate_plane(cloud.points, None, cloud.sigma_z)
    print(
        f"{name}: RMS {planes[name].rms_mm:.3f} mm, noise floor"
        f" {planes[name].noise_floor_mm:.3f} mm"
    )
maps = {name: plane.error_map for name, plane in planes.items()}
rms = {name: plane.rms_mm for name, plane in planes.items()}
drawing = sl.draw_error_maps("Plane", maps, rms, planes["stereo"].noise_floor_mm)
Path(sys.argv[1]).write_bytes(drawing.png)
