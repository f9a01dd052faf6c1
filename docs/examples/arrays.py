"""Arrays: calibrate from images and measure a plane, all in memory: arrays.py FOLDER BOARD PICTURE.

FOLDER holds the target poses in `poses` and one scan in `scan`, in any known layout.
"""

import sys
from pathlib import Path

import slviewer as sl

folder, board, picture = sys.argv[1:]
poses = sl.read_captures(f"{folder}/poses")
frames = {pose.name: pose.frames for pose in poses}
# without models: all of them
calibration = sl.calibrate_frames(poses[0].sequence, frames, board, models=["stereo"])
(scan,) = sl.read_captures(f"{folder}/scan")
phases = {axis: sl.decode(scan.sequence, scan.frames, axis) for axis in scan.sequence.axes}
cloud = sl.reconstruct_cloud(calibration.best, phases)
plane = sl.evaluate_plane(cloud.points, None, cloud.sigma_z)
drawing = sl.draw_error_maps(
    "Plane", {cloud.model: plane.error_map}, {cloud.model: plane.rms_mm}, plane.noise_floor_mm
)
Path(picture).write_bytes(drawing.png)
print(
    f"RMS {plane.rms_mm:.3f} mm, noise floor {plane.noise_floor_mm:.3f} mm, {plane.points} points"
)
