"""Session: calibrate and measure in a folder that stores the captures and every result:
session.py FOLDER BOARD SESSION."""

import sys

import slviewer as sl

folder, board, session = sys.argv[1:]
sl.import_captures(f"{folder}/poses", session, role="calibration", warn=print)
(scan,) = sl.import_captures(f"{folder}/scan", session, role="scan", warn=print)
print(sl.calibrate(session, board, models=["stereo"]).text())
print(sl.verify(session, [scan], "plane").text())
measured = sl.reconstruct(session, scan)
print(f"{measured.only.points} points in {measured.files[0]}")
